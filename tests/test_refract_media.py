"""Refractive indices against their papers' check values, each other, and what cannot be."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from refract import OutsideFit, air_index, channel_indices, water_index, water_index_iapws, water_index_parrish
from refract.media import CHANNEL_WAVELENGTHS_NM, freezing_point, iapws_absolute_index

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


@pytest.mark.parametrize(
    ("wavelength_nm", "temperature_c", "density", "index"),
    [
        (226.5, 25.0, 997.047435, 1.39277824),
        (589.3, 500.0, 30.4758534, 1.00949307),
        (589.3, 25.0, 997.047435, 1.33285819),
    ],
)
def test_the_second_model_meets_the_check_values_of_its_release(wavelength_nm, temperature_c, density, index):
    assert iapws_absolute_index(wavelength_nm, temperature_c, density) == pytest.approx(index, abs=0.51e-8)


@pytest.mark.parametrize("temperature_c", [0.0, 20.0])
def test_water_at_one_atmosphere_has_the_absolute_index_of_the_release(temperature_c):
    absolute = water_index_iapws(589.0, temperature_c) * air_index(589.0)
    # Six digits, and densities that may differ by 2e-3 kg/m^3.
    assert absolute == pytest.approx({0.0: 1.334345, 20.0: 1.333358}[temperature_c], abs=SIX_DIGITS + 5e-7)


def test_three_models_agree_to_what_their_authors_claim():
    wave, t = np.meshgrid(np.linspace(400.0, 700.0, 31), np.linspace(0.0, 30.0, 16))
    fresh = water_index(wave, t, 0.0)
    # Quan and Fry state 1.5e-5 of their fit about data that are known to 3e-5; measured 3.6e-5.
    assert np.abs(fresh - water_index_iapws(wave, t)).max() < 4e-5
    # Were the index taken as absolute, the two would be 3.5e-4 apart.
    assert np.abs(fresh - water_index_iapws(wave, t) * air_index(wave)).max() > 2.5e-4
    for salinity in (0.0, 35.0):
        difference = water_index(wave, t, salinity) - water_index_parrish(wave, t, salinity)
        # Parrish states 2e-4 rms of his quadratics, which are worst at the ends of the range: measured 4.6e-4.
        assert np.sqrt(np.mean(difference**2)) < 2e-4
        assert np.abs(difference).max() < 5e-4


def test_salt_cold_and_blue_light_raise_the_index():
    assert water_index(550.0, 20.0, 35.0) - water_index(550.0, 20.0, 0.0) == pytest.approx(0.0065, abs=2e-4)
    assert water_index(550.0, 0.0, 0.0) - water_index(550.0, 30.0, 0.0) == pytest.approx(0.0020, abs=1e-4)
    red, green, blue = channel_indices(15.0, 0.0)
    assert red < green < blue
    assert (red, green, blue) == tuple(water_index(w, 15.0, 0.0) for w in CHANNEL_WAVELENGTHS_NM)
    (mono,) = channel_indices(15.0, 0.0, wavelengths_nm=(550.0,))
    assert mono == water_index(550.0, 15.0, 0.0)


# The toolbox of NIST prints nine digits; Ciddor's tables have a tenth of 1e-8.
@pytest.mark.parametrize(
    ("temperature_c", "pressure_kpa", "humidity", "wavelength_nm", "index"),
    [
        (20.0, 101.325, 0.0, 633.0, 1.000271800),
        (20.0, 120.0, 0.0, 633.0, 1.000321916),
        (50.0, 100.0, 0.0, 633.0, 1.000243285),
        (5.0, 100.0, 0.0, 633.0, 1.000282756),
        (-40.0, 100.0, 0.0, 633.0, 1.000337580),
        (50.0, 120.0, 1.0, 633.0, 1.000287924),
        (40.0, 120.0, 0.75, 633.0, 1.000299418),
        (20.0, 100.0, 1.0, 633.0, 1.000267394),
        (40.0, 110.0, 1.0, 1700.0, 1.000270247),
        (20.0, 101.325, 0.0, 300.0, 1.000286581),
        (-40.0, 120.0, 0.0, 300.0, 1.000427233),
    ],
)
def test_air_has_the_index_of_the_published_check_values(temperature_c, pressure_kpa, humidity, wavelength_nm, index):
    found = air_index(wavelength_nm, temperature_c, 1000.0 * pressure_kpa, humidity)
    # The toolbox takes its own saturation pressure, which in damp air at 40 deg C makes 0.8e-9.
    assert found == pytest.approx(index, abs=0.51e-9 if humidity == 0.0 else 1e-9)


@pytest.mark.parametrize(
    ("temperature_c", "pressure_kpa", "humidity", "refractivity"),
    [
        (20.0, 80.0, 0.0, 21458.0),
        (20.0, 100.0, 0.0, 26824.4),
        (20.0, 120.0, 0.0, 32191.6),
        (10.0, 100.0, 0.0, 27774.7),
        (30.0, 100.0, 0.0, 25937.2),
        (20.0, 80.0, 0.75, 21394.0),
        (20.0, 120.0, 0.75, 32127.8),
        (40.0, 120.0, 0.75, 29941.8),
        (50.0, 80.0, 1.0, 19058.4),
        (50.0, 120.0, 1.0, 28792.4),
    ],
)
def test_air_has_the_refractivity_of_ciddors_tables(temperature_c, pressure_kpa, humidity, refractivity):
    found = (air_index(633.0, temperature_c, 1000.0 * pressure_kpa, humidity) - 1.0) * 1e8
    assert found == pytest.approx(refractivity, abs=0.06)


def test_standard_air_and_more_carbon_dioxide():
    assert air_index(589.3) == pytest.approx(1.00027715, abs=0.51e-8)
    # Ciddor, equation 2: 0.534 per million of the refractivity for each ppm.
    assert (air_index(589.3, co2_ppm=950.0) - 1.0) / (air_index(589.3) - 1.0) == pytest.approx(1.000267, abs=2e-5)


@pytest.mark.parametrize("model", [water_index, water_index_parrish])
def test_torch_and_drjit_give_what_numpy_gives(model, Float):
    wave, t, s = np.array([450.0, 550.0, 650.0]), np.array([5.0, 15.0, 25.0]), np.array([0.0, 7.0, 35.0])
    exact = model(wave, t, s)
    np.testing.assert_allclose(model(*(torch.from_numpy(v) for v in (wave, t, s))).numpy(), exact, rtol=1e-15)
    for wrap in (Float, lambda v: torch.tensor(v, dtype=torch.float32)):
        np.testing.assert_allclose(np.asarray(model(wrap(wave), wrap(t), wrap(s))), exact, rtol=FLOAT32)
        np.testing.assert_allclose(np.asarray(air_index(wrap(wave), 20.0, 1e5, 0.5)), air_index(wave, 20.0, 1e5, 0.5))
        np.testing.assert_allclose(np.asarray(water_index_iapws(550.0, wrap(t))), water_index_iapws(550.0, t))


@pytest.mark.parametrize("model", [water_index, water_index_parrish, lambda w, t, s: water_index_iapws(w, t) + 0.0 * s])
def test_indices_have_the_right_gradient(model):
    leaves = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([450.0, 600.0], 12.0, 10.0)]
    # Differences over 1e-3 of a degree, nanometre or per mille: the index changes by 1e-8, known to 1e-16.
    assert torch.autograd.gradcheck(model, leaves, eps=1e-3, atol=1e-10, rtol=1e-5)


def test_air_has_the_right_gradient_on_both_sides_of_freezing():
    leaves = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (550.0, [-10.0, 20.0], 9e4, 0.5)]
    assert torch.autograd.gradcheck(air_index, leaves, eps=1e-3, atol=1e-12, rtol=1e-5)


def test_drjit_gives_the_gradient_of_torch(Float):
    import drjit

    found = Float([450.0, 600.0])
    drjit.enable_grad(found)
    drjit.backward(water_index(found, 12.0, 10.0))
    twin = torch.tensor([450.0, 600.0], dtype=torch.float64, requires_grad=True)
    water_index(twin, 12.0, 10.0).sum().backward()
    # The terms of the derivative cancel to a quarter of the largest.
    np.testing.assert_allclose(np.asarray(drjit.grad(found)), twin.grad.numpy(), rtol=4 * FLOAT32)


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
    with pytest.warns(OutsideFit, match=r"temperature_c is 45, outside the range 0 to 40 of IAPWS R9-97"):
        water_index_iapws(550.0, 45.0)
    with pytest.warns(OutsideFit, match=r"pressure_pa is 70000, outside the range 80000 to 120000 of Ciddor") as caught:
        air_index(550.0, 15.0, 7e4)
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
    for model in (water_index, water_index_parrish):
        with pytest.raises(ValueError, match=said):
            model(*arguments)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"temperature_c": -300.0}, "temperature_c is -300, expected more than -273.15"),
        ({"pressure_pa": 0.0}, "pressure_pa is 0, expected more than 0"),
        ({"humidity": 50.0}, "humidity is 50, expected 0 to 1"),
        ({"co2_ppm": -1.0}, "co2_ppm is -1, expected 0 to 1000000"),
    ],
)
def test_air_that_cannot_be_is_refused(changed, said):
    with pytest.raises(ValueError, match=said):
        air_index(550.0, **changed)


def test_what_is_not_known_stays_unknown():
    np.testing.assert_array_equal(np.isnan(water_index(550.0, np.array([20.0, np.nan]), 0.0)), [False, True])


def test_sea_water_freezes_where_the_unesco_table_says():
    # Fofonoff and Millard's table, at the surface.
    np.testing.assert_allclose(freezing_point(np.array([5.0, 20.0, 35.0])), [-0.274, -1.083, -1.922], atol=5e-4)
