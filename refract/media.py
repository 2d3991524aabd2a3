"""Refractive index of air and of water, from wavelength, temperature, humidity or salinity, and for mixed channels.

All arguments may be plain numbers or arrays of one library (numpy, torch, Dr.Jit), which broadcast against each
other; results are differentiable in all of them. The ranges of arrays are checked, so Dr.Jit evaluates
them. NaN gives NaN.

An index *relative to air* is what Snell's law at the water surface takes, with 1 for the air above. An *absolute*
one is relative to vacuum; the two differ by the index of air, 1.00027.

An index belongs to a wavelength. Where grey images of several channels are matched, each channel shows the bed where
its own index puts it, and least squares finds the place between: to first order that of the mean index, each channel
weighted by its share of the texture that is matched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from refract._array import alike, as_numpy, namespace
from refract._numbers import of_any_size, require, warn_outside

# Where the red, green and blue of a camera have their middle in daylight. Sensors differ by some 10 nm, which in
# the index is 3e-4 in the red and 6e-4 in the blue: 0.02 and 0.04 % of the depth.
CHANNEL_WAVELENGTHS_NM = (610.0, 540.0, 460.0)

_VISIBLE = {"wavelength_nm": (400, 700), "temperature_c": (0, 30), "salinity_psu": (0, 35)}
_FITTED = {
    "Quan and Fry (1995)": _VISIBLE,
    "Parrish (2020)": _VISIBLE,
    "IAPWS R9-97": {"wavelength_nm": (200, 1100), "temperature_c": (0, 40)},
}
_FITTED_AIR = {"wavelength_nm": (300, 1700), "temperature_c": (-40, 100), "pressure_pa": (80e3, 120e3)}
# Of the search for a wavelength [nm], within what Quan and Fry fitted; the index falls all the way.
_SHORTEST_NM, _LONGEST_NM, _HALVINGS = 400.0, 700.0, 40
# Dispersion hardly depends on the water: in the sea at 28 degrees the conversion from 589 nm errs by 7e-5.
USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU = 15.0, 0.0


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
    warn_outside("Ciddor (1996)", _FITTED_AIR, stacklevel=4, wavelength_nm=wave, temperature_c=t, pressure_pa=p)
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


@of_any_size
def water_index(wavelength_nm, temperature_c, salinity_psu):
    """Refractive index of fresh or sea water relative to air, after Quan and Fry.

    Parameters
    ----------
    wavelength_nm : [nm]
        Fitted to 400 to 700.
    temperature_c : [deg C]
        Fitted to 0 to 30.
    salinity_psu : [per mille]
        0 is fresh, 35 the open sea; fitted to 0 to 35.

    Returns
    -------
    [-], of the broadcast shape
        Relative to air: not to be divided by the index of air again.

    Raises
    ------
    ValueError
        For impossible values: a wavelength or salinity that is not positive, ice, steam.

    Warns
    -----
    OutsideFit
        Naming the range, outside of it.

    Notes
    -----
    X. Quan and E. S. Fry, Empirical equation for the index of refraction of seawater, Applied Optics 34(18),
    3477-3480, 1995, equation 3. The measurements behind it were taken against air at normal pressure.

    Examples
    --------
    >>> round(float(water_index(589.3, 20.0, 0.0)), 6)
    1.333004
    """
    wave, t, s = _water("Quan and Fry (1995)", wavelength_nm, temperature_c, salinity_psu)
    return (
        1.31405
        + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t * t) * s
        - 2.02e-6 * t * t
        + (15.868 + 0.01155 * s - 0.00423 * t) / wave
        - 4382.0 / (wave * wave)
        + 1.1455e6 / (wave * wave * wave)
    )


@of_any_size
def channel_indices(temperature_c, salinity_psu, wavelengths_nm=CHANNEL_WAVELENGTHS_NM):
    """`water_index` at the effective wavelengths of the channels of a camera: by default of red, green, blue.

    Blue rays bend more than red ones: over 460 to 610 nm the depth differs by 0.5 %.

    Examples
    --------
    >>> [round(float(n), 4) for n in channel_indices(15.0, 0.0)]
    [1.3328, 1.3351, 1.339]
    """
    return tuple(water_index(wavelength, temperature_c, salinity_psu) for wavelength in wavelengths_nm)


@of_any_size
def water_index_parrish(wavelength_nm, temperature_c, salinity_psu):
    """Refractive index of fresh and sea water after Parrish, to 2e-4: a check of `water_index`.

    Notes
    -----
    C. Parrish, Index of refraction of seawater and freshwater as a function of wavelength and temperature, Oregon
    State University, 2020: two polynomials, for salinity 0 and 35. Between them, this is linear in salinity.
    """
    wave, t, s = _water("Parrish (2020)", wavelength_nm, temperature_c, salinity_psu)
    fresh = -1.97812e-6 * t * t + 1.03223e-7 * wave * wave - 8.58125e-6 * t - 1.54834e-4 * wave + 1.38919
    sea = -1.50156e-6 * t * t + 1.07085e-7 * wave * wave - 4.27594e-5 * t - 1.60476e-4 * wave + 1.39807
    return fresh + (sea - fresh) * (s / 35.0)


@of_any_size
def water_index_iapws(wavelength_nm, temperature_c):
    """Refractive index of fresh water at one atmosphere after the release of IAPWS: a check of `water_index`.

    Notes
    -----
    International Association for the Properties of Water and Steam, Release R9-97, on the absolute index, here
    divided by that of dry air at 15 deg C (`air_index`). The density is that of M. Tanaka et al., Metrologia
    38(4), 301-309, 2001, for air-free water at 0 to 40 deg C. Over 400 to 700 nm and 0 to 30 deg C, `water_index` is
    within 4e-5 of it, 0.003 % of the depth.
    """
    wave, t, _ = _water("IAPWS R9-97", wavelength_nm, temperature_c, None)
    return iapws_absolute_index(wave, t, _fresh_density(t)) / air_index(wave)


def iapws_absolute_index(wavelength_nm, temperature_c, density_kg_m3):
    """Absolute index of fresh water or steam, release R9-97 of IAPWS: equation 1 with the coefficients of table 1.

    It holds for 200 to 1100 nm, -12 to 500 deg C and up to 1060 kg/m^3, which is not checked here.
    """
    rho, theta = density_kg_m3 / 1000.0, (temperature_c + 273.15) / 273.15
    squared = (wavelength_nm / 589.0) ** 2
    a = rho * (
        0.244257733
        + 9.74634476e-3 * rho
        - 3.73234996e-3 * theta
        + 2.68678472e-4 * squared * theta
        + 1.58920570e-3 / squared
        + 2.45934259e-3 / (squared - 0.2292020**2)
        + 0.900704920 / (squared - 5.432937**2)
        - 1.66626219e-2 * rho * rho
    )
    return namespace(a).sqrt((2.0 * a + 1.0) / (1.0 - a))


def _fresh_density(t):
    return 999.974950 * (1.0 - (t - 3.983035) ** 2 * (t + 301.797) / (522528.9 * (t + 69.34881)))


@of_any_size
def freezing_point(salinity_psu):
    """Temperature [deg C] at which water of a salinity [per mille] freezes at one atmosphere.

    N. P. Fofonoff and R. C. Millard, UNESCO Technical Papers in Marine Science 44, 1983.
    """
    s = salinity_psu
    return (-0.0575 + 1.710523e-3 * s**0.5 - 2.154996e-4 * s) * s


def _water(model: str, wavelength_nm, temperature_c, salinity_psu):
    """The arguments as arrays of one library, for water that exists; warns where the model was not fitted."""
    wave, t, s = alike(wavelength_nm, temperature_c, 0.0 if salinity_psu is None else salinity_psu)
    require("wavelength_nm", wave, lambda v: v > 0.0, "more than 0")
    # Water holds no more salt than 26 % of its mass.
    require("salinity_psu", s, lambda v: (v >= 0.0) & (v <= 360.0), "0 to 360")
    require("temperature_c", t, lambda v: v <= 100.0, "at most 100, where water boils")
    found, freezes = np.broadcast_arrays(as_numpy(t), freezing_point(as_numpy(s)))
    frozen = found < freezes
    if frozen.any():
        raise ValueError(
            f"temperature_c is {found[frozen][0]:g}, but this water freezes at {freezes[frozen][0] + 0.0:.2f}; "
            "correct it, or salinity_psu"
        )
    warn_outside(model, _FITTED[model], stacklevel=5, wavelength_nm=wave, temperature_c=t, salinity_psu=s)
    return wave, t, s


def mixed_index(
    shares: Sequence[float],
    temperature_c: float,
    salinity_psu: float,
    wavelengths_nm: Sequence[float] = CHANNEL_WAVELENGTHS_NM,
) -> float:
    """Index of water relative to air for a mixture of channels with shares that add up to 1.

    Examples
    --------
    >>> round(mixed_index((0.3, 0.6, 0.1), 15.0, 0.0), 4)
    1.3348
    """
    indices = channel_indices(temperature_c, salinity_psu, wavelengths_nm)
    return float(sum(share * n for share, n in zip(shares, indices, strict=True)))


def mixed_wavelength(shares: Sequence[float], wavelengths_nm: Sequence[float] = CHANNEL_WAVELENGTHS_NM) -> float:
    """The wavelength [nm] at which water has the index of a mixture of channels.

    Examples
    --------
    >>> round(mixed_wavelength((0.3, 0.6, 0.1)))
    548
    """
    wanted = mixed_index(shares, USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU, wavelengths_nm)
    short, long = _SHORTEST_NM, _LONGEST_NM
    for _ in range(_HALVINGS):
        middle = 0.5 * (short + long)
        if water_index(middle, USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU) > wanted:
            short = middle
        else:
            long = middle
    return 0.5 * (short + long)


def converted_index(
    index: float,
    wavelength_nm: float,
    shares: Sequence[float],
    temperature_c: float = USUAL_TEMPERATURE_C,
    salinity_psu: float = USUAL_SALINITY_PSU,
) -> float:
    """Index for a mixture of channels of water whose index at one wavelength [nm] is known.

    Quan and Fry's equation gives the difference between the two alone, which hardly depends on temperature and
    salinity.

    Examples
    --------
    >>> round(converted_index(1.333, 589.3, (0.3, 0.6, 0.1)), 4)
    1.3344
    """
    there = mixed_index(shares, temperature_c, salinity_psu)
    return float(index + there - water_index(wavelength_nm, temperature_c, salinity_psu))
