"""Refractive index of water, relative to the air above it, from temperature and salinity."""

from __future__ import annotations

from survey.errors import ConfigError

# Green light, where the three channels of a camera have their middle; blue bends 0.3 % more, red 0.3 % less.
WAVELENGTH_NM = 550.0

FRESH_WATER = 1.333


def water_index(temperature_c: float, salinity_psu: float = 0.0, *, wavelength_nm: float = WAVELENGTH_NM) -> float:
    """Refractive index of water relative to air, after Quan and Fry (1995).

    Parameters
    ----------
    temperature_c : [deg C]
        0 to 30; the fit is used up to 2 degrees beyond.
    salinity_psu : [per mille]
        0 (fresh) to 35; the fit is used up to 45.
    wavelength_nm : [nm]
        400 to 700.

    Returns
    -------
    float [-]
        Relative to air, as Snell's law at the water surface needs it: not to be divided by the index of air
        again.

    Raises
    ------
    ConfigError
        Where a value is outside the range of the fit.

    Notes
    -----
    X. Quan and E. S. Fry, Empirical equation for the index of refraction of seawater, Applied Optics 34(18),
    1995.

    Examples
    --------
    >>> round(water_index(20.0, 0.0, wavelength_nm=589.3), 6)
    1.333004
    """
    for name, value, low, high in (
        ("temperature_c", temperature_c, -2.0, 32.0),
        ("salinity_psu", salinity_psu, 0.0, 45.0),
        ("wavelength_nm", wavelength_nm, 400.0, 700.0),
    ):
        if not low <= value <= high:
            raise ConfigError(
                f"{name} is {value:g}, expected {low:g} to {high:g}; correct it, or give refractive_index (relative "
                "to air) instead"
            )
    t, s, wave = temperature_c, salinity_psu, wavelength_nm
    return (
        1.31405
        + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t * t) * s
        - 2.02e-6 * t * t
        + (15.868 + 0.01155 * s - 0.00423 * t) / wave
        - 4382.0 / wave**2
        + 1.1455e6 / wave**3
    )
