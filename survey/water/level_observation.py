"""Measurements of the water level on site, with std, place and time: whether they lie near the cameras.

survey.toml              level_m, level_std_m
shoreline, gnss_points   CSV with easting, northing, height in crs (and std), or a vector file
surface                  the same, or a raster of heights
gauge                    a series of levels: `survey.water.gauge_files`
image_levels             CSV with image, level (and std): `survey.water.tides`
clicks                   CSV with image, x, y, name: places on the waterline, each marked in two photographs or more,
                         where rays, straight as they run in air alone, meet
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from pyproj import CRS
from scipy.spatial import KDTree

from geo.crs import EARTH_RADIUS_M, height_unit_m, horizontal_crs, middle_lon_lat
from geo.features import SUFFIXES
from geo.frames import LocalFrame
from geo.reading import read_reference
from geo.shapes import in_height_unit, vertices_of
from geo.transformation import height_scale, lon_lat, transformed
from survey.display.quantities import distance_text
from survey.errors import ConfigError, Findings
from survey.files.csv_table import Row, read_table
from survey.files.point_table import Units, accuracy_warnings, height_std, point_table, read_points
from survey.photos.cameras import View, intersect
from survey.photos.poses import ImageNames
from survey.settings.config import WaterConfig
from survey.water.surface_features import layers_named, points_of_features, require_one_water

# Standard deviation of a measurement whose file gives none [m]: GNSS with corrections on the surface, and at the
# waterline, which waves move; a reading.
STD_M = {"shoreline": 0.03, "gnss_points": 0.02, "surface": 0.02, "gauge": 0.01, "image_levels": 0.01}
# Std of the error that all measurements of a source share, which averaging does not reduce [m]: base station and
# antenna height; wet land above the level; gauge zero, also for levels of photographs.
COMMON_STD_M = {
    "shoreline": 0.02, "gnss_points": 0.015, "surface": 0.015, "gauge": 0.01, "image_levels": 0.01, "clicks": 0.0,
}  # fmt: skip
_RASTER = (".tif", ".tiff")
# Cells of a raster beyond this number are means of squares of them.
_MOST_CELLS, _FINER = 40_000, 0.8
# Std of a cell relative to its neighbours; the error that they share is common.
_CELL_STD_M = 0.002
MOST_STD_M = 10.0
# Of a click [px]: the edge of water is rarely sharp. With residuals beyond so many of them clicks are not of one place.
CLICK_STD_PX, _MOST_MISS = 2.0, 5.0
# Distances from the nearest camera: beyond the first, places are not of this survey; beyond the second, they may be on
# another water body.
FARTHEST_M, DOUBTFUL_M = 20e3, 2e3


@dataclass(frozen=True)
class LevelObservation:
    """Measurement of the height of the water surface."""

    level_m: float  # [m]: in the heights of crs
    std_m: float  # [m]: standard deviation, without what it shares with others of its source (`COMMON_STD_M`)
    place: tuple[float, float] | None  # (easting, northing) in crs, or None: None where it holds for the whole water
    time: datetime | None  # In UTC; None where it holds for the whole flight
    source: str  # The key of [water] that it comes from


def points_of_surface(
    path: Path, source: str, crs: CRS, layer: str | None = None
) -> tuple[tuple[LevelObservation, ...], Findings]:
    """Points of the water surface in a CSV, a vector file or a raster, and what was assumed of them.

    Those of one layer, or of one code of a CSV, where it is named; ConfigError where a file has several whose heights
    differ.
    """
    unit = height_unit_m(crs)
    if path.suffix.lower() in (*SUFFIXES, *_RASTER):
        if path.suffix.lower() in SUFFIXES:
            (points, notes), std = points_of_features(path, crs, layer), STD_M[source]
        elif layer is not None:
            raise ConfigError(f"[water] layer is given, and {path} is a raster, which has none; remove it")
        else:
            (points, notes), std = _points_of_raster(path, crs), _CELL_STD_M
        found = (LevelObservation(h * unit, std, (e, n), None, source) for e, n, h in points.tolist())
        return tuple(found), Findings(notes)
    table = point_table(path, ConfigError)
    rows = read_points(table, optional=("std", "std_height", "layer"), units=Units.of(crs))
    heights: dict[str, list[float]] = {}
    for row in rows:
        heights.setdefault(row.cells.get("layer", ""), []).append(row.number("height"))
    if layer is not None:
        wanted = layers_named(layer, heights, path)
        rows = [row for row in rows if row.cells.get("layer", "") in wanted]
    elif 2 * len(heights) <= len(rows):
        # A text of its own for each point describes it; a code is that of several.
        require_one_water(path, heights, unit)
    measured = [
        LevelObservation(
            row.number("height") * unit,
            std_of(row, source),
            (row.number("easting"), row.number("northing")),
            None,
            source,
        )
        for row in rows
    ]
    return tuple(measured), Findings(warnings=accuracy_warnings(table))


def _points_of_raster(path: Path, crs: CRS) -> tuple[np.ndarray, tuple[str, ...]]:
    """The middles (N, 3) of the cells of a GeoTIFF, in crs, or of squares of many, and a note of that."""
    shape, message = read_reference(path), f"the heights of {path.name}"
    if shape.crs is None:
        points = vertices_of(in_height_unit(shape, height_unit_m(crs)))
    else:
        points = vertices_of(shape)
        scale = height_scale(shape.crs, crs, message, unit_m=shape.height_unit_m)
        if not horizontal_crs(shape.crs).equals(horizontal_crs(crs), ignore_axis_order=True):
            points = transformed(shape.crs, crs, points, message, "or give the raster in crs.")
        points = points * (1.0, 1.0, scale)
    if len(points) <= _MOST_CELLS:
        return points, ()
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    side, cell = float(np.sqrt(np.prod(high - low) / _MOST_CELLS)), np.zeros(0, dtype=int)
    # Water is a part of the rectangle about it.
    while len(np.unique(cell)) < _MOST_CELLS // 2:
        _, cell = np.unique(np.floor((points[:, :2] - low) / side).astype(int), axis=0, return_inverse=True)
        side *= _FINER
    count = np.bincount(cell.ravel())
    means = np.column_stack([np.bincount(cell.ravel(), column) / count for column in points.T])
    return means, (f"{path.name}: its {len(points):,} cells are averaged over squares of {side / _FINER:.3g}",)


def std_of(row: Row, source: str) -> float:
    """The standard deviation [m] of a row of a table, by default that of its source; ConfigError where it is none."""
    std = height_std(row, STD_M[source])
    if not 0.0 < std <= MOST_STD_M:
        raise ConfigError(f"{row.where}: std is {std:g}, expected above 0 and at most {MOST_STD_M:g} m; correct it")
    return std


def levels_of_clicks(
    path: Path, views: Sequence[View], frame: LocalFrame
) -> tuple[tuple[LevelObservation, ...], Findings]:
    """Heights of the water at all places that two photographs or more show; a warning is added for others.

    The file has the columns image, x, y, name, and std in pixels if it has it; the centre of the first pixel is at
    0.5, 0.5.
    """
    names, by_name = ImageNames(view.name for view in views), {view.name: view for view in views}
    places: dict[str, list[tuple[View, tuple[float, float], float]]] = {}
    num_without_pose = 0
    for row in read_table(path, ("image", "x", "y", "name"), optional=("std",), error=ConfigError):
        view = by_name.get(names.find(row.text("image"), row.where) or "")
        if view is None:
            num_without_pose += 1
            continue
        x, y, std = row.number("x"), row.number("y"), row.number("std", default=CLICK_STD_PX)
        width, height = view.camera.width, view.camera.height
        if not (0.0 <= x <= width and 0.0 <= y <= height and 0.0 < std <= 100.0):
            raise ConfigError(
                f"{row.where}: x, y, std are {x:g}, {y:g}, {std:g}, expected a pixel in {view.name} "
                f"({width} x {height}) and a std above 0 and at most 100; correct it"
            )
        places.setdefault(row.text("name"), []).append((view, (x, y), std))
    levels = {name: _level_of(clicks, frame) for name, clicks in places.items()}
    unclear = [name for name, level in levels.items() if level is None]
    warnings = []
    if num_without_pose:
        warnings.append(f"{num_without_pose} clicks of {path.name} are in photographs without a pose, and left out")
    if unclear:
        warnings.append(
            f"{len(unclear)} places of {path.name} give no level (first: {unclear[0]}), and are left out: click each "
            "in two photographs or more that see it from different sides, at the same spot"
        )
    if len(unclear) == len(levels):
        raise ConfigError(
            f"{path} has no place that two photographs with poses show, expected image,x,y,name with each name in two "
            "photographs or more; click the same spots of the waterline in several"
        )
    return tuple(level for level in levels.values() if level is not None), Findings(warnings=tuple(warnings))


def _level_of(clicks: Sequence[tuple[View, tuple[float, float], float]], frame: LocalFrame) -> LevelObservation | None:
    """Intersection of the rays of clicks, by least squares of pixels; None where they do not meet or fix no height."""
    views, pixels, given = zip(*clicks, strict=True)
    stds = np.array(given)
    intersection = intersect([view.camera for view in views], np.array(pixels), stds, None)
    if intersection is None or not np.abs(intersection.residuals / stds[:, None]).max() < _MOST_MISS:
        return None
    east, north, height = frame.crs_from_local(intersection.place).tolist()
    std = float(np.sqrt(intersection.covariance[2, 2]))
    return LevelObservation(height * height_unit_m(frame.crs), std, (east, north), None, "clicks")


def water_place_warnings(
    crs: CRS, cameras: np.ndarray, water: WaterConfig | None, levels: Iterable[LevelObservation]
) -> list[str]:
    """Warnings where places on the water lie far from the cameras (N, 2), longitude and latitude of WGS 84 [deg]."""
    cameras = cameras[np.isfinite(cameras).all(axis=1)]
    if water is None or not len(cameras):
        return []
    places: dict[str, list[tuple[float, float]]] = {}
    for level in levels:
        # Clicks are where their rays meet.
        if level.place is not None and level.source != "clicks":
            places.setdefault("level_at" if level.source == "level_m" else level.source, []).append(level.place)
    if water.level_at is not None and not places:
        places["level_at"] = [water.level_at]
    warnings = []
    for source, at in places.items():
        distance = _distances_m(crs, cameras, np.array(at))
        worst = int(np.argmax(distance))
        if distance[worst] > FARTHEST_M:
            (e, n), on_map = at[worst], f"lies {distance_text(distance[worst])} from the nearest camera in {crs.name}"
            where = on_map if np.isfinite(distance[worst]) else f"is not on the map of {crs.name}"
            remedy = "; give places on the water of this survey in crs"
            if (_distances_m(crs, cameras, np.array(at)[:, ::-1]) <= FARTHEST_M).all():
                remedy = f", and near the cameras as {n:.10g}, {e:.10g}: give easting (or longitude) first"
            raise ConfigError(f"[water] {source} has a place at {e:.10g}, {n:.10g}, which {where}{remedy}")
        if distance[worst] > DOUBTFUL_M:
            num_far, far = int((distance > DOUBTFUL_M).sum()), distance_text(DOUBTFUL_M)
            warnings.append(
                f"[water] {source}: {num_far} of {len(distance)} places lie more than {far} from all cameras, the "
                f"farthest {distance_text(distance[worst])}: check that they are on the water that the photographs show"
            )
    return warnings


def _distances_m(crs: CRS, cameras: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Distances of places (K, 2) in crs to the nearest camera [m], as on a sphere; infinite off the map."""
    degrees, middle = lon_lat(crs, places), middle_lon_lat(cameras)
    metres = EARTH_RADIUS_M * np.radians([np.cos(np.radians(middle[1])), 1.0])

    def flat(at: np.ndarray) -> np.ndarray:
        turned = at - middle
        turned[:, 0] = (turned[:, 0] + 180.0) % 360.0 - 180.0
        return turned * metres

    distance = np.full(len(places), np.inf)
    known = np.isfinite(degrees).all(axis=1)
    distance[known] = KDTree(flat(cameras)).query(flat(degrees[known]))[0]
    return distance
