"""The refractive index of a survey: that of the light whose texture is matched, with the assumptions behind it.

An index belongs to a wavelength (docs/light.md). The index that the program works with belongs to the light that is
matched, a mixture of the channels of the photographs. ``refractive_index`` in survey.toml is that one, unless
``index_wavelength_nm`` says to which wavelength it belongs: then, as from temperature and salinity, the index is that
of the shares which red, green and blue have in the texture of the photographs.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

from refract.media import converted_index
from survey.errors import FILE_NAME, ConfigError, Findings
from survey.photos.texture import MatchedLight
from survey.settings.config import WaterConfig

# Wavelength of handbooks: the sodium line.
FRESH_WATER, SEA_WATER, SODIUM_NM = 1.333, 1.340, 589.3
# Std of an assumed index: any water from fresh to that of the sea, 0.007 above, is as likely.
ASSUMED_INDEX_STD = 0.004


def refractive_index(given: WaterConfig, light: Callable[[], MatchedLight]) -> tuple[float, Findings]:
    """Index of the water relative to air, for the light that is matched, and what is assumed.

    ``light`` measures that of the photographs; it is called only where the index depends on it.
    """
    temperature_c, salinity_psu = given.medium.temperature_c, given.medium.salinity_psu
    if temperature_c is None:
        index, wavelength_nm, what = given.refractive_index, given.medium.index_wavelength_nm, ""
        if index is None:
            index, wavelength_nm = FRESH_WATER, SODIUM_NM
            what = f"fresh water (the sea has {SEA_WATER:.3f}, 0.7 % more depth), "
        if wavelength_nm is None:
            return index, Findings()
        matched = light()
        found = round(converted_index(index, wavelength_nm, matched.shares), 6)
        return found, Findings((f"refractive_index = {found}, {what}{index:g} at {wavelength_nm:g} nm for {matched}",))
    matched, assumed = light(), () if salinity_psu is not None else ("salinity_psu = 0, fresh water",)
    with warnings.catch_warnings(record=True) as fit_warnings:
        warnings.simplefilter("always")
        try:
            index = round(matched.index(temperature_c, salinity_psu or 0.0), 6)
        except ValueError as error:
            raise ConfigError(f"[water] in {FILE_NAME}: {error}; or give refractive_index instead") from error
    message = f"refractive_index = {index}, of water of {temperature_c:g} degrees for {matched}"
    if fit_warnings:
        message += f", although {' and '.join(dict.fromkeys(str(each.message) for each in fit_warnings))}"
    return index, Findings((*assumed, message))
