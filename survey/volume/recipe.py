"""Recipe and state from which a trained field is rebuilt, and its views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fields.device import choose_device, tensor_place
from fields.image_based import NovelView, heights_over, normals_of
from fields.volume.appearance import appearance_vectors
from fields.volume.models import APPEARANCE, build_model, proposal_for
from fields.volume.paths import Box
from fields.volume.renderer import NormalHead, VolumeImage, VolumeRenderer, render_volume
from fields.volume.sampling import Cells
from fields.volume.shell import Shell
from fields.volume.surface import LEAST_OPACITY
from fields.water_column import WaterColumn
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.volume.scene import SETTINGS, read_state


@dataclass(frozen=True)
class VolumeRecipe:
    """Settings that determine the parameters of a model and its paths."""

    model: str  # key of `fields.volume.models.MODELS`
    # cells, steps, seed: As in `survey.volume.options.VolumeOptions`
    cells: int
    steps: int
    seed: int
    samples: int  # Of each path
    straight: bool  # Rays are not bent
    appearance: bool  # A vector for each photograph
    shell: bool = False  # A background beyond the box

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
            background=Shell(box) if self.shell else None,
            proposal=proposal_for(self.model, box, self.cells, self.steps),
            normals=NormalHead(model.num_features) if normal_head else None,
        ).to(tensor_place(place))

    def bends(self, water: FlatWater | None) -> FlatWater | None:
        """The water at which rays are bent; None where they are straight."""
        return None if self.straight else water

    def restored(self, path: Path, box: Box, water: FlatWater | None, device: str) -> tuple[VolumeRenderer, Cells, int]:
        """The model of the state in a file, with its proxy and the steps that its training has done."""
        state: dict[str, Any] = read_state(path)
        try:
            parameters = state["renderer"]
            photographs = len(parameters["appearance.weight"]) if self.appearance else 0
            has_normals = any(name.startswith("normals.") for name in parameters)
            renderer = self.renderer(box, water, photographs, device, normal_head=has_normals)
            renderer.load_state_dict(parameters)
            return renderer, Cells(box, state["occupied"]).to(renderer.model.place), int(state["step"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise SurveyError(
                f"{path} does not fit its {SETTINGS} ({str(error)[:80]}); delete it, and training begins anew"
            ) from error


def novel_view(seen: VolumeImage, water: FlatWater | None) -> NovelView:
    """A rendered volume as a `NovelView`: with heights over the water and normals, black where nothing is seen."""
    points = seen.points.astype(np.float64)
    known = np.isfinite(seen.distance) & (seen.opacity > LEAST_OPACITY)
    points[~known] = np.nan
    height = heights_over(points.reshape(-1, 3), water).reshape(known.shape).astype(np.float32)
    rgb = np.where(known[..., None], np.round(255.0 * seen.rgb.clip(0.0, 1.0)), 0.0).astype(np.uint8)
    distance = np.where(known, seen.distance, np.nan).astype(np.float32)
    return NovelView(rgb, height, distance, normals_of(points))


def view_of(
    renderer: VolumeRenderer,
    cells: Cells,
    recipe: VolumeRecipe,
    water: FlatWater | None,
    camera: PinholeCamera,
    *,
    dry: bool,
) -> NovelView:
    """Rendering of a trained volume by a camera, through the water of its survey or, ``dry``, without it."""
    bent = None if dry else recipe.bends(water)
    return novel_view(render_volume(renderer, camera, bent, cells, samples=recipe.samples, dry=dry), water)
