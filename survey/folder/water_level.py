"""The water level from measurements on site: points of the water surface, or a gauge.

    shoreline, gnss_points   CSV with easting, northing, height in crs: a plane is fitted
    gauge                    CSV with time, level: interpolated at the time of each photograph

Each is converted to level_m (and slopes) of [water] when the survey is read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from survey.errors import FILE_NAME, ConfigError
from survey.files.csv_table import Row, read_table
from survey.folder.config import SurveyConfig
from survey.folder.config_water import MOST_LEVEL_STD_M
from survey.photos.exif import Exif

SOURCES = ("shoreline", "gnss_points", "gauge")

# Huber's constant: 95 % of the efficiency of least squares where errors are normal (P. J. Huber 1964).
_HUBER = 1.345
# The median of the absolute value of a normal deviate of unit standard deviation.
_MEDIAN_DEVIATION = 0.6745
_ROUNDS = 50
# Slopes count only where they exceed their standard deviation by this factor.
_SIGNIFICANT = 3.0
# Fewer points than this may lie on a tilted plane by chance.
_LEAST_FOR_SLOPES = 6
# Water that rises by more than this during a flight [m] no longer has one level.
MOST_RISE_M = 0.005


@dataclass(frozen=True)
class SurfaceFit:
    """A plane through points of the water surface.

    Attributes
    ----------
    level_m : [m]
        At the mean of the points, easting and northing `level_at`.
    level_at : (easting, northing)
    slope_east, slope_north : [-]
        Zero where the points do not show any.
    covariance : (3, 3)
        Of level, slope_east and slope_north; zero rows for slopes that were not fitted.
    num_points : int
    """

    level_m: float
    level_at: tuple[float, float]
    slope_east: float
    slope_north: float
    covariance: np.ndarray
    num_points: int


def with_level(folder: Path, config: SurveyConfig, heads: Mapping[str, Exif], notes: list[str]) -> SurveyConfig:
    """Settings with the water level read from the file that [water] names; a sentence is added to the notes.

    Raises
    ------
    ConfigError
        If the file is missing or damaged, or does not cover the flight.
    """
    water = config.water
    if water is None:
        return config
    name = next((s for s in SOURCES if getattr(water, s) is not None), None)
    if name is None:
        return config
    path = folder / getattr(water, name)
    if name == "gauge":
        level, note = _level_at_flight(path, heads)
        notes.append(f"level_m = {level:.3f} from [water] gauge: {note}")
        return replace(config, water=replace(water, level_m=level, gauge=None))
    fit = fit_surface(read_points(path), with_slopes=water.slope_east == 0.0 == water.slope_north)
    # By the slopes, from the middle of the points to level_at.
    level_at = water.level_at or fit.level_at
    fit = replace(fit, slope_east=fit.slope_east or water.slope_east, slope_north=fit.slope_north or water.slope_north)
    away = np.subtract(level_at, fit.level_at)
    level = fit.level_m + fit.slope_east * away[0] + fit.slope_north * away[1]
    std = math.sqrt(np.array([1.0, *away]) @ fit.covariance @ np.array([1.0, *away]))
    notes.append(
        f"level_m = {level:.3f} +- {std:.3f} from {fit.num_points} points in [water] {name}, slope "
        f"{fit.slope_east:.5f} east and {fit.slope_north:.5f} north"
    )
    water = replace(
        water,
        level_m=level,
        level_at=level_at,
        slope_east=fit.slope_east,
        slope_north=fit.slope_north,
        level_std_m=water.level_std_m or min(std, MOST_LEVEL_STD_M),
        shoreline=None,
        gnss_points=None,
    )
    return replace(config, water=water)


def fit_surface(points: np.ndarray, *, with_slopes: bool = True) -> SurfaceFit:
    """A level surface, or a tilted plane where the points show one; robust against outliers.

    Parameters
    ----------
    points : (N, 3) easting, northing, height [m]
    with_slopes : bool
        Allow a tilt where it exceeds three standard deviations.

    Raises
    ------
    ConfigError
        If there are fewer than three points.
    """
    points = np.asarray(points, dtype=np.float64)
    if len(points) < 3:
        raise ConfigError(
            f"{len(points)} points of the water surface were found, expected three or more; measure more, or give "
            "level_m"
        )
    middle = points[:, :2].mean(axis=0)
    level_at = (float(middle[0]), float(middle[1]))
    design = np.column_stack([np.ones(len(points)), points[:, :2] - middle])
    # Points along one line do not determine the slope across it.
    spread = np.linalg.svd(design[:, 1:], compute_uv=False)
    if with_slopes and len(points) >= _LEAST_FOR_SLOPES and spread[1] > 0.05 * spread[0]:
        values, covariance = _robust(design, points[:, 2])
        slopes, rough = values[1:], covariance[1:, 1:]
        if slopes @ np.linalg.solve(rough, slopes) > _SIGNIFICANT**2:
            level, east, north = values.tolist()
            return SurfaceFit(level, level_at, east, north, covariance, len(points))
    values, covariance = _robust(design[:, :1], points[:, 2])
    padded = np.zeros((3, 3))
    padded[0, 0] = covariance[0, 0]
    return SurfaceFit(float(values[0]), level_at, 0.0, 0.0, padded, len(points))


def _robust(design: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Huber's estimate and its covariance; the scatter is the median absolute deviation."""
    weights = np.ones(len(heights))
    for _ in range(_ROUNDS):
        normal = design.T @ (weights[:, None] * design)
        values = np.linalg.solve(normal, design.T @ (weights * heights))
        residuals = heights - design @ values
        # Such files are rounded to a millimetre: the scatter is not smaller than that.
        std = max(float(np.median(np.abs(residuals))) / _MEDIAN_DEVIATION, 1e-3)
        weights = np.minimum(1.0, _HUBER * std / np.maximum(np.abs(residuals), 1e-12))
    spare = max(len(heights) - design.shape[1], 1)
    return values, np.linalg.inv(normal) * std**2 * len(heights) / spare


def read_points(path: Path) -> np.ndarray:
    """Points (N, 3) easting, northing, height of a CSV file with these columns.

    Raises
    ------
    ConfigError
        If the file or a column is missing, or a value is not a finite number.
    """
    columns = ("easting", "northing", "height")
    rows = read_table(path, columns, error=ConfigError)
    return np.array([[row.number(name) for name in columns] for row in rows]).reshape(-1, 3)


def read_gauge(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) [s since 1970, UTC], rising, and levels (N,) [m] of a CSV file with columns time and level.

    Raises
    ------
    ConfigError
        If the file is missing or damaged, a time has no time zone, or times do not rise.
    """
    rows = read_table(path, ("time", "level"), error=ConfigError)
    times = np.array([_time(row) for row in rows])
    levels = np.array([row.number("level") for row in rows])
    if len(times) < 2 or (np.diff(times) <= 0.0).any():
        raise ConfigError(f"{path} has {len(times)} readings, expected two or more with rising times; sort them")
    return times, levels


def _level_at_flight(path: Path, heads: Mapping[str, Exif]) -> tuple[float, str]:
    """Mean level [m] over the photographs, and a sentence on its spread."""
    times, levels = read_gauge(path)
    taken = {name: head.taken for name, head in heads.items() if head.taken is not None}
    if not taken:
        raise ConfigError(
            f"no image has its time of exposure in UTC (EXIF GPS time, or DateTimeOriginal with OffsetTimeOriginal), "
            f"so no level can be interpolated from {path}; give level_m in {FILE_NAME}"
        )
    moments = np.array([moment.timestamp() for moment in taken.values()])
    if moments.min() < times[0] or moments.max() > times[-1]:
        raise ConfigError(
            f"{path} runs from {_shown(times[0])} to {_shown(times[-1])}, but images were taken from "
            f"{_shown(moments.min())} to {_shown(moments.max())}; add the readings around the flight"
        )
    at_images = np.interp(moments, times, levels)
    rise = float(np.ptp(at_images))
    note = f"mean at {len(moments)} of {len(heads)} images, over which it changes by {1000.0 * rise:.0f} mm"
    if rise > MOST_RISE_M:
        note += f"; more than {1000.0 * MOST_RISE_M:.0f} mm shift the bed: cut the flight into parts of equal level"
    return float(at_images.mean()), note


def _time(row: Row) -> float:
    text = row.text("time")
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(f"{row.where}: {text!r} is not a time, expected e.g. 2024-06-01T10:30:00Z") from error
    if moment.tzinfo is None:
        raise ConfigError(f"{row.where}: {text} has no time zone; write Z for UTC or e.g. +02:00 after it")
    return moment.timestamp()


def _shown(timestamp: float) -> str:
    return (datetime(1970, 1, 1) + timedelta(seconds=float(timestamp))).strftime("%Y-%m-%d %H:%M:%S UTC")
