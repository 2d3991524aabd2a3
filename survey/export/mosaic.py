"""Mosaic of photographs in the cells of a picture, weighted towards the steepest view.

Where views are about equally steep they fade into each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geo.files import scratch_array
from refract import PinholeCamera
from survey.export.cell_projection import CellProjection
from survey.export.plan_cells import PlanCells, Window

# Over this difference of the squared tangent of their angles one view takes over from another.
_FADING = 0.004
# Towards the border of a photograph it fades out [px].
_BORDER_PX = 24.0


@dataclass(frozen=True)
class Mosaic:
    """Sums over views in cells, in files; the highest weight of a cell is 1."""

    cells: PlanCells
    highest: np.ndarray  # (rows, columns) float32: logarithm of the highest weight; of no meaning where `weight` is 0
    weight: np.ndarray  # (rows, columns) float32
    colour: np.ndarray  # (rows, columns, 3) float32: sum of weighted colours, 0 to 255

    @staticmethod
    def empty(cells: PlanCells, folder: Path) -> Mosaic:
        """Mosaic without a colour; its files are made in a folder."""
        shapes = {"highest": cells.shape, "weight": cells.shape, "colour": (*cells.shape, 3)}
        files = {name: scratch_array(folder / f"mosaic-{name}", "f4", shape) for name, shape in shapes.items()}
        return Mosaic(cells, **files)

    def add(self, window: Window, log_weight: np.ndarray, colour: np.ndarray) -> None:
        """Add a view's colours (rows, columns, 3) with the logarithms of their weights; NaN is not seen."""
        at = window.slices
        seen = np.isfinite(log_weight)
        before, weight = self.highest[at], self.weight[at]
        new = np.where(seen, log_weight, -np.inf)
        old = np.where(weight > 0.0, before, -np.inf)
        highest = np.where(seen, np.maximum(old, new), np.where(weight > 0.0, before, 0.0))
        keep, own = np.exp(old - highest), np.exp(new - highest)
        self.weight[at] = keep * weight + own
        self.colour[at] = keep[..., None] * self.colour[at] + np.where(seen[..., None], own[..., None] * colour, 0.0)
        self.highest[at] = highest

    def rgba(self, window: Window) -> np.ndarray:
        """Colours with transparency (4, rows, columns) uint8 of a window."""
        weight = self.weight[window.slices]
        colour = self.colour[window.slices] / np.where(weight > 0.0, weight, 1.0)[..., None]
        stored = np.clip(np.round(colour), 0, 255).astype(np.uint8)
        return np.concatenate([np.moveaxis(stored, -1, 0), np.where(weight > 0.0, 255, 0).astype(np.uint8)[None]])


def log_weight(sight: CellProjection, camera: PinholeCamera) -> np.ndarray:
    """Logarithm of the weight (rows, columns) of a view: the steeper the more, and little at its border."""
    u, v = sight.u, sight.v
    border = np.minimum(np.minimum(u, camera.width - u), np.minimum(v, camera.height - v))
    return -sight.lean / _FADING + np.log(np.clip(border / _BORDER_PX, 1e-3, 1.0))
