"""Water that was looked at and in which no bed was found: its cells with their causes, as areas, raster or points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rasterio.features import shapes as polygons_of
from rasterio.transform import Affine
from shapely import Polygon

from fields.sweep.bed import BedPoints
from geo.frames import LocalFrame
from geo.grid import Window
from geo.las import CLASS_NO_BOTTOM, CLASS_WATER_SURFACE
from geo.raster import RasterBand
from geo.transformation import Transformation
from geo.vectors import Layer
from survey.export.bed_raster import bed_raster
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions
from survey.export.terrain import write_raster
from survey.export.vectors import check_seen, in_crs, write_layer
from survey.plan.area import local_area
from survey.report.seen_cells import SeenCells, cells_seen
from survey.run.stored import StoredBed

# Codes of cells without a point; 0 is everything else: bed found, dry ground, or seen by no view.
TWO_VIEWS, ONE_VIEW = 1, 2
REASONS = {
    TWO_VIEWS: "two or more views, no bed found: turbid, too deep, glint, or without texture",
    ONE_VIEW: "one view only",
}
_RASTERS = (".tif", ".tiff")


@dataclass(frozen=True)
class Unseen:
    """Cells of the ground without a bed."""

    cells: SeenCells
    codes: np.ndarray  # (rows, columns) uint8: `TWO_VIEWS`, `ONE_VIEW` or 0
    # (rows, columns) float64 [m], local: height of the water over the middles of the cells; NaN in a dry survey
    level: np.ndarray
    frame: LocalFrame

    def codes_at(self, points_crs: np.ndarray) -> np.ndarray:
        """Codes (...) uint8 under points (..., 3) in the CRS of the survey, e.g. the middles of other cells; 0 beyond.

        Heights matter little: a metre moves a place by micrometres.
        """
        local, grid = self.frame.local_from_crs(points_crs), self.cells.grid
        at = grid.columns_rows(local)
        inside = np.all((at >= 0.0) & (at < grid.shape[::-1]), axis=-1)
        return np.where(inside, self.codes[grid.index(np.where(inside[..., None], local, 0.0))], 0).astype(np.uint8)


def unseen_of(run: LoadedRun) -> Unseen:
    """The cells of a run, made once for the products of a command.

    A cell is ten ground sampling distances wide (`survey.report.seen_cells`), counts as water where the nearest bed
    lies under the water, and as seen where its middle is.
    """
    return run.once("unseen", lambda: _unseen(run))


def _unseen(run: LoadedRun) -> Unseen:
    flight = run.flight
    cameras = [view.camera for view in flight.views]
    xyz, area = run.columns("xyz")["xyz"], local_area(flight)
    cells = cells_seen(cameras, flight.water, flight.departure, area, xyz, run.bed_header.gsd_m)
    places = cells.middles
    level = flight.level(places[..., :2])
    is_water = cells.height < level
    codes = np.where(cells.num_views >= 2, TWO_VIEWS, np.where(cells.num_views == 1, ONE_VIEW, 0))
    return Unseen(cells, np.where(is_water & ~cells.has_point, codes, 0).astype(np.uint8), level, flight.frame)


def with_unseen(
    run: LoadedRun, stored: StoredBed, classes: np.ndarray, crs: str | None
) -> tuple[StoredBed, np.ndarray]:
    """The cloud, in a CRS or that of the survey, with two points for each cell without a bed; the classes (N,) of all.

    Both stand on the water over the middle of the cell, black, without depth and standard deviation: `CLASS_NO_BOTTOM`,
    and `CLASS_WATER_SURFACE`.
    """
    unseen, bed = unseen_of(run), stored.bed
    missing = unseen.codes > 0
    number = int(missing.sum())
    xyz = unseen.cells.middles[missing]
    xyz[:, 2] = unseen.level[missing]
    views = unseen.cells.num_views[missing].clip(max=255).astype(bed.num_views.dtype)
    unknown = np.full(number, np.nan, dtype=np.float32)
    some = bed[np.zeros(number, dtype=np.int64)]
    added = replace(
        some, xyz=xyz, rgb=np.zeros_like(some.rgb), std=unknown, num_views=views, depth=unknown, incidence=unknown
    )
    points = unseen.frame.crs_from_local(xyz)
    if crs is not None:
        points = run.transformation_to(crs)(points)
    added_classes = np.repeat(np.array([CLASS_NO_BOTTOM, CLASS_WATER_SURFACE], dtype=np.uint8), number)
    common = stored.std_common
    with_all = replace(
        stored,
        bed=BedPoints.concatenate([bed, added, added]),
        points_crs=np.concatenate([stored.points_crs, points, points]),
        std_common=None if common is None else np.concatenate([common, unknown, unknown]),
        std_placed=None,
        std_plan=None if stored.std_plan is None else np.concatenate([stored.std_plan, unknown, unknown]),
    )
    return with_all, np.concatenate([classes, added_classes])


def write_unseen(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Polygons, or a raster by the suffix."""
    if path.suffix.lower() in _RASTERS:
        _write_mask(path, run, options)
    else:
        write_layer(path, _areas(run, options))


check_unseen = check_seen


def _areas(run: LoadedRun, options: ExportOptions) -> Layer:
    """Polygons of the cells of water without a bed, with the reason as far as it is known."""
    unseen = unseen_of(run)
    cells, codes = unseen.cells, unseen.codes
    shapes, views, reasons, areas = [], [], [], []
    for polygon, code in polygons_of(codes, mask=codes > 0, transform=Affine(*cells.grid.transform)):
        rings = [np.array(ring) for ring in polygon["coordinates"]]
        heights = (unseen.level[cells.grid.index(ring)] for ring in rings)
        shapes.append([in_crs(run, options, np.column_stack(pair)) for pair in zip(rings, heights, strict=True)])
        views.append("one" if code == ONE_VIEW else "two or more")
        reasons.append(REASONS[int(code)])
        areas.append(round(Polygon(rings[0], rings[1:]).area, 3))
    columns: dict[str, list] = {"views": views, "reason": reasons, "area_m2": areas}
    about = f"water that was looked at and in which no bed was found, in cells of {cells.grid.side_m:g} m"
    return Layer("unseen", "Polygon", shapes, run.crs_for(options.crs), columns, about)


def _write_mask(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the codes of its causes as GeoTIFF, 0 where the terrain model has a height.

    It covers what the terrain model covers, so that both lie upon each other; what lies beyond is in the polygons only.
    """
    grid, unseen = bed_raster(run, options), unseen_of(run)
    corner = np.array([grid.cells.origin])
    back = Transformation.between(grid.cells.crs, run.bed_header.crs, corner)
    level = float(unseen.frame.origin[2])

    def values(window: Window) -> np.ndarray:
        east, north = back(*np.moveaxis(grid.cells.middles(window), -1, 0))
        codes = unseen.codes_at(np.stack([east, north, np.full(window.shape, level)], axis=-1))
        return np.where(grid.origin[window.slices] > 0, 0, codes).astype(np.uint8)[None]

    tags = {f"CODE_{code}": reason for code, reason in REASONS.items()} | {"CODE_0": "everything else"}
    band = RasterBand("no bed found", "code")
    write_raster(path, grid, values, band, tags=tags, dtype="uint8", nodata=None, resampling="NEAREST")
