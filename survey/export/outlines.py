"""Outlines in plan: footprints of photographs, areas without a bed and their causes, contours, the shoreline."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import contourpy
import numpy as np

from geo.raster import RasterBand, write_cog
from geo.transformation import Transformation
from geo.vectors import Layer
from survey.display.quantities import round_up
from survey.errors import SurveyError
from survey.export.bed_cells import CellWindow
from survey.export.bed_raster import bed_raster
from survey.export.terrain import parts_of, raster_form
from survey.plan.area import local_area
from survey.progress import current
from survey.report.seen_cells import SeenCells, cells_seen
from survey.water.surface import plane_under

if TYPE_CHECKING:
    from geo.frames import LocalFrame
    from refract import FlatWater, PinholeCamera
    from survey.export.bed_cells import BedRaster
    from survey.export.loaded import LoadedRun
    from survey.export.product import ExportOptions
    from survey.run.stored import StoredBed

# Codes of cells without a point; 0 is everything else: bed found, dry ground, or seen by no view.
TWO_VIEWS, ONE_VIEW = 1, 2
REASONS = {
    TWO_VIEWS: "two or more views, no bed found: turbid, too deep, glint, or without texture",
    ONE_VIEW: "one view only",
}
CLASS_WATER_SURFACE, CLASS_NO_BOTTOM = 41, 45
_PLACES_OF_SIDE = 12
# Iterations for the intersection of a ray with the bed; the last one moves it by less than a cell.
_STEPS = 30
# Shorter lines, in cells, are noise of single cells.
SHORTEST = 8.0
# Contours where no interval is asked for, about.
_ABOUT = 10
# More contours result from a mistaken interval.
_MOST_LEVELS = 1000
_ROUND = (1.0, 2.0, 5.0, 10.0)


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
        local = self.frame.local_from_crs(points_crs)
        rows, columns = self.codes.shape
        at = (local[..., :2] - self.cells.low) / self.cells.cell_m
        inside = ((at >= 0.0) & (at < (columns, rows))).all(axis=-1)
        return np.where(inside, self.codes[self.cells.index(np.where(inside[..., None], local, 0.0))], 0).astype(
            np.uint8
        )


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


def with_unseen(run: LoadedRun, stored: StoredBed, crs: str | None) -> tuple[StoredBed, np.ndarray]:
    """The cloud, in a CRS or that of the survey, with two points for each cell without a bed; the classes (N,) of all.

    Both stand on the water over the middle of the cell, black, without depth and standard deviation: `CLASS_NO_BOTTOM`,
    and `CLASS_WATER_SURFACE`.
    """
    from fields.sweep.bed import BedPoints
    from geo.las import classes_of

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
    classes = [classes_of(bed.wet), np.full(number, CLASS_NO_BOTTOM), np.full(number, CLASS_WATER_SURFACE)]
    common = stored.std_common
    with_all = replace(
        stored,
        bed=BedPoints.concatenate([bed, added, added]),
        points_crs=np.concatenate([stored.points_crs, points, points]),
        std_common=None if common is None else np.concatenate([common, unknown, unknown]),
        std_placed=None,
    )
    return with_all, np.concatenate(classes).astype(np.uint8)


def footprints(run: LoadedRun, options: ExportOptions) -> Layer:
    """The border of each photograph on the bed, through the water; occlusion is ignored."""
    flight = run.flight
    cameras = [view.camera for view in flight.views]
    xyz = run.columns("xyz")["xyz"]
    cells = cells_seen(cameras, flight.water, flight.departure, None, xyz, run.bed_header.gsd_m)
    shapes, names, areas, lost = [], [], [], []
    for view in flight.views:
        ring = _on_bed(view.camera, plane_under(flight.water, flight.departure, view.camera.centre), cells)
        if ring is None:
            lost.append(view.name)
            continue
        x, y = ring[:, :2].T
        areas.append(round(0.5 * abs(float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())), 3))
        names.append(view.name)
        shapes.append([_in_crs(run, options, ring)])
    if lost:
        current().warn(f"{len(lost)} photographs show the horizon and have no footprint, e.g. {lost[0]}")
    columns: dict[str, list] = {"image": names, "area_m2": areas}
    about = "borders of the photographs on the bed, through the water; beyond the points, at the height of the nearest"
    return Layer("footprints", "Polygon", shapes, run.crs_for(options.crs), columns, about)


def _on_bed(camera: PinholeCamera, water: FlatWater | None, cells: SeenCells) -> np.ndarray | None:
    """The border of an image on the bed, closed (N, 3) [m], local; None where a ray of it does not come down."""
    w, h = camera.width, camera.height
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    share = np.linspace(0.0, 1.0, _PLACES_OF_SIDE, endpoint=False)[:, None]
    border = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    path = camera.paths(border, water)
    height = np.full(len(border), float(cells.height[cells.index(camera.centre)]))
    if water is not None:
        height -= float(water.height(*camera.centre[:2]))
    for _ in range(_STEPS):
        places = path.at_height(height, water)
        if not np.isfinite(places).all():
            return None
        bed = cells.height[cells.index(places)]
        over = bed if water is None else bed - water.height(places[:, 0], places[:, 1])
        # Damped by half: full steps oscillate on steep ground.
        height = 0.5 * (height + over)
    return np.concatenate([places, places[:1]])


def unseen_areas(run: LoadedRun, options: ExportOptions) -> Layer:
    """Polygons of the cells of water without a bed, with the reason as far as it is known."""
    from rasterio.features import shapes as polygons_of
    from rasterio.transform import Affine

    unseen = unseen_of(run)
    cells, codes = unseen.cells, unseen.codes
    (west, south), side = cells.low, cells.cell_m
    transform = Affine(side, 0.0, west, 0.0, side, south)  # rows run to the north
    shapes, views, reasons, areas = [], [], [], []
    for polygon, code in polygons_of(codes, mask=codes > 0, transform=transform):
        rings = [np.array(ring) for ring in polygon["coordinates"]]
        heights = (unseen.level[cells.index(ring)] for ring in rings)
        shapes.append([_in_crs(run, options, np.column_stack(pair)) for pair in zip(rings, heights, strict=True)])
        views.append("one" if code == ONE_VIEW else "two or more")
        reasons.append(REASONS[int(code)])
        signed = (0.5 * float((r[:-1, 0] * r[1:, 1] - r[1:, 0] * r[:-1, 1]).sum()) for r in rings)
        areas.append(round(abs(sum(signed)), 3))
    columns: dict[str, list] = {"views": views, "reason": reasons, "area_m2": areas}
    about = f"water that was looked at and in which no bed was found, in cells of {side:g} m"
    return Layer("unseen", "Polygon", shapes, run.crs_for(options.crs), columns, about)


def _in_crs(run: LoadedRun, options: ExportOptions, local: np.ndarray) -> np.ndarray:
    """Points (N, 3) [m], local, in plan (N, 2) in the CRS that is asked for."""
    points = run.flight.frame.crs_from_local(local)
    return (points if options.crs is None else run.transformation_to(options.crs)(points))[:, :2]


def write_mask(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Write the codes of its causes as GeoTIFF, 0 where the terrain model has a height.

    It covers what the terrain model covers, so that both lie upon each other; what lies beyond is in the polygons only.
    """
    grid, unseen = bed_raster(run, options), unseen_of(run)
    corner = np.array([[grid.cells.west, grid.cells.north]])
    back = Transformation.between(grid.cells.crs, run.bed_header.crs, corner)
    level = float(unseen.frame.origin[2])

    def values(window: CellWindow) -> np.ndarray:
        east, north = back(*np.moveaxis(grid.cells.middles(window), -1, 0))
        codes = unseen.codes_at(np.stack([east, north, np.full(window.shape, level)], axis=-1))
        return np.where(grid.origin[window.slices] > 0, 0, codes).astype(np.uint8)[None]

    tags = {f"CODE_{code}": reason for code, reason in REASONS.items()} | {"CODE_0": "everything else"}
    band = RasterBand("no bed found", "code")
    form = raster_form(grid, band, tags=tags, dtype="uint8", nodata=None, resampling="NEAREST")
    write_cog(path, form, parts_of(grid, values))


def contours(run: LoadedRun, options: ExportOptions) -> Layer:
    """Lines of equal depth; of equal height in a dry survey."""
    grid = bed_raster(run, options)
    all_cells = _whole(grid)
    is_dry = grid.level is None
    values = grid.heights(all_cells) if is_dry else grid.depths(all_cells)
    require_interval(options)
    step = _interval(values, options.interval_m)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if (high - low) / step > _MOST_LEVELS:
        raise SurveyError(
            f"--interval {step:g} makes over {_MOST_LEVELS} contours from {low:.2f} to {high:.2f} m; give a larger one"
        )
    levels = [number * step for number in range(math.ceil(low / step), math.floor(high / step) + 1)]
    lines, depths = [], []
    for level in levels:
        found = _lines(grid, values, level)
        lines += found
        depths += [round(level, 6)] * len(found)
    name = "height_m" if is_dry else "depth_m"
    about = f"every {step:g} m, in cells of {grid.cells.side_m:g} m; depths count down from the water"
    return Layer("contours", "LineString", lines, grid.cells.crs, {name: depths}, about, _heights(grid, lines, depths))


def shoreline(run: LoadedRun, options: ExportOptions) -> Layer:
    """The line of depth zero, where the bed was found on both sides of it."""
    require_wet(run)
    grid = bed_raster(run, options)
    lines = _lines(grid, grid.depths(_whole(grid)), 0.0)
    about = f"where the bed meets the water of the survey, in cells of {grid.cells.side_m:g} m"
    depths = [0.0] * len(lines)
    heights = _heights(grid, lines, depths)
    return Layer("shoreline", "LineString", lines, grid.cells.crs, {"depth_m": depths}, about, heights)


def require_wet(run: LoadedRun) -> None:
    """Raise SurveyError for a dry survey."""
    if not np.isfinite(run.columns("depth")["depth"]).any():
        raise SurveyError(f"{run.bed_header.name} is a dry survey and has no shoreline; leave --shoreline out")


def require_interval(options: ExportOptions) -> None:
    """Raise SurveyError where the interval of contours is none."""
    asked = options.interval_m
    if asked is not None and not (math.isfinite(asked) and asked > 0.0):
        raise SurveyError(f"--interval is {asked:g}, expected metres between contours, e.g. 0.25")


def _heights(grid: BedRaster, lines: list[np.ndarray], values: list[float]) -> list[np.ndarray]:
    """Heights (N,) in crs along lines of one depth, or of one height in a dry survey [m]."""
    level = grid.level
    return [
        (np.full(len(line), value) if level is None else level(line) - value) / grid.height_unit_m
        for line, value in zip(lines, values, strict=True)
    ]


def _whole(grid: BedRaster) -> CellWindow:
    rows, columns = grid.cells.shape
    return CellWindow(0, rows, 0, columns)


def _lines(grid: BedRaster, values: np.ndarray, level: float) -> list[np.ndarray]:
    """Lines (N, 2) in crs through the middles of cells; they end where cells have no height."""
    if min(values.shape) < 2:
        return []
    found = [np.asarray(line) for line in contourpy.contour_generator(z=np.ma.masked_invalid(values)).lines(level)]
    lengths = (np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in found)
    west, north, side = grid.cells.west, grid.cells.north, np.array(grid.cells.side)
    corner = np.array([west + 0.5 * side[0], north - 0.5 * side[1]])
    return [
        corner + line * side * np.array([1.0, -1.0])
        for line, length in zip(found, lengths, strict=True)
        if length >= SHORTEST
    ]


def _interval(values: np.ndarray, asked: float | None) -> float:
    """Interval of contours [m]: the one asked for, or a round number that gives about ten."""
    if asked is not None:
        return asked
    low, high = np.nanquantile(values, [0.02, 0.98])
    return round_up(max(float(high - low), 1e-3) / _ABOUT, _ROUND)
