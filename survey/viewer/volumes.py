"""Volumes in a polygon on the bed: of the water over it, and of the bed over and under a plane through the corners."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from geo.grid import Grid
from geo.vectors import Layer, write_geojson
from survey.display.quantities import area, share, volume
from survey.errors import SurveyError
from survey.export.bed_raster import seen_from_above
from survey.viewer.shown import Shown

# Side of a cell [ground sampling distances], as of a terrain model.
_SIDE_GSD = 4.0
_LABELS = {
    "area_m2": ("area", area),
    "with_points_m2": ("of it in cells with points", area),
    "covered_share": ("share of the area that the volumes cover", share),
    "bed_over_plane_m3": ("bed over the plane", volume),
    "bed_under_plane_m3": ("bed under the plane", volume),
    "water_m3": ("water over the bed", volume),
    "water_std_m3": ("its standard deviation by errors that all heights share", volume),
}


def volumes_in(shown: Shown, corners: np.ndarray) -> dict[str, float | None]:
    """Areas and volumes, by names with units, in a polygon (C, 3) [m], local.

    Each cell that holds points counts by its area in the polygon, others do not: see ``covered_share``.

    The plane is the least-squares fit to the corners. The standard deviation of the water is that by the errors which
    all heights share, None where unknown. Raises SurveyError where no point of the bed is in the polygon.
    """
    assert shown.edits is not None
    rows = shown.edits.inside(shown.new_frame().crs_from_local(corners)[:, :2])
    rows = rows[shown.edits.is_bed[rows]]
    if not len(rows):
        raise SurveyError("no point of the bed lies in the polygon; set its corners about some")
    points, unknown = shown.tree.points, np.full(len(shown.tree.points), np.nan)
    std = np.nan_to_num(shown.columns.get("std", unknown)[rows])
    rows = rows[seen_from_above(points[rows, :2], points[rows, 2], std, shown.gsd_m)[0]]
    points = points[rows]

    plan, side_m = corners[:, :2], _SIDE_GSD * shown.gsd_m
    grid = Grid.southward_from(plan.min(axis=0), plan.max(axis=0), side_m)
    cell = np.ravel_multi_index(grid.index(points), grid.shape)
    counts = np.bincount(cell, minlength=grid.shape[0] * grid.shape[1])
    polygon = shapely.make_valid(shapely.Polygon(plan))
    used = counts > 0
    west, south = (grid.middles().reshape(-1, 2)[used] - 0.5 * side_m).T
    area_m2 = shapely.area(shapely.intersection(shapely.box(west, south, west + side_m, south + side_m), polygon))

    def volumes(heights: np.ndarray) -> tuple[float, float, float]:
        """Of heights (N,) of the points over zero: volumes over and under it [m³], and the area of the first [m²]."""
        found = area_m2 * np.bincount(cell, heights, len(counts))[used] / counts[used]
        over, under = np.maximum(found, 0.0).sum(), np.maximum(-found, 0.0).sum()
        return float(over), float(under), float(area_m2[found > 0.0].sum())

    plane, *_ = np.linalg.lstsq(np.column_stack([plan, np.ones(len(plan))]), corners[:, 2])
    over_m3, under_m3, _ = volumes(points[:, 2] - points[:, :2] @ plane[:2] - plane[2])
    found: dict[str, float | None] = {
        "area_m2": polygon.area,
        "with_points_m2": float(area_m2.sum()),
        "covered_share": float(area_m2.sum() / polygon.area),
        "bed_over_plane_m3": over_m3,
        "bed_under_plane_m3": under_m3,
    }
    if "depth" in shown.columns:
        found["water_m3"], _, wet_m2 = volumes(shown.columns["depth"][rows])
        shared_m = float(np.mean(shown.columns.get("std_common", unknown)[rows]))
        found["water_std_m3"] = wet_m2 * shared_m if np.isfinite(shared_m) else None
    return found


def volume_rows(found: dict[str, float | None]) -> list[tuple[str, str]]:
    """What `volumes_in` finds as labels and texts."""
    return [(_LABELS[name][0], _LABELS[name][1](value)) for name, value in found.items() if value is not None]


def write_volumes(path: Path, shown: Shown, measured: Sequence[tuple[np.ndarray, dict[str, float | None]]]) -> None:
    """Polygons (C, 3) [m], local, with what `volumes_in` finds of each, as GeoJSON."""
    frame = shown.new_frame()
    rings = [[frame.crs_from_local(corners[[*range(len(corners)), 0]])[:, :2]] for corners, _ in measured]
    names = measured[0][1]
    columns = {name: [None if (v := found[name]) is None else round(v, 4) for _, found in measured] for name in names}
    write_geojson(path, Layer("volumes", "Polygon", rings, frame.crs, columns))
