"""Measurements of the water level on site, with std, place and time: whether they lie near the cameras.

survey.toml              level_m, level_std_m
shoreline, gnss_points   CSV with easting, northing, height in crs (and std), or a vector file
surface                  the same, or a raster of heights
gauge                    a series of levels: `survey.water.gauge_files`
image_levels             CSV with image, level (and std): `survey.water.tides`
clicks                   CSV with image, x, y, name: `survey.water.clicks`
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from pyproj import CRS
from scipy.spatial import KDTree

from evaluation.summary import HUBER_OF_MANY, huber_weights, std_by_median
from geo.crs import EARTH_RADIUS_M, height_unit_m, horizontal_crs, middle_lon_lat
from geo.features import SUFFIXES
from geo.reading import read_reference
from geo.shapes import in_height_unit, vertices_of
from geo.transformation import height_scale, lon_lat, transformed
from survey.display.quantities import distance_text
from survey.errors import ConfigError, Findings
from survey.files.csv_table import Row
from survey.files.point_table import Units, accuracy_warnings, height_std, point_table, read_points
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
    if path.suffix.lower() in SUFFIXES:
        points, notes = points_of_features(path, crs, layer)
        found = (LevelObservation(h * unit, STD_M[source], (e, n), None, source) for e, n, h in points.tolist())
        return tuple(found), Findings(notes)
    if path.suffix.lower() in _RASTER:
        if layer is not None:
            raise ConfigError(f"[water] layer is given, and {path} is a raster, which has none; remove it")
        return _points_of_raster(path, source, crs)
    table = point_table(path, ConfigError)
    rows = read_points(table, optional=("std", "std_height", "layer"), units=Units.of(crs))
    rows = _of_layer(rows, path, layer, unit)
    places = [(row.number("easting"), row.number("northing")) for row in rows]
    measured = [
        LevelObservation(row.number("height") * unit, std_of(row, source), place, None, source)
        for row, place in zip(rows, places, strict=True)
    ]
    return tuple(measured), Findings(warnings=accuracy_warnings(table))


def _of_layer(rows: list[Row], path: Path, layer: str | None, unit_m: float) -> list[Row]:
    """Rows of a code of a table, or of several with commas between them; of all where there is none to choose."""
    heights: dict[str, list[float]] = {}
    for row in rows:
        heights.setdefault(row.cells.get("layer", ""), []).append(row.number("height"))
    if layer is None:
        # A text of its own for each point describes it; a code is that of several.
        if 2 * len(heights) <= len(rows):
            require_one_water(path, heights, unit_m)
        return rows
    wanted = layers_named(layer, heights, path)
    return [row for row in rows if row.cells.get("layer", "") in wanted]


def _points_of_raster(path: Path, source: str, crs: CRS) -> tuple[tuple[LevelObservation, ...], Findings]:
    """The middles of the cells of a GeoTIFF, in crs, or of squares of many, and a note of that."""
    notes: tuple[str, ...] = ()
    shape = read_reference(path)
    message = f"the heights of {path.name}"
    if shape.crs is None:
        points = vertices_of(in_height_unit(shape, height_unit_m(crs)))
    else:
        points = vertices_of(shape)
        scale = height_scale(shape.crs, crs, message, unit_m=shape.height_unit_m)
        if not horizontal_crs(shape.crs).equals(horizontal_crs(crs), ignore_axis_order=True):
            points = transformed(shape.crs, crs, points, message, "or give the raster in crs.")
        points = points * (1.0, 1.0, scale)
    if len(points) > _MOST_CELLS:
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        side, cell = float(np.sqrt(np.prod(high - low) / _MOST_CELLS)), np.zeros(0, dtype=int)
        # Water is a part of the rectangle about it.
        while len(np.unique(cell)) < _MOST_CELLS // 2:
            _, cell = np.unique(np.floor((points[:, :2] - low) / side).astype(int), axis=0, return_inverse=True)
            side *= _FINER
        notes = (f"{path.name}: its {len(points):,} cells are averaged over squares of {side / _FINER:.3g}",)
        count = np.bincount(cell.ravel())
        points = np.column_stack([np.bincount(cell.ravel(), column) / count for column in points.T])
    unit = height_unit_m(crs)
    found = (LevelObservation(h * unit, _CELL_STD_M, (e, n), None, source) for e, n, h in points.tolist())
    return tuple(found), Findings(notes)


def std_of(row: Row, source: str) -> float:
    """The standard deviation [m] of a row of a table, by default that of its source; ConfigError where it is none."""
    std = height_std(row, STD_M[source])
    if not 0.0 < std <= MOST_STD_M:
        raise ConfigError(f"{row.where}: std is {std:g}, expected above 0 and at most {MOST_STD_M:g} m; correct it")
    return std


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
    for source, found in places.items():
        distance = _distances_m(crs, cameras, np.array(found))
        worst = int(np.argmax(distance))
        if distance[worst] > FARTHEST_M:
            e, n = found[worst]
            message = f"[water] {source} has a place at {e:.10g}, {n:.10g}, which "
            if np.isfinite(distance[worst]):
                message += f"lies {distance_text(distance[worst])} from the nearest camera in {crs.name}"
            else:
                message += f"is not on the map of {crs.name}"
            if (_distances_m(crs, cameras, np.array(found)[:, ::-1]) <= FARTHEST_M).all():
                raise ConfigError(
                    f"{message}, and near the cameras as {n:.10g}, {e:.10g}: give easting (or longitude) first"
                )
            raise ConfigError(f"{message}; give places on the water of this survey in crs")
        if distance[worst] > DOUBTFUL_M:
            num_far, far = int((distance > DOUBTFUL_M).sum()), distance_text(DOUBTFUL_M)
            warnings.append(
                f"[water] {source}: {num_far} of {len(distance)} places lie more than {far} from all cameras, the "
                f"farthest {distance_text(distance[worst])}: check that they are on the water that the photographs show"
            )
    return warnings


def _distances_m(crs: CRS, cameras: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Distances of places (K, 2) in crs to the nearest camera [m], as on a sphere; infinite off the map."""
    degrees = lon_lat(crs, places)
    middle = middle_lon_lat(cameras)
    metres = EARTH_RADIUS_M * np.radians([np.cos(np.radians(middle[1])), 1.0])

    def flat(at: np.ndarray) -> np.ndarray:
        turned = at - middle
        turned[:, 0] = (turned[:, 0] + 180.0) % 360.0 - 180.0
        return turned * metres

    distance = np.full(len(places), np.inf)
    known = np.isfinite(degrees).all(axis=1)
    distance[known] = KDTree(flat(cameras)).query(flat(degrees[known]))[0]
    return distance


_ROUNDS = 50


def huber_fit(
    design: np.ndarray, heights: np.ndarray, stds: np.ndarray, least_scatter: float = 1e-9
) -> tuple[np.ndarray, np.ndarray, float]:
    """Huber's estimate, its weights (N,), and the scatter by the median absolute deviation in units of ``stds``."""
    weights, scatter = np.ones(len(heights)), least_scatter
    for _ in range(_ROUNDS):
        root = np.sqrt(weights) / stds
        values = np.linalg.lstsq(design * root[:, None], heights * root, rcond=None)[0]
        normalised = np.abs(heights - design @ values) / stds
        scatter = max(float(std_by_median(normalised)), least_scatter)
        weights = huber_weights(normalised, scatter, HUBER_OF_MANY)
    return values, weights, scatter
