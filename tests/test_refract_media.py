"""Refractive indices against the check values of their paper, a second model, and what cannot be."""

import numpy as np
import pytest
import torch

from refract import OutsideFit, channel_indices, water_index
from refract.media import CHANNEL_WAVELENGTHS_NM, freezing_point

# Check values have six digits after the point.
SIX_DIGITS = 0.51e-6
# Indices about 1.34 in float32, and a sum of seven terms.
FLOAT32 = 8 * np.finfo(np.float32).eps


@pytest.mark.parametrize(
    ("wavelength_nm", "temperature_c", "salinity_psu", "index"),
    [
        (589.3, 20.0, 0.0, 1.333004),
        (532.0, 20.0, 0.0, 1.335035),
        (550.0, 10.0, 0.0, 1.335021),
        (550.0, 0.0, 0.0, 1.335300),
        (550.0, 30.0, 0.0, 1.333251),
        (450.0, 15.0, 0.0, 1.339648),
        (550.0, 15.0, 0.0, 1.334730),
        (650.0, 15.0, 0.0, 1.331710),
        (400.0, 20.0, 0.0, 1.343211),
        (700.0, 20.0, 0.0, 1.330187),
        (589.3, 20.0, 35.0, 1.339406),
        (532.0, 20.0, 35.0, 1.341510),
        (550.0, 10.0, 35.0, 1.341671),
        (550.0, 0.0, 35.0, 1.342262),
        (550.0, 30.0, 35.0, 1.339614),
    ],
)
def test_water_has_the_index_of_quan_and_fry(wavelength_nm, temperature_c, salinity_psu, index):
    assert water_index(wavelength_nm, temperature_c, salinity_psu) == pytest.approx(index, abs=SIX_DIGITS)


def iapws_absolute_index(wavelength_nm, temperature_c, density_kg_m3):
    """Absolute index of fresh water, release R9-97 of IAPWS: equation 1 with the coefficients of table 1."""
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
    return np.sqrt((2.0 * a + 1.0) / (1.0 - a))


def test_water_has_the_index_of_iapws_over_that_of_air():
    # The check value of the release.
    assert iapws_absolute_index(589.3, 25.0, 997.047435) == pytest.approx(1.33285819, abs=0.51e-8)
    wave, t = np.meshgrid(np.linspace(400.0, 700.0, 31), np.linspace(0.0, 30.0, 16))
    # Air-free water at one atmosphere, 0 to 40 deg C: M. Tanaka et al., Metrologia 38(4), 2001.
    density = 999.974950 * (1.0 - (t - 3.983035) ** 2 * (t + 301.797) / (522528.9 * (t + 69.34881)))
    # Dry air at 15 deg C: P. E. Ciddor, Applied Optics 35(9), 1996, equation 1.
    s2 = (1000.0 / wave) ** 2
    air = 1.0 + (5792105.0 / (238.0185 - s2) + 167917.0 / (57.362 - s2)) * 1e-8
    absolute = iapws_absolute_index(wave, t, density)
    # Quan and Fry state 1.5e-5 of their fit about data that are known to 3e-5; measured 3.6e-5.
    assert np.abs(water_index(wave, t, 0.0) - absolute / air).max() < 4e-5
    # Were the index taken as absolute, the two would be 3.5e-4 apart.
    assert np.abs(water_index(wave, t, 0.0) - absolute).max() > 2.5e-4


def test_salt_cold_and_blue_light_raise_the_index():
    assert water_index(550.0, 20.0, 35.0) - water_index(550.0, 20.0, 0.0) == pytest.approx(0.0065, abs=2e-4)
    assert water_index(550.0, 0.0, 0.0) - water_index(550.0, 30.0, 0.0) == pytest.approx(0.0020, abs=1e-4)
    red, green, blue = channel_indices(15.0, 0.0)
    assert red < green < blue
    assert (red, green, blue) == tuple(water_index(w, 15.0, 0.0) for w in CHANNEL_WAVELENGTHS_NM)
    (mono,) = channel_indices(15.0, 0.0, wavelengths_nm=(550.0,))
    assert mono == water_index(550.0, 15.0, 0.0)


def test_torch_gives_what_numpy_gives():
    numbers = np.array([450.0, 550.0, 650.0]), np.array([5.0, 15.0, 25.0]), np.array([0.0, 7.0, 35.0])
    exact = water_index(*numbers)
    for dtype, tolerance in ((torch.float64, 1e-15), (torch.float32, FLOAT32)):
        found = water_index(*(torch.tensor(v, dtype=dtype) for v in numbers))
        np.testing.assert_allclose(found, exact, rtol=tolerance)


def test_indices_have_the_right_gradient():
    leaves = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([450.0, 600.0], 12.0, 10.0)]
    # Differences over 1e-3 of a degree, nanometre or per mille: the index changes by 1e-8, known to 1e-16.
    assert torch.autograd.gradcheck(water_index, leaves, eps=1e-3, atol=1e-10, rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((550.0, -1.0, 35.0), r"temperature_c is -1, outside the range 0 to 30 of Quan and Fry"),
        ((550.0, [20.0, 31.0], 0.0), r"temperature_c is 31, outside"),
        ((550.0, 20.0, 38.0), r"salinity_psu is 38, outside the range 0 to 35"),
        ((830.0, 20.0, 0.0), r"wavelength_nm is 830, outside the range 400 to 700"),
    ],
)
def test_a_warning_names_the_range_that_the_fit_is_left_of(arguments, said):
    with pytest.warns(OutsideFit, match=said) as caught:
        assert np.isfinite(water_index(*arguments)).all()
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((-550.0, 20.0, 0.0), r"wavelength_nm is -550, expected more than 0; check"),
        ((0.0, 20.0, 0.0), r"wavelength_nm is 0, expected more than 0"),
        ((550.0, 20.0, [0.0, -1.0]), r"salinity_psu is -1, expected 0 to 360"),
        ((550.0, 293.15, 0.0), r"temperature_c is 293.15, expected at most 100"),
        ((550.0, -1.0, 0.0), r"temperature_c is -1, but this water freezes at 0\.00; correct it, or salinity_psu"),
        ((550.0, [5.0, -2.5], [0.0, 35.0]), r"temperature_c is -2.5, but this water freezes at -1\.92"),
    ],
)
def test_water_that_cannot_be_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        water_index(*arguments)


def test_what_is_not_known_stays_unknown():
    np.testing.assert_array_equal(np.isnan(water_index(550.0, np.array([20.0, np.nan]), 0.0)), [False, True])


def test_sea_water_freezes_where_the_unesco_table_says():
    # Fofonoff and Millard's table, at the surface.
    np.testing.assert_allclose(freezing_point(np.array([5.0, 20.0, 35.0])), [-0.274, -1.083, -1.922], atol=5e-4)
