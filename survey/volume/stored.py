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
from survey.export.render import targets_of, write_seen
from survey.files.json_values import read_json_object
from survey.progress import current
from survey.run.stored import FIELD_SETTINGS, FIELD_STATE, is_field, run_of
from survey.run.trained_field import VolumeRecipe
from survey.volume.options import VolumeOptions
from survey.volume.scene import BedBox
from survey.volume.submodules import SubmoduleViews
from survey.words import Drop


def render_field(
    folder: str | Path,
    cameras: str | Path,
    output: str | Path,
    *,
    dry: bool = False,
    device: str = "auto",
    video_s: float | None = None,
) -> list[Path]:
    """Render the field in a folder for the cameras of a file; pictures and errors as `survey.export.render.render`."""
    folder = Path(folder)
    with LoadedRun(run_of(folder)) as run:
        view = StoredVolume.of_run(folder, run).load(device)
        targets = targets_of(run.folder, run.flight.frame, Path(cameras), Path(output))
        return write_seen(targets, Path(output), video_s, lambda _cameras: lambda camera: view(camera, dry))


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
        if not is_field(folder):
            raise SurveyError(
                f"{folder} holds no trained field ({FIELD_SETTINGS} and {FIELD_STATE}); train one: bathynerf field "
                f"{run.folder.path} -o {folder}"
            )
        settings = read_json_object(folder / FIELD_SETTINGS)
        if settings.get("result") != run.stages:
            raise SurveyError(
                f"the field in {folder} was trained on another run, or on an earlier result of {run.folder.path}; "
                "train one on this result: bathynerf field, into another folder"
            )
        try:
            recipe = VolumeRecipe.of(settings)
            bounds = None if settings["bounds"] is None else tuple(settings["bounds"])
            options = VolumeOptions(cells=recipe.cells, bounds=bounds, straight=recipe.straight)
            ground = BedBox.of_run(run, run.flight, options)
            counts = settings["submodules"] and counts_of(settings["submodules"], ground.box.size)
        except (KeyError, TypeError, ValueError) as error:
            raise SurveyError(
                f"{folder / FIELD_SETTINGS} cannot be read ({error!r}); delete the folder, and train the field again"
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
        field = self.recipe.restored(self.folder / FIELD_STATE, self.ground.box, self.water, device)
        if field.step < self.recipe.steps:
            note(f"the training of {self.folder} has done {field.step} of {self.recipe.steps} steps so far")
        return field.view
