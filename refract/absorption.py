"""Absorption by pure water along the water leg of a ray, per wavelength and per channel of a camera."""

from __future__ import annotations

import numpy as np

from refract._array import alike, namespace
from refract._numbers import of_any_size, require

# Between the wavelengths at which the channels of a camera with a colour filter array change over.
CHANNEL_BANDS_NM = ((580.0, 660.0), (500.0, 580.0), (420.0, 500.0))

# 1/m at 380 to 700 nm in steps of 2.5, a line of the table is 25 nm. R. M. Pope and E. S. Fry, Absorption spectrum
# (380-700 nm) of pure water. II. Integrating cavity measurements, Applied Optics 36(33), 8710-8723, 1997, table 3.
_WAVELENGTHS_NM = np.linspace(380.0, 700.0, 129)
_PURE_WATER = np.array([
    0.01137, 0.01044, 0.00941, 0.00917, 0.00851, 0.00829, 0.00813, 0.00775, 0.00663, 0.00579,
    0.00530, 0.00503, 0.00473, 0.00452, 0.00444, 0.00442, 0.00454, 0.00474, 0.00478, 0.00482,
    0.00495, 0.00504, 0.00530, 0.00580, 0.00635, 0.00696, 0.00751, 0.00830, 0.00922, 0.00969,
    0.00962, 0.00957, 0.00979, 0.01005, 0.01011, 0.0102, 0.0106, 0.0109, 0.0114, 0.0121,
    0.0127, 0.0131, 0.0136, 0.0144, 0.0150, 0.0162, 0.0173, 0.0191, 0.0204, 0.0228,
    0.0256, 0.0280, 0.0325, 0.0372, 0.0396, 0.0399, 0.0409, 0.0416, 0.0417, 0.0428,
    0.0434, 0.0447, 0.0452, 0.0466, 0.0474, 0.0489, 0.0511, 0.0537, 0.0565, 0.0593,
    0.0596, 0.0606, 0.0619, 0.0640, 0.0642, 0.0672, 0.0695, 0.0733, 0.0772, 0.0836,
    0.0896, 0.0989, 0.1100, 0.1220, 0.1351, 0.1516, 0.1672, 0.1925, 0.2224, 0.2470,
    0.2577, 0.2629, 0.2644, 0.2665, 0.2678, 0.2707, 0.2755, 0.2810, 0.2834, 0.2904,
    0.2916, 0.2995, 0.3012, 0.3077, 0.3108, 0.322, 0.325, 0.335, 0.340, 0.358,
    0.371, 0.393, 0.410, 0.424, 0.429, 0.436, 0.439, 0.448, 0.448, 0.461,
    0.465, 0.478, 0.486, 0.502, 0.516, 0.538, 0.559, 0.592, 0.624,
])  # fmt: skip


def absorption(wavelength_nm) -> np.ndarray:
    """Absorption coefficient of pure water [1/m] at wavelengths (...) of 380 to 700 nm, between tabulated values.

    Natural water absorbs more, above all in the blue: this is the least that a water column takes. Below 440 nm,
    where the table is most uncertain, newer measurements (J. D. Mason et al., Applied Optics 55(25), 2016) are
    lower, by up to a factor of three at 400 nm.

    Raises
    ------
    ValueError
        Outside the table: it is not extrapolated.

    Examples
    --------
    >>> [round(float(a), 4) for a in absorption([450.0, 550.0, 650.0])]
    [0.0092, 0.0565, 0.34]
    """
    wavelength_nm = np.asarray(wavelength_nm, dtype=np.float64)
    _require_in_table("wavelength_nm", wavelength_nm)
    return np.interp(wavelength_nm, _WAVELENGTHS_NM, _PURE_WATER)


def band_absorption(low_nm: float, high_nm: float) -> float:
    """Mean absorption coefficient of pure water [1/m] over a band of wavelengths [nm].

    It holds for short legs: the strongly absorbed part of a band fades first, so that over a long leg the band as
    a whole absorbs less per metre. In the red, 580 to 660 nm, that is 3 % less over 2 m and 7 % over 5 m.

    Raises
    ------
    ValueError
        Where the band is empty or leaves the table.
    """
    _require_in_table("low_nm, high_nm", np.array([low_nm, high_nm]))
    if not low_nm < high_nm:
        raise ValueError(f"low_nm is {low_nm:g} and high_nm {high_nm:g}, expected low_nm below high_nm; exchange them")
    inside = _WAVELENGTHS_NM[(low_nm < _WAVELENGTHS_NM) & (high_nm > _WAVELENGTHS_NM)]
    nodes = np.array([low_nm, *inside, high_nm])
    # The table is interpolated linearly: the trapezoidal rule on its nodes is exact.
    values = absorption(nodes)
    return float(np.sum(0.5 * (values[1:] + values[:-1]) * np.diff(nodes)) / (high_nm - low_nm))


def channel_absorption(bands_nm=CHANNEL_BANDS_NM) -> tuple[float, ...]:
    """`band_absorption` of the channels of a camera: by default of red, green, blue.

    Examples
    --------
    >>> [round(a, 4) for a in channel_absorption()]
    [0.2616, 0.0508, 0.0101]
    """
    return tuple(band_absorption(low, high) for low, high in bands_nm)


@of_any_size
def leg_transmittance(attenuation, length):
    """Share of light that is left after a leg through water: ``exp(-attenuation length)``.

    Parameters
    ----------
    attenuation : (...) [1/m]
        Of the beam that forms the image: absorption, and scattering out of it.
    length : (...) [m]
        Of the leg in water; both may be numpy, torch or Dr.Jit.
    """
    attenuation, length = alike(attenuation, length)
    return namespace(attenuation).exp(-attenuation * length)


def _require_in_table(name: str, values: np.ndarray) -> None:
    low, high = _WAVELENGTHS_NM[0], _WAVELENGTHS_NM[-1]
    require(name, values, lambda v: (v >= low) & (v <= high), f"{low:g} to {high:g}, which the table spans")
