"""Mask of water without a bed, in the cells of the terrain model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.raster_writing import Band, write_cog
from geo.transformation import Transformation
from survey.export.gridded import gridded
from survey.export.terrain import parts_of, raster_form
from survey.export.unseen import REASONS, unseen_of

if TYPE_CHECKING:
    from survey.export.loaded import LoadedRun
    from survey.export.plan_cells import Window
    from survey.export.product import ExportOptions


def write_mask(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the codes of `survey.export.unseen` as GeoTIFF, 0 where the terrain model has a height.

    It covers what the terrain model covers, so that both lie upon each other; what lies beyond is in the polygons only.
    """
    grid, unseen = gridded(run, options), unseen_of(run)
    corner = np.array([[grid.cells.west, grid.cells.north]])
    back = Transformation.between(grid.cells.crs, run.place.crs, corner)
    level = float(unseen.frame.origin[2])

    def values(window: Window) -> np.ndarray:
        east, north = back(*np.moveaxis(grid.cells.middles(window), -1, 0))
        codes = unseen.codes_at(np.stack([east, north, np.full(window.shape, level)], axis=-1))
        return np.where(grid.known[window.slices] > 0, 0, codes).astype(np.uint8)[None]

    said = {f"CODE_{code}": reason for code, reason in REASONS.items()} | {"CODE_0": "everything else"}
    band = Band("no bed found", "code")
    form = raster_form(grid, band, said=said, dtype="uint8", nodata=None, resampling="NEAREST")
    write_cog(path, form, parts_of(grid, values))
