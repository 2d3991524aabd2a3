"""Footprints of photographs on the bed, areas of water without a bed, and their mask."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.raster_writing import Band, write_cog
from geo.transformation import Transformation
from geo.vectors import Layer
from survey.export.gridded import gridded
from survey.export.terrain import parts_of, raster_form
from survey.export.unseen import REASONS, unseen_of
from survey.progress import current
from survey.report.seen_cells import cells_seen

if TYPE_CHECKING:
    from pyproj import CRS

    from refract import FlatWater, PinholeCamera
    from survey.export.loaded import LoadedRun
    from survey.export.plan_cells import Window
    from survey.export.product import ExportOptions
    from survey.report.seen_cells import SeenCells

_PLACES_OF_SIDE = 12
# Of the search for the place where a ray meets the bed; the last moves it by less than a cell.
_STEPS = 30


def footprints(run: LoadedRun, options: ExportOptions) -> Layer:
    """The border of each photograph on the bed, through the water; occlusion is ignored.

    Raises
    ------
    SurveyError
        If the run was made before runs kept their cameras.
    """
    flight = run.flight
    cameras = [view.camera for view in flight.views]
    xyz = run.columns("xyz")["xyz"]
    cells = cells_seen(cameras, flight.water, None, xyz, run.place.gsd_m)
    shapes, names, areas, lost = [], [], [], []
    for view in flight.views:
        ring = _on_bed(view.camera, flight.water, cells)
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
    about = "borders of the photographs on the bed, through the water; the bed beyond its points as high as the nearest"
    return Layer("footprints", "Polygon", shapes, _crs(run, options), columns, about)


def _on_bed(camera: PinholeCamera, water: FlatWater | None, cells: SeenCells) -> np.ndarray | None:
    """The border of an image on the bed, closed (N, 3) [m], local; None where a ray of it does not come down."""
    w, h = camera.width, camera.height
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    share = np.linspace(0.0, 1.0, _PLACES_OF_SIDE, endpoint=False)[:, None]
    border = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    path = camera.paths(border, water)
    height = np.full(len(border), float(np.median(cells.height)))
    if water is not None:
        height -= float(water.height(*cells.middles[..., :2].reshape(-1, 2).mean(axis=0)))
    for _ in range(_STEPS):
        places = path.at_height(height, water)
        if not np.isfinite(places).all():
            return None
        bed = cells.height[cells.index(places)]
        over = bed if water is None else bed - water.height(places[:, 0], places[:, 1])
        # Half a step: on steep ground a whole one jumps to and fro.
        height = 0.5 * (height + over)
    return np.concatenate([places, places[:1]])


def unseen_areas(run: LoadedRun, options: ExportOptions) -> Layer:
    """Polygons of the cells that `survey.export.unseen` has, with the reason as far as it is known."""
    from rasterio.features import shapes as polygons_of
    from rasterio.transform import Affine

    unseen = unseen_of(run)
    cells, codes = unseen.cells, unseen.codes
    (west, south), side = cells.low, cells.cell_m
    away = Affine(side, 0.0, west, 0.0, side, south)  # rows run to the north
    shapes, views, reasons, areas = [], [], [], []
    for polygon, code in polygons_of(codes, mask=codes > 0, transform=away):
        rings = [np.array(ring) for ring in polygon["coordinates"]]
        heights = (unseen.level[cells.index(ring)] for ring in rings)
        shapes.append([_in_crs(run, options, np.column_stack(pair)) for pair in zip(rings, heights, strict=True)])
        views.append("one" if REASONS[int(code)].startswith("one") else "two or more")
        reasons.append(REASONS[int(code)])
        signed = (0.5 * float((r[:-1, 0] * r[1:, 1] - r[1:, 0] * r[:-1, 1]).sum()) for r in rings)
        areas.append(round(abs(sum(signed)), 3))
    columns: dict[str, list] = {"views": views, "reason": reasons, "area_m2": areas}
    about = f"water that was looked at and in which no bed was found, in cells of {side:g} m"
    return Layer("unseen", "Polygon", shapes, _crs(run, options), columns, about)


def _in_crs(run: LoadedRun, options: ExportOptions, local: np.ndarray) -> np.ndarray:
    """Points (N, 3) [m], local, in plan (N, 2) in the CRS that is asked for."""
    points = run.flight.frame.crs_from_local(local)
    return (points if options.crs is None else run.way_to(options.crs)(points))[:, :2]


def _crs(run: LoadedRun, options: ExportOptions) -> CRS:
    return run.place.crs if options.crs is None else run.way_to(options.crs).crs


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
