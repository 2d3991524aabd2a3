"""Refractive index of air, from wavelength, temperature, pressure and humidity."""

from __future__ import annotations

import math

from refract._array import alike, namespace
from refract._empty import of_any_size
from refract._ranges import require, warn_outside

_FITTED = {"wavelength_nm": (300, 1700), "temperature_c": (-40, 100), "pressure_pa": (80e3, 120e3)}


@of_any_size
def air_index(wavelength_nm, temperature_c=15.0, pressure_pa=101325.0, humidity=0.0, co2_ppm=450.0):
    """Refractive index of air relative to vacuum, after Ciddor.

    Parameters
    ----------
    wavelength_nm : [nm], in vacuum
        Valid for 300 to 1700.
    temperature_c, pressure_pa : [deg C], [Pa]
        Valid for -40 to 100 and 80 000 to 120 000.
    humidity : relative, 0 to 1
    co2_ppm : [ppm]

    Returns
    -------
    [-], of the broadcast shape

    Raises
    ------
    ValueError, and warns OutsideFit
        As `water_index` does.

    Notes
    -----
    P. E. Ciddor, Refractive index of air: new equations for the visible and near infrared, Applied Optics 35(9),
    1566-1573, 1996, equations 1 to 5 and 12 with the constants of appendix A.

    Examples
    --------
    >>> round(float(air_index(589.3)), 8)
    1.00027715
    """
    wave, t, p, humidity, co2 = alike(wavelength_nm, temperature_c, pressure_pa, humidity, co2_ppm)
    require("wavelength_nm", wave, lambda v: v > 0.0, "more than 0")
    require("temperature_c", t, lambda v: v > -273.15, "more than -273.15")
    require("pressure_pa", p, lambda v: v > 0.0, "more than 0")
    require("humidity", humidity, lambda v: (v >= 0.0) & (v <= 1.0), "0 to 1")
    require("co2_ppm", co2, lambda v: (v >= 0.0) & (v <= 1e6), "0 to 1000000")
    warn_outside("Ciddor (1996)", _FITTED, stacklevel=4, wavelength_nm=wave, temperature_c=t, pressure_pa=p)
    s2 = (1000.0 / wave) ** 2  # wavenumber squared, 1/um^2
    standard_air = (5792105.0 / (238.0185 - s2) + 167917.0 / (57.362 - s2)) * 1e-8 * (1.0 + 0.534e-6 * (co2 - 450.0))
    standard_vapour = 1.022e-8 * (295.235 + (2.6422 + (-0.032380 + 0.004028 * s2) * s2) * s2)
    vapour = (1.00062 + 3.14e-8 * p + 5.6e-7 * t * t) * humidity * _saturation_pressure(t) / p
    density_per_molar_mass = p / (_compressibility(t, p, vapour) * (t + 273.15))
    of_air = density_per_molar_mass * (1.0 - vapour) / (101325.0 / (_compressibility(15.0, 101325.0, 0.0) * 288.15))
    of_vapour = density_per_molar_mass * vapour / (1333.0 / (_compressibility(20.0, 1333.0, 1.0) * 293.15))
    return 1.0 + of_air * standard_air + of_vapour * standard_vapour


def _compressibility(t, p, vapour):
    """Compressibility of moist air [-] (BIPM 1981/91); `vapour` is the molar fraction of water vapour."""
    k = t + 273.15
    linear = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t * t
    linear = linear + (5.707e-6 - 2.051e-8 * t) * vapour + (1.9898e-4 - 2.376e-6 * t) * vapour * vapour
    return 1.0 - (p / k) * linear + (p / k) ** 2 * (1.83e-11 - 0.765e-8 * vapour * vapour)


def _saturation_pressure(t):
    """Saturation vapour pressure [Pa], over water from 0 deg C up and over ice below."""
    xp, k = namespace(t), t + 273.15
    over_water = xp.exp(1.2378847e-5 * k * k - 1.9121316e-2 * k + 33.93711047 - 6.3431645e3 / k)
    over_ice = xp.exp(math.log(10.0) * (12.537 - 2663.5 / k))
    return xp.where(t >= 0.0, over_water, over_ice)
