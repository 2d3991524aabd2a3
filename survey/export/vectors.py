"""Lines and areas of a run: footprints, shoreline, contours, water without a bed; layers written by their suffix.

Water without a bed was looked at, and no bed found in it: its cells with their causes, as areas or points.
"""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import contourpy
import numpy as np
from rasterio.features import shapes as polygons_of
from rasterio.transform import Affine
from shapely import Polygon

from fields.sweep.bed import BedPoints
from geo import vectors
from geo.grid import Grid
from geo.las import CLASS_NO_BOTTOM, CLASS_WATER_SURFACE
from geo.raster import RasterBand, RasterForm, write_cog
from geo.vectors import Layer
from refract import FlatWater, PinholeCamera
from survey.display.quantities import round_up
from survey.errors import SurveyError
from survey.export.bed_raster import BedRaster, bed_raster
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions
from survey.plan.area import local_area
from survey.progress import current
from survey.report.seen_cells import DELETED, ONE_VIEW, REASONS, TWO_VIEWS, SeenCells, cells_seen
from survey.run.folder import GAPS
from survey.run.stored import StoredBed, load_arrays
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
        vectors.require_wgs84(path, crs, run.some_place_in(options.crs)[:, :2])


def _check_seen(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The same of a layer that needs the cameras."""
    _ = run.flight
    check_layer(path, run, options)


check_contours, check_footprints, check_unseen = check_layer, _check_seen, _check_seen


def footprints_of(run: LoadedRun, options: ExportOptions) -> Layer:
    """The border of each photograph on the bed, through the water; occlusion is ignored."""
    flight = run.flight
    cells = _cells(run, None)
    shapes, names, areas, lost = [], [], [], []
    for view in flight.views:
        ring = _on_bed(view.camera, plane_under(flight.water, flight.departure, view.camera.centre), cells)
        if ring is None:
            lost.append(view.name)
            continue
        areas.append(round(Polygon(ring[:, :2]).area, 3))
        names.append(view.name)
        shapes.append([_in_plan(run, options, ring)])
    if lost:
        current().warn(f"{len(lost)} photographs show the horizon and have no footprint, e.g. {lost[0]}")
    columns: dict[str, list] = {"image": names, "area_m2": areas}
    about = "borders of the photographs on the bed, through the water; beyond the points, at the height of the nearest"
    return Layer("footprints", "Polygon", shapes, run.crs_for(options.crs), columns, about)


def _cells(run: LoadedRun, area: tuple[float, float, float, float] | None) -> SeenCells:
    flight, xyz = run.flight, run.columns("xyz")["xyz"]
    cameras = [view.camera for view in flight.views]
    return cells_seen(cameras, flight.water, flight.departure, area, xyz, run.bed_header.gsd_m)


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


def _in_plan(run: LoadedRun, options: ExportOptions, local: np.ndarray) -> np.ndarray:
    """Points (N, 3) [m], local, in plan (N, 2) in the CRS that is asked for."""
    return run.in_crs(run.flight.frame.crs_from_local(local), options.crs)[:, :2]


def contours_of(run: LoadedRun, options: ExportOptions) -> Layer:
    """Lines of equal depth; of equal height in a dry survey."""
    grid = bed_raster(run, options)
    values = (grid.heights if grid.level is None else grid.depths)(grid.cells.whole)
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
    about = f"every {step:g} m, in cells of {grid.cells.side_m:g} m; depths count down from the water"
    return _lines(Layer("contours", "LineString", [], grid.cells.crs, notes=about), grid, values, levels)


def shoreline_of(run: LoadedRun, options: ExportOptions) -> Layer:
    """The line of depth zero, where the bed was found on both sides of it."""
    grid = bed_raster(run, options)
    about = f"where the bed meets the water of the survey, in cells of {grid.cells.side_m:g} m"
    layer = Layer("shoreline", "LineString", [], grid.cells.crs, notes=about)
    return _lines(layer, grid, grid.depths(grid.cells.whole), [0.0])


def check_shoreline(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError for a dry survey, else as `check_layer`."""
    if run.is_dry:
        raise SurveyError(f"{run.bed_header.name} is a dry survey and has no shoreline; leave --shoreline out")
    check_layer(path, run, options)


def _lines(layer: Layer, grid: BedRaster, values: np.ndarray, levels: list[float]) -> Layer:
    """A layer with lines of equal values (rows, columns) [m], depths or, in a dry survey, heights; heights in crs.

    They run through the middles of cells, and end where cells have no height.
    """
    lines, depths, heights = [], [], []
    step = np.array(grid.cells.step)
    corner = np.array(grid.cells.origin) + 0.5 * step
    # A raster of one row or column gets another without values.
    generator = contourpy.contour_generator(z=np.ma.masked_invalid(np.pad(values, (0, 1), constant_values=np.nan)))
    for level in levels:
        for line in map(np.asarray, generator.lines(level)):
            if np.linalg.norm(np.diff(line, axis=0), axis=1).sum() >= SHORTEST:
                places = corner + line * step
                lines.append(places)
                depths.append(round(level, 6))
                height = np.full(len(line), level) if grid.level is None else grid.level(places) - level
                heights.append(height / grid.height_unit_m)
    name = "height_m" if grid.level is None else "depth_m"
    return replace(layer, shapes=lines, columns={name: depths}, heights=heights)


def seen_of(run: LoadedRun) -> SeenCells:
    """The cells of a run with the reasons that it has stored, made once for the products of a command.

    A cell is ten ground sampling distances wide (`survey.report.seen_cells`), and seen where its middle is.
    """
    return run.once("seen", lambda: _with_stored_reasons(run, _cells(run, local_area(run.flight))))


def unseen_of(run: LoadedRun) -> np.ndarray:
    """Codes (rows, columns) uint8 of `seen_of` in water, where the nearest bed lies under it; 0 on dry ground."""
    cells = seen_of(run)
    return np.where(cells.height < run.flight.level(cells.middles[..., :2]), cells.gaps, 0).astype(np.uint8)


def _with_stored_reasons(run: LoadedRun, cells: SeenCells) -> SeenCells:
    """The cells with the reasons that `bathynerf process` found; without them, where an older version made the run."""
    path = run.folder.path / GAPS
    if not path.is_file():
        return cells
    stored, gaps = load_arrays(path), cells.gaps
    grid = Grid.northward_from(stored["origin"], float(stored["side"]), stored["codes"].shape)
    known = stored["codes"][grid.index(cells.middles)]
    # What had a point in the run has none by edits.
    reasons = np.where(known > 0, known, TWO_VIEWS if run.edits is None else DELETED)
    return replace(cells, reasons=np.where(gaps == TWO_VIEWS, reasons, gaps).astype(np.uint8))


def write_gaps(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Reasons for which ground inside the bounds has no point, wet or dry, as GeoTIFF; 0 is all other ground."""
    cells = seen_of(run)
    tags = {f"CODE_{code}": reason for code, reason in REASONS.items()} | {"CODE_0": "everything else"}
    grid, codes = cells.in_crs(cells.gaps, run.flight.frame)
    for code, count in zip(*np.unique(cells.gaps[cells.gaps > 0], return_counts=True), strict=True):
        tags[f"AREA_{code}_M2"] = f"{cells.grid.side_m**2 * count:.6g}"
    band = RasterBand("reason for no bed", "code")
    form = RasterForm(grid.crs, grid.transform, grid.shape, (band,), "uint8", tags=tags, resampling="NEAREST")
    write_cog(path, form, [(0, 0, codes[None])])


def with_unseen(
    run: LoadedRun, stored: StoredBed, classes: np.ndarray, crs: str | None
) -> tuple[StoredBed, np.ndarray]:
    """The cloud, in a CRS or that of the survey, with two points for each cell without a bed; the classes (N,) of all.

    Both stand on the water over the middle of the cell, black, without depth and standard deviation: `CLASS_NO_BOTTOM`,
    and `CLASS_WATER_SURFACE`.
    """
    cells, bed, missing = seen_of(run), stored.bed, unseen_of(run) > 0
    number = int(missing.sum())
    xyz = cells.middles[missing]
    xyz[:, 2] = run.flight.level(xyz[:, :2])
    views = cells.num_views[missing].clip(max=255).astype(bed.num_views.dtype)
    unknown = np.full(number, np.nan, dtype=np.float32)
    some = bed[np.zeros(number, dtype=np.int64)]
    added = replace(
        some, xyz=xyz, rgb=np.zeros_like(some.rgb), std=unknown, num_views=views, depth=unknown, incidence=unknown
    )
    points = run.in_crs(run.flight.frame.crs_from_local(xyz), crs)
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


def unseen_areas(run: LoadedRun, options: ExportOptions) -> Layer:
    """Polygons of the cells of water without a bed, with the reason as far as it is known."""
    cells, codes = seen_of(run), unseen_of(run)
    shapes, views, reasons, areas = [], [], [], []
    for polygon, code in polygons_of(codes, mask=codes > 0, transform=Affine(*cells.grid.transform)):
        rings = [np.array(ring) for ring in polygon["coordinates"]]
        heights = (cells.height[cells.grid.index(ring)] for ring in rings)
        shapes.append([_in_plan(run, options, np.column_stack(pair)) for pair in zip(rings, heights, strict=True)])
        views.append("one" if code == ONE_VIEW else "two or more")
        reasons.append(REASONS[int(code)])
        areas.append(round(Polygon(rings[0], rings[1:]).area, 3))
    columns: dict[str, list] = {"views": views, "reason": reasons, "area_m2": areas}
    about = f"water that was looked at and in which no bed was found, in cells of {cells.grid.side_m:g} m"
    return Layer("unseen", "Polygon", shapes, run.crs_for(options.crs), columns, about)


LAYERS = {"footprints": footprints_of, "shoreline": shoreline_of, "contours": contours_of, "unseen": unseen_areas}


def _write(name: str, path: Path, run: LoadedRun, options: ExportOptions) -> None:
    write_layer(path, LAYERS[name](run, options))


write_footprints, write_shoreline, write_contours, write_unseen = (partial(_write, name) for name in LAYERS)
