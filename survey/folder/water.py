"""The refractive index of a survey, with the assumptions behind it."""

from __future__ import annotations

import warnings

from refract import water_index
from survey.errors import FILE_NAME, ConfigError
from survey.folder.config import WaterConfig

# Green light, where the three channels of a camera have their middle; blue bends 0.3 % more, red 0.2 % less.
WAVELENGTH_NM = 550.0

FRESH_WATER = 1.333


def refractive_index(given: WaterConfig, assumptions: list[str]) -> float:
    """Index of the water relative to air: as given, or of its temperature and salinity in green light.

    Raises
    ------
    ConfigError
        Where temperature or salinity are outside the range of liquid water.
    """
    if given.refractive_index is not None:
        return given.refractive_index
    if given.temperature_c is None:
        assumptions.append(f"refractive_index = {FRESH_WATER}, fresh water; sea water has 1.340 (0.7 % more depth)")
        return FRESH_WATER
    if given.salinity_psu is None:
        assumptions.append("salinity_psu = 0, fresh water")
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        try:
            index = round(float(water_index(WAVELENGTH_NM, given.temperature_c, given.salinity_psu or 0.0)), 6)
        except ValueError as error:
            raise ConfigError(f"[water] in {FILE_NAME}: {error}; or give refractive_index instead") from error
    if doubts:
        assumptions.append(f"refractive_index = {index}, although {' and '.join(str(d.message) for d in doubts)}")
    return index
