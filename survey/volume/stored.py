"""A radiance field as `bathynerf field` left it in its folder, read back to be rendered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fields.device import choose_device, tensor_place
from fields.image_based import NovelView, heights_over, normals_of
from fields.volume.appearance import appearance_vectors
from fields.volume.models import APPEARANCE, build_model, proposal_for
from fields.volume.paths import Box
from fields.volume.renderer import NormalHead, VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.surface import LEAST_OPACITY
from fields.water_column import WaterColumn
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.files.json_values import read_json_object
from survey.progress import current
from survey.volume.scene import SETTINGS, STATE, box_of_run, read_state


@dataclass(frozen=True)
class VolumeRecipe:
    """Settings that determine the parameters of a model and how its paths run."""

    model: str  # key of `fields.volume.models.MODELS`
    # cells, steps, seed: As in `survey.volume.field.VolumeOptions`
    cells: int
    steps: int
    seed: int
    samples: int  # Of each path
    straight: bool  # Rays are not bent
    appearance: bool  # A vector for each photograph

    def renderer(
        self, box: Box, water: FlatWater | None, photographs: int, device: str, *, normal_head: bool = False
    ) -> VolumeRenderer:
        """The untrained model in a box, with a water column where its rays are bent, ready to be rendered."""
        place, length = choose_device(device), APPEARANCE if self.appearance else 0
        model = build_model(self.model, box, self.cells, place, appearance=length, seed=self.seed, steps=self.steps)
        return VolumeRenderer(
            model,
            column=WaterColumn() if self.bends(water) is not None else None,
            appearance=appearance_vectors(photographs, length) if length else None,
            proposal=proposal_for(self.model, box, self.cells, self.steps),
            normals=NormalHead(model.num_features) if normal_head else None,
        ).to(tensor_place(place))

    def bends(self, water: FlatWater | None) -> FlatWater | None:
        """The water at which rays are bent; None where they are straight."""
        return None if self.straight else water


def view_of(
    renderer: VolumeRenderer,
    cells: Cells,
    recipe: VolumeRecipe,
    water: FlatWater | None,
    camera: PinholeCamera,
    *,
    dry: bool,
) -> NovelView:
    """A trained volume as a camera sees it, over the water of its survey or, ``dry``, with the water taken away."""
    bent = None if dry else recipe.bends(water)
    seen = render_volume(renderer, camera, bent, cells, samples=recipe.samples, dry=dry)
    points = seen.points.astype(np.float64)
    known = np.isfinite(seen.distance) & (seen.opacity > LEAST_OPACITY)
    points[~known] = np.nan
    height = heights_over(points.reshape(-1, 3), water).reshape(known.shape).astype(np.float32)
    rgb = np.where(known[..., None], np.round(255.0 * seen.rgb.clip(0.0, 1.0)), 0.0).astype(np.uint8)
    distance = np.where(known, seen.distance, np.nan).astype(np.float32)
    return NovelView(rgb, height, distance, normals_of(points))


@dataclass(frozen=True)
class StoredVolume:
    """The folder of a volume beside the run that it was trained on."""

    folder: Path
    recipe: VolumeRecipe
    box: Box
    water: FlatWater | None  # Of the run

    @staticmethod
    def of_run(folder: Path, run: LoadedRun) -> StoredVolume:
        """The volume in a folder, if it was trained on this run as it is now.

        Raises
        ------
        SurveyError
            If the folder holds no volume, or one of another run.
        """
        if not (folder / SETTINGS).is_file() or not (folder / STATE).is_file():
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
            bounds = settings["bounds"]
            box = box_of_run(run, run.flight.frame, None if bounds is None else tuple(bounds), recipe.cells)
        except (KeyError, TypeError, ValueError) as error:
            raise SurveyError(
                f"{folder / SETTINGS} cannot be read ({error!r}); delete the folder, and train the field again"
            ) from error
        return StoredVolume(folder, recipe, box, run.flight.water)

    def load(
        self, device: str = "auto", note: Callable[[str], None] = lambda said: current().note(said)
    ) -> Callable[[PinholeCamera, bool], NovelView]:
        """Renderer of the field, with the water or (True) without it; ``note`` is told of one half trained.

        Raises
        ------
        SurveyError
            If the state of the training is damaged.
        """
        path = self.folder / STATE
        state: dict[str, Any] = read_state(path)
        try:
            parameters = state["renderer"]
            photographs = len(parameters["appearance.weight"]) if self.recipe.appearance else 0
            has_normals = any(name.startswith("normals.") for name in parameters)
            renderer = self.recipe.renderer(self.box, self.water, photographs, device, normal_head=has_normals)
            renderer.load_state_dict(parameters)
            cells, step = Cells(self.box, state["occupied"]).to(renderer.model.place), int(state["step"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise SurveyError(
                f"{path} does not fit its {SETTINGS} ({str(error)[:80]}); delete it, and training begins anew"
            ) from error
        if step < self.recipe.steps:
            note(f"the training of {self.folder} has done {step} of {self.recipe.steps} steps so far")
        return lambda camera, dry: view_of(renderer, cells, self.recipe, self.water, camera, dry=dry)
