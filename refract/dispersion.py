"""Dispersion: the effective index for a mixture of the channels of a camera, and its wavelength.

An index belongs to a wavelength. Where grey images of several channels are matched, each channel shows the bed where
its own index puts it, and least squares finds the place between: to first order that of the mean index, each channel
weighted by its share of the texture that is matched.
"""

from __future__ import annotations

from collections.abc import Sequence

from refract.media import CHANNEL_WAVELENGTHS_NM, channel_indices, water_index

# Of the search for a wavelength [nm], within what Quan and Fry fitted; the index falls all the way.
_SHORTEST_NM, _LONGEST_NM, _HALVINGS = 400.0, 700.0, 40
# Dispersion hardly depends on the water: in the sea at 28 degrees the conversion from 589 nm errs by 7e-5.
USUAL_TEMPERATURE_C, USUAL_SALINITY_PSU = 15.0, 0.0


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
