"""Lines and areas of a run: footprints of the photographs, shoreline, contours; layers written by their suffix."""

from __future__ import annotations

import math
from pathlib import Path

import contourpy
import numpy as np
from shapely import Polygon

from geo import vectors
from geo.vectors import Layer
from refract import FlatWater, PinholeCamera
from survey.display.quantities import round_up
from survey.errors import SurveyError
from survey.export.bed_cells import BedRaster
from survey.export.bed_raster import bed_raster
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions
from survey.progress import current
from survey.report.seen_cells import SeenCells, cells_seen
from survey.water.surface import plane_under

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


def write_layer(path: Path, layer: Layer) -> None:
    """Write a layer in the format of the suffix, and note where it is empty."""
    if not layer.shapes:
        current().note(f"{path}: nothing to show, the layer {layer.name} is empty")
    match path.suffix.lower():
        case ".gpkg":
            vectors.write_geopackage(path, layer)
        case ".dxf":
            vectors.write_dxf(path, vectors.lines_of(layer), layer.crs)
        case ".zip":
            vectors.write_shapefile(path, layer)
        case _:
            if (warning := vectors.write_geojson(path, layer)) is not None:
                current().warn(warning)


def check_layer(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise GeoError where the format of a layer cannot hold the CRS."""
    suffix, crs = path.suffix.lower(), run.crs_for(options.crs)
    if suffix == ".dxf":
        vectors.require_drawable(path, crs)
    elif suffix == ".geojson":
        place = run.some_place if options.crs is None else run.transformation_to(options.crs)(run.some_place)
        vectors.require_wgs84(path, crs, place[:, :2])


def check_seen(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The same of a layer that needs the cameras."""
    _ = run.flight
    check_layer(path, run, options)


check_footprints = check_seen


def write_footprints(path: Path, run: LoadedRun, options: ExportOptions) -> None:
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
        areas.append(round(Polygon(ring[:, :2]).area, 3))
        names.append(view.name)
        shapes.append([in_crs(run, options, ring)])
    if lost:
        current().warn(f"{len(lost)} photographs show the horizon and have no footprint, e.g. {lost[0]}")
    columns: dict[str, list] = {"image": names, "area_m2": areas}
    about = "borders of the photographs on the bed, through the water; beyond the points, at the height of the nearest"
    write_layer(path, Layer("footprints", "Polygon", shapes, run.crs_for(options.crs), columns, about))


def _on_bed(camera: PinholeCamera, water: FlatWater | None, cells: SeenCells) -> np.ndarray | None:
    """The border of an image on the bed, closed (N, 3) [m], local; None where a ray of it does not come down."""
    w, h = camera.width, camera.height
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    share = np.linspace(0.0, 1.0, _PLACES_OF_SIDE, endpoint=False)[:, None]
    border = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    path = camera.paths(border, water)
    height = np.full(len(border), float(cells.height[cells.grid.index(camera.centre)]))
    if water is not None:
        height -= float(water.height(*camera.centre[:2]))
    for _ in range(_STEPS):
        places = path.at_height(height, water)
        if not np.isfinite(places).all():
            return None
        bed = cells.height[cells.grid.index(places)]
        over = bed if water is None else bed - water.height(places[:, 0], places[:, 1])
        # Damped by half: full steps oscillate on steep ground.
        height = 0.5 * (height + over)
    return np.concatenate([places, places[:1]])


def in_crs(run: LoadedRun, options: ExportOptions, local: np.ndarray) -> np.ndarray:
    """Points (N, 3) [m], local, in plan (N, 2) in the CRS that is asked for."""
    points = run.flight.frame.crs_from_local(local)
    return (points if options.crs is None else run.transformation_to(options.crs)(points))[:, :2]


check_contours = check_layer


def write_contours(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Lines of equal depth; of equal height in a dry survey."""
    grid = bed_raster(run, options)
    is_dry = grid.level is None
    values = grid.heights(grid.cells.whole) if is_dry else grid.depths(grid.cells.whole)
    step = options.interval_m
    if step is None:
        # A round number that gives about ten.
        low, high = np.nanquantile(values, [0.02, 0.98]).tolist()
        step = round_up(max(high - low, 1e-3) / _ABOUT, _ROUND)
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
    _write_lines(path, "contours", grid, lines, {name: depths}, about)


def write_shoreline(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The line of depth zero, where the bed was found on both sides of it."""
    grid = bed_raster(run, options)
    lines = _lines(grid, grid.depths(grid.cells.whole), 0.0)
    about = f"where the bed meets the water of the survey, in cells of {grid.cells.side_m:g} m"
    _write_lines(path, "shoreline", grid, lines, {"depth_m": [0.0] * len(lines)}, about)


def check_shoreline(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError for a dry survey, else as `check_layer`."""
    if not np.isfinite(run.columns("depth")["depth"]).any():
        raise SurveyError(f"{run.bed_header.name} is a dry survey and has no shoreline; leave --shoreline out")
    check_layer(path, run, options)


def _write_lines(
    path: Path, name: str, grid: BedRaster, lines: list[np.ndarray], column: dict[str, list[float]], about: str
) -> None:
    """Write lines with the depth of each, or the height in a dry survey [m], in a column; heights (N,) are in crs."""
    ((_, values),) = column.items()
    heights = [
        (np.full(len(line), value) if grid.level is None else grid.level(line) - value) / grid.height_unit_m
        for line, value in zip(lines, values, strict=True)
    ]
    write_layer(path, Layer(name, "LineString", lines, grid.cells.crs, dict(column), about, heights))


def _lines(grid: BedRaster, values: np.ndarray, level: float) -> list[np.ndarray]:
    """Lines (N, 2) in crs through the middles of cells; they end where cells have no height."""
    if min(values.shape) < 2:
        return []
    found = [np.asarray(line) for line in contourpy.contour_generator(z=np.ma.masked_invalid(values)).lines(level)]
    lengths = (np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in found)
    step = np.array(grid.cells.step)
    corner = np.array(grid.cells.origin) + 0.5 * step
    return [corner + line * step for line, length in zip(found, lengths, strict=True) if length >= SHORTEST]
