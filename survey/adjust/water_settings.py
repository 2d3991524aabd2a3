"""The water of an adjustment, in local, as survey.toml counts it: level at `level_at`, slopes along the grid axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from survey.folder.place import water_plane
from survey.folder.survey import Survey
from survey.settings.config import WaterConfig

WATER_PARAMETERS = ("level_m", "slope_east", "slope_north", "refractive_index")
_STEPS = (1e-3, 1e-6, 1e-6, 1e-6)


def settings_by_local(survey: Survey, place: np.ndarray) -> np.ndarray:
    """Derivative (4, 4) of the settings by height at a place (x, y), slopes and index in local; it is constant."""
    _, given = survey.require_water()
    start, values = _at(survey, given, place), settings_of(given)
    moved = [_at(survey, with_settings(given, values + step), place) - start for step in np.diag(_STEPS)]
    return np.linalg.inv(np.stack(moved, axis=-1) / _STEPS)


def settings_of(water: WaterConfig) -> np.ndarray:
    """The four parameters as numbers."""
    return np.array([float(getattr(water, name)) for name in WATER_PARAMETERS])


def with_settings(water: WaterConfig, values: np.ndarray) -> WaterConfig:
    """The water with other numbers (4,)."""
    level, east, north, index = np.asarray(values).tolist()
    return replace(water, level_m=level, slope_east=east, slope_north=north, refractive_index=index)


def _at(survey: Survey, water: WaterConfig, place: np.ndarray) -> np.ndarray:
    plane = water_plane(survey.frame, water)
    return np.array([float(plane.height(*place)), plane.slope_x, plane.slope_y, plane.n_water])
