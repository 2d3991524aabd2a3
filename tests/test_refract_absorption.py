"""Absorption of pure water against other listings of the table, its bands, and what is left of the light."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from refract.absorption import CHANNEL_BANDS_NM, absorption, band_absorption, channel_absorption, leg_transmittance


@pytest.mark.parametrize(
    ("wavelength_nm", "expected"),
    [
        (400, 0.00663), (440, 0.00635), (450, 0.00922), (470, 0.0106), (500, 0.0204), (532, 0.0445), (550, 0.0565),
        (580, 0.0896), (600, 0.2224), (610, 0.2644), (620, 0.2755), (650, 0.340), (700, 0.624),
    ],
)  # fmt: skip
def test_pure_water_absorbs_what_ocean_optics_software_takes_for_it(wavelength_nm, expected):
    # A file of the ocean colour group of NASA; the table has no 532 nm, and the file its own way between lines.
    assert absorption(wavelength_nm) == pytest.approx(expected, abs=1e-4 if wavelength_nm == 532 else 1e-9)


def test_the_minimum_is_where_the_paper_says():
    wavelengths = np.linspace(380.0, 700.0, 3201)
    found = absorption(wavelengths)
    assert found.min() == pytest.approx(0.0044, abs=0.0006)
    assert wavelengths[found.argmin()] == pytest.approx(418.0, abs=1.3)  # half a step of the table


@pytest.mark.parametrize(
    ("wavelength_nm", "other"),
    [
        (460, 0.00909), (480, 0.01214), (500, 0.02073), (510, 0.0330), (530, 0.0445), (550, 0.0581), (570, 0.0716),
        (590, 0.1411), (610, 0.2644), (630, 0.2916), (640, 0.3108), (650, 0.3400), (660, 0.410), (670, 0.439),
        (680, 0.465), (690, 0.516),
    ],
)  # fmt: skip
def test_a_later_compilation_with_other_measurements_in_the_blue_agrees(wavelength_nm, other):
    # Water Optical Properties Processor, version 3 (2016): takes Pope and Fry over above 600 nm, adjusted to 20 deg C
    # below, and J. D. Mason et al. (2016) up to 510 nm.
    assert absorption(wavelength_nm) == pytest.approx(other, rel=1e-6 if wavelength_nm >= 610 else 0.08)


def test_a_band_has_the_mean_of_its_wavelengths():
    for low, high in (*CHANNEL_BANDS_NM, (431.0, 432.0), (380.0, 700.0)):
        wavelengths = np.linspace(low, high, 100_001)
        middle = 0.5 * (wavelengths[1:] + wavelengths[:-1])
        # The midpoint rule over kinks of the table is good to the step squared.
        assert band_absorption(low, high) == pytest.approx(absorption(middle).mean(), rel=1e-8)


def test_a_band_of_two_halves_has_their_mean():
    assert band_absorption(500.0, 600.0) == pytest.approx(
        0.5 * (band_absorption(500.0, 550.0) + band_absorption(550.0, 600.0)), rel=1e-14
    )


def test_red_is_absorbed_most_and_blue_least():
    red, green, blue = channel_absorption()
    assert red > 5.0 * green > 20.0 * blue
    assert channel_absorption(((600.0, 610.0),)) == (band_absorption(600.0, 610.0),)


def test_long_legs_absorb_less_per_metre_of_a_wide_band_as_the_docstring_says():
    low, high = CHANNEL_BANDS_NM[0]
    spectrum = absorption(np.linspace(low, high, 2001))
    for length, less in ((2.0, 0.03), (5.0, 0.07)):
        per_metre = -np.log(leg_transmittance(spectrum, length).mean()) / length
        assert per_metre == pytest.approx((1.0 - less) * band_absorption(low, high), rel=6e-3)


def test_light_through_two_legs_is_light_through_their_sum(Float):
    lengths = np.array([0.0, 0.5, 3.5, 10.0])
    left = leg_transmittance(0.0565, lengths)
    # Two metres down and up in pure water leave 80 % of the green and 26 % of light at 650 nm.
    assert leg_transmittance(0.0565, 4.0) == pytest.approx(0.80, abs=5e-3)
    assert leg_transmittance(0.340, 4.0) == pytest.approx(0.26, abs=5e-3)
    np.testing.assert_allclose(left * left, leg_transmittance(0.0565, 2.0 * lengths), rtol=1e-14)
    np.testing.assert_allclose(leg_transmittance(torch.tensor(0.0565, dtype=torch.float64), lengths), left, rtol=1e-15)
    np.testing.assert_allclose(np.asarray(leg_transmittance(0.0565, Float(lengths))), left, rtol=4e-7)


def test_transmittance_has_the_right_gradient():
    leaves = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([0.05, 0.3], [0.0, 4.0])]
    assert torch.autograd.gradcheck(leg_transmittance, leaves)


def test_wavelengths_outside_the_table_are_refused():
    with pytest.raises(ValueError, match=r"wavelength_nm is 365, expected 380 to 700, which the table spans"):
        absorption([500.0, 365.0])
    with pytest.raises(ValueError, match=r"low_nm, high_nm is 720, expected 380 to 700"):
        band_absorption(650.0, 720.0)
    with pytest.raises(ValueError, match=r"low_nm is 600 and high_nm 500, expected low_nm below high_nm"):
        band_absorption(600.0, 500.0)
    assert np.isnan(absorption(np.nan))
