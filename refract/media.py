"""Refractive index of water relative to air, from wavelength, temperature and salinity, and for mixed channels.

All arguments may be plain numbers or arrays of numpy or torch, which broadcast against each other; results are
differentiable in all of them. NaN gives NaN.

An index *relative to air* is what Snell's law at the water surface takes, with 1 for the air above: an absolute one,
relative to vacuum, over the index of air, 1.00027.

An index belongs to a wavelength. Where grey images of several channels are matched, each channel shows the bed where
its own index puts it, and least squares finds the place between: to first order that of the mean index, each channel
weighted by its share of the texture that is matched.
"""

import warnings
from collections.abc import Sequence

import numpy as np

from refract._array import OutsideFit, as_numpy, common, require

# Effective wavelengths of red, green and blue of a camera in daylight. Sensors differ by some 10 nm, which changes the
# index by 3e-4 in the red and 6e-4 in the blue: 0.02 and 0.04 % of the depth.
CHANNEL_WAVELENGTHS_NM = (610.0, 540.0, 460.0)

# Ranges of the measurements that Quan and Fry fitted.
_FITTED = {"wavelength_nm": (400, 700), "temperature_c": (0, 30), "salinity_psu": (0, 35)}
# Bisection for a wavelength [nm], within what Quan and Fry fitted; the index falls monotonically.
_SHORTEST_NM, _LONGEST_NM, _HALVINGS = 400.0, 700.0, 40
# Dispersion hardly depends on the water: in the sea at 28 degrees the conversion from 589 nm errs by 7e-5.
USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU = 15.0, 0.0


def water_index(wavelength_nm, temperature_c, salinity_psu):
    """Refractive index of fresh or sea water relative to air, after Quan and Fry.

    Raises ValueError for impossible values: a wavelength or salinity that is not positive, ice, steam.

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
    wave, t, s = _water(wavelength_nm, temperature_c, salinity_psu)
    return (
        1.31405
        + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t * t) * s
        - 2.02e-6 * t * t
        + (15.868 + 0.01155 * s - 0.00423 * t) / wave
        - 4382.0 / (wave * wave)
        + 1.1455e6 / (wave * wave * wave)
    )


def channel_indices(temperature_c, salinity_psu, wavelengths_nm=CHANNEL_WAVELENGTHS_NM):
    """`water_index` at the effective wavelengths of the channels of a camera: by default of red, green, blue.

    Blue rays bend more than red ones: over 460 to 610 nm the depth differs by 0.5 %.

    Examples
    --------
    >>> [round(float(n), 4) for n in channel_indices(15.0, 0.0)]
    [1.3328, 1.3351, 1.339]
    """
    return tuple(water_index(wavelength, temperature_c, salinity_psu) for wavelength in wavelengths_nm)


def freezing_point(salinity_psu):
    """Temperature [deg C] at which water of a salinity [per mille] freezes at one atmosphere.

    N. P. Fofonoff and R. C. Millard, UNESCO Technical Papers in Marine Science 44, 1983.
    """
    s = salinity_psu
    return (-0.0575 + 1.710523e-3 * s**0.5 - 2.154996e-4 * s) * s


def _water(wavelength_nm, temperature_c, salinity_psu):
    """The arguments as arrays of one library, for water that exists; warns where the equation was not fitted."""
    wave, t, s = common(wavelength_nm=wavelength_nm, temperature_c=temperature_c, salinity_psu=salinity_psu)
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
    for (name, (low, high)), values in zip(_FITTED.items(), map(as_numpy, (wave, t, s)), strict=True):
        outside = values[(values < low) | (values > high)]
        if outside.size:
            message = f"{name} is {outside[0]:g}, outside the range {low:g} to {high:g} of Quan and Fry (1995)"
            warnings.warn(message, OutsideFit, stacklevel=3)
    return wave, t, s


def mixed_index(shares: Sequence[float], temperature_c: float, salinity_psu: float) -> float:
    """Index of water relative to air for a mixture of red, green and blue with shares that add up to 1.

    Examples
    --------
    >>> round(mixed_index((0.3, 0.6, 0.1), 15.0, 0.0), 4)
    1.3348
    """
    indices = channel_indices(temperature_c, salinity_psu)
    return float(sum(share * n for share, n in zip(shares, indices, strict=True)))


def mixed_wavelength(shares: Sequence[float]) -> float:
    """The wavelength [nm] at which water has the index of a mixture of red, green and blue.

    Examples
    --------
    >>> round(mixed_wavelength((0.3, 0.6, 0.1)))
    548
    """
    index = mixed_index(shares, USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU)
    short, long = _SHORTEST_NM, _LONGEST_NM
    for _ in range(_HALVINGS):
        middle = 0.5 * (short + long)
        if water_index(middle, USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU) > index:
            short = middle
        else:
            long = middle
    return 0.5 * (short + long)


def converted_index(index: float, wavelength_nm: float, shares: Sequence[float]) -> float:
    """Index for a mixture of red, green and blue of water whose index at one wavelength [nm] is known.

    Quan and Fry's equation gives the difference between the two alone, which hardly depends on temperature and
    salinity.

    Examples
    --------
    >>> round(converted_index(1.333, 589.3, (0.3, 0.6, 0.1)), 4)
    1.3344
    """
    usual = USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU
    return float(index + mixed_index(shares, *usual) - water_index(wavelength_nm, *usual))
