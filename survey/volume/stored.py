"""A radiance field as `bathynerf field` left it in its folder, read back to be rendered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fields.image_based import NovelView
from fields.volume.submodules import counts_of
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.files.json_values import read_json_object
from survey.progress import current
from survey.volume.recipe import VolumeRecipe, view_of
from survey.volume.scene import SETTINGS, STATE, BedBox, SceneOptions
from survey.volume.submodule_views import FOLDER, SubmoduleViews
from survey.words import Drop


@dataclass(frozen=True)
class StoredVolume:
    """The folder of a volume beside the run that it was trained on."""

    folder: Path
    recipe: VolumeRecipe
    ground: BedBox
    counts: tuple[int, int] | None  # submodules along x and y; None: it is one volume
    water: FlatWater | None  # Of the run
    drop: str = Drop.geometry  # A word of `survey.words.Drop`

    @staticmethod
    def of_run(folder: Path, run: LoadedRun) -> StoredVolume:
        """The volume in a folder, if it was trained on this run as it is now."""
        if not (folder / SETTINGS).is_file() or not ((folder / STATE).is_file() or (folder / FOLDER).is_dir()):
            raise SurveyError(
                f"{folder} holds no trained field ({SETTINGS} and {STATE}); train one: bathynerf field "
                f"{run.folder.path} -o {folder}"
            )
        settings = read_json_object(folder / SETTINGS)
        if settings.get("result") != run.stages:
            raise SurveyError(
                f"the field in {folder} was trained on another run, or on an earlier result of {run.folder.path}; "
                "train one on this result: bathynerf field, into another folder"
            )
        try:
            recipe = VolumeRecipe(**{name: settings[name] for name in VolumeRecipe.__dataclass_fields__})
            bounds = None if settings["bounds"] is None else tuple(settings["bounds"])
            scene = SceneOptions(recipe.cells, bounds, straight=recipe.straight)
            ground = BedBox.of_run(run, run.flight, scene)
            counts = settings["submodules"] and counts_of(settings["submodules"], ground.box.size)
        except (KeyError, TypeError, ValueError) as error:
            raise SurveyError(
                f"{folder / SETTINGS} cannot be read ({error!r}); delete the folder, and train the field again"
            ) from error
        return StoredVolume(folder, recipe, ground, counts, run.flight.water)

    def load(
        self, device: str = "auto", note: Callable[[str], None] = lambda text: current().note(text)
    ) -> Callable[[PinholeCamera, bool], NovelView]:
        """Render function of the field, with the water or ``dry``; ``note`` is told of unfinished training."""
        if self.counts is not None:
            views = SubmoduleViews(self.folder, self.recipe, self.ground, self.counts, device, self.drop)
            for text in views.unfinished():
                note(text)
            return views.view
        renderer, cells, step = self.recipe.restored(self.folder / STATE, self.ground.box, self.water, device)
        if step < self.recipe.steps:
            note(f"the training of {self.folder} has done {step} of {self.recipe.steps} steps so far")
        return lambda camera, dry: view_of(renderer, cells, self.recipe, self.water, camera, dry=dry)
