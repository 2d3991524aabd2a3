"""Views of submodules, which are read from their folders when a view needs them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import torch

from fields.image_based import NovelView
from fields.volume.paths import Box
from fields.volume.sampling import Cells
from fields.volume.submodules import (
    Grid,
    Submodule,
    ground_shares,
    kept,
    pose_weights,
    render_submodules,
    single_vector,
)
from fields.volume.visibility import Visibility
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.files.json_values import read_json_object
from survey.run.stored import FIELD_STATE
from survey.run.stored_field import VolumeRecipe, novel_view, read_state
from survey.volume.folder import SUBMODULES
from survey.volume.scene import REPORT, BedBox
from survey.words import Drop

# Folder of the submodules in that of their field; file of their matched appearance vectors there; visibility of each.
VECTORS, VISIBILITY = "looks.json", "visibility.pt"
# Submodules that are kept in memory: while the next one is read there are two.
IN_MEMORY = 1


class SubmoduleViews:
    """Renderer of the trained submodules of the field in a folder, which are loaded when they are needed.

    The ground is that of all, counts are their cells along x and y, ``drop`` is a word of `survey.words.Drop`.
    """

    def __init__(
        self,
        folder: Path,
        recipe: VolumeRecipe,
        ground: BedBox,
        counts: tuple[int, int],
        device: str,
        drop: str = Drop.geometry,
    ):
        self.recipe, self.ground, self.device, self.drop = recipe, ground, device, drop
        self.grid = Grid(ground.box, counts)
        self.folder = folder
        self._with_bed: list[str] = []
        self.folders: dict[int, Path] = {}
        self.boxes: dict[int, Box] = {}
        for number, name in enumerate(self.grid.names()):
            part = ground.within(self.grid.box_of(number), recipe.cells)
            if part is None:
                continue
            self._with_bed.append(name)
            if (folder / SUBMODULES / name / FIELD_STATE).is_file():
                self.folders[number], self.boxes[number] = folder / SUBMODULES / name, part.box
        if not self.folders:
            raise SurveyError(
                f"nothing of the field in {folder} is trained yet; run bathynerf field again with the same options"
            )
        self.grid = replace(self.grid, trained=tuple(self.folders))
        self._kept = lru_cache(IN_MEMORY)(self.load)
        self._visibility = cache(self._load_visibility)

    def unfinished(self) -> list[str]:
        """Notes on missing training: cells with a bed that have none, and steps."""
        parts, report = [], self.folder / REPORT
        left_out = read_json_object(report).get("left_out", {}) if report.is_file() else {}
        cells = sum(name not in left_out for name in self._with_bed)
        if len(self.folders) < cells:
            parts.append(f"{len(self.folders)} of {cells} cells of {self.folder} are trained so far")
        for folder in self.folders.values():
            if (step := read_state(folder / FIELD_STATE).get("step", 0)) < self.recipe.steps:
                parts.append(f"the training of {folder} has done {step} of {self.recipe.steps} steps so far")
        return parts

    def load(self, number: int) -> Submodule:
        """A submodule, with the matched appearance where there is one."""
        folder = self.folders[number]
        field = self.recipe.restored(folder / FIELD_STATE, self.boxes[number], self.ground.water, self.device)
        renderer = field.renderer
        vectors = folder.parent / VECTORS
        if self.recipe.appearance and vectors.is_file():
            vector = torch.tensor(read_json_object(vectors)[folder.name], dtype=torch.float32)
            renderer.appearance = single_vector(vector.to(renderer.model.place))
        return Submodule(number, renderer, field.cells)

    def _load_visibility(self, number: int) -> tuple[Visibility, Cells]:
        saved = read_state(self.folders[number] / VISIBILITY)
        box = self.boxes[number]
        network = Visibility(box)
        network.load_state_dict(saved["network"])
        return network, Cells(box, saved["occupied"])

    def visible(self, camera: PinholeCamera, water: FlatWater | None) -> np.ndarray:
        """Visibilities (M,) of the submodules to a camera; 1 where none is left out."""
        if self.drop == Drop.geometry:
            return ground_shares(self.grid, self.ground.bed, camera, water)[list(self.folders)]
        if self.drop == Drop.network:
            each = [self._visibility(number) for number in self.folders]
            return np.array([network.of_view(camera, water, cells) for network, cells in each])
        return np.ones(len(self.folders))

    def dropped(self, camera: PinholeCamera) -> dict[str, float]:
        """Visibilities of the submodules that are left out of the view of a camera, by their names."""
        visible, folders = self.visible(camera, self.ground.bent), list(self.folders.values())
        return {folders[k].name: float(visible[k]) for k in np.setdiff1d(np.arange(len(visible)), kept(visible))}

    def view(self, camera: PinholeCamera, dry: bool = False) -> NovelView:
        """View of a camera, with the water or, ``dry``, without it."""
        water = None if dry else self.ground.bent
        weights = pose_weights(camera.centre, list(self.boxes.values()))
        numbers = list(self.folders)
        chosen = ((weights[k], self._kept(numbers[k])) for k in kept(self.visible(camera, water)))
        seen = render_submodules(chosen, self.grid, camera, water, samples=self.recipe.samples, dry=dry)
        return novel_view(seen, self.ground.water, has_background=self.recipe.shell)
