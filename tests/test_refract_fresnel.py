"""What the surface reflects and lets pass: textbook values, both ways, energy, and gradients that stay finite."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from surface_rays import LIBRARIES, array_of

from refract.snell import fresnel_coefficients

N = 1.333
BREWSTER, CRITICAL = math.atan(N), math.asin(1.0 / N)
EPS32 = float(np.finfo(np.float32).eps)
# Angles in air over all incidences, and in water up to 0.01 degrees from the critical angle.
IN_AIR = np.radians(np.linspace(0.0, 90.0, 181))
IN_WATER = np.linspace(0.0, CRITICAL - 1.7e-4, 181)


def into_water(angle):
    return fresnel_coefficients(np.cos(angle), n_from=1.0, n_to=N)


@pytest.mark.parametrize(
    ("angle_deg", "reflectance"), [(0, 0.0204), (15, 0.0204), (30, 0.0214), (45, 0.0279), (60, 0.0597), (75, 0.2124)]
)
def test_unpolarised_light_is_reflected_as_tables_say(angle_deg, reflectance):
    assert into_water(math.radians(angle_deg)).reflectance == pytest.approx(reflectance, abs=0.51e-4)


def test_reflectance_is_that_of_fresnels_sine_and_tangent_laws():
    angle = IN_AIR[1:-1]
    other = np.arcsin(np.sin(angle) / N)
    found = into_water(angle)
    # The laws themselves lose digits where the two angles or their tangents are near to each other.
    np.testing.assert_allclose(found.reflectance_s, (np.sin(angle - other) / np.sin(angle + other)) ** 2, rtol=1e-11)
    tangents = (np.tan(angle - other) / np.tan(angle + other)) ** 2
    np.testing.assert_allclose(found.reflectance_p, tangents, rtol=1e-11, atol=1e-15)


def test_straight_down_both_polarisations_are_alike():
    found = into_water(0.0)
    expected = ((N - 1.0) / (N + 1.0)) ** 2
    assert (found.reflectance_s, found.reflectance_p) == pytest.approx((expected, expected), rel=1e-14)


def test_at_brewsters_angle_only_one_polarisation_is_reflected():
    found = into_water(BREWSTER)
    assert math.degrees(BREWSTER) == pytest.approx(53.12, abs=0.005)
    assert found.reflectance_p == pytest.approx(0.0, abs=1e-30)
    assert found.reflectance_s == pytest.approx(((1.0 - N**2) / (1.0 + N**2)) ** 2, rel=1e-13)


def test_light_along_the_surface_is_reflected_and_none_at_equal_indices():
    assert fresnel_coefficients(0.0, n_from=1.0, n_to=N)[:] == (1.0, 1.0, 0.0, 0.0)
    for cosine in (1.0, 0.7, 1e-9):
        assert fresnel_coefficients(cosine, n_from=N, n_to=N)[:] == (0.0, 0.0, 1.0, 1.0)


def test_beyond_the_critical_angle_all_is_reflected():
    assert math.degrees(CRITICAL) == pytest.approx(48.61, abs=0.005)
    for angle in (CRITICAL + 1e-9, 1.0, 0.5 * math.pi):
        assert fresnel_coefficients(math.cos(angle), n_from=N, n_to=1.0)[:] == (1.0, 1.0, 0.0, 0.0)
    # Just inside, R_s = 1 - 4 b / a with b the root of a small difference: 1e-8 off the angle leaves 6e-4.
    assert 0.0 < 1.0 - fresnel_coefficients(math.cos(CRITICAL - 1e-8), n_from=N, n_to=1.0).reflectance < 2e-3


def test_a_cosine_of_the_other_side_is_not_known():
    assert np.isnan(fresnel_coefficients(np.array(-0.1), n_from=1.0, n_to=N)).all()


def test_the_surface_is_the_same_from_both_sides():
    down = into_water(IN_AIR)
    up = fresnel_coefficients(np.sqrt(1.0 - (np.sin(IN_AIR) / N) ** 2), n_from=N, n_to=1.0)
    # Near 90 degrees in air, the cosine there comes out of the one in water as the root of a small difference.
    for ours, others in zip(down, up, strict=True):
        np.testing.assert_allclose(ours, others, atol=4e-8)
        np.testing.assert_allclose(ours[:-2], others[:-2], rtol=1e-11, atol=1e-15)


@pytest.mark.parametrize("library", LIBRARIES)
def test_what_is_reflected_and_what_passes_add_up_to_one(library):
    eps = EPS32 if library == "torch.float32" else float(np.finfo(np.float64).eps)
    for angles, n_from, n_to in ((IN_AIR, 1.0, N), (IN_WATER, N, 1.0), (np.linspace(0.9, 1.5, 50), N, 1.0)):
        exact = fresnel_coefficients(np.cos(angles), n_from=n_from, n_to=n_to)
        found = fresnel_coefficients(array_of(library, np.cos(angles)), n_from=n_from, n_to=n_to)
        sums = (found.reflectance_s + found.transmittance_s, found.reflectance_p + found.transmittance_p)
        for total in (*sums, found.reflectance + found.transmittance):
            np.testing.assert_allclose(np.asarray(total), 1.0, atol=4 * eps)  # measured 2
        # The derivative by the cosine reaches 1e2 at 0.01 degrees from the critical angle; measured 93.
        for ours, truth in zip(found, exact, strict=True):
            np.testing.assert_allclose(np.asarray(ours), truth, atol=200 * eps)


@pytest.mark.parametrize(
    ("n_from", "n_to", "angles_deg"),
    [(1.0, N, [1.0, 30.0, 53.1, 80.0, 89.9]), (N, 1.0, [1.0, 20.0, 36.9, 48.0]), (N, N, [1.0, 30.0, 80.0])],
)
def test_gradients_are_right_in_angle_and_indices(n_from, n_to, angles_deg):
    leaves = [
        torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (np.cos(np.radians(angles_deg)), n_from, n_to)
    ]
    # Second derivatives reach 1e3 at the steepest of these angles: differences of 1e-7 are known to 1e-6.
    assert torch.autograd.gradcheck(
        lambda c, a, b: fresnel_coefficients(c, n_from=a, n_to=b), leaves, eps=1e-7, atol=1e-5
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_everywhere_and_zero_beyond_the_critical_angle(dtype):
    cosine = torch.linspace(0.0, 1.0, 2001, dtype=dtype)
    exactly_critical = torch.tensor([math.cos(CRITICAL)], dtype=dtype)
    for n_from, n_to in ((1.0, N), (N, 1.0), (N, N)):
        leaf = torch.cat([cosine, exactly_critical]).requires_grad_()
        indices = [torch.tensor(n, dtype=dtype, requires_grad=True) for n in (n_from, n_to)]
        for share in fresnel_coefficients(leaf, n_from=indices[0], n_to=indices[1]):
            gradients = torch.autograd.grad(share.sum(), [leaf, *indices], retain_graph=True)
            assert all(torch.isfinite(g).all() for g in gradients)
            if n_from > n_to:
                beyond = leaf < math.cos(CRITICAL + 1e-3)
                assert not gradients[0][beyond].any()
    leaf = torch.tensor([0.0, 1.0], dtype=dtype, requires_grad=True)
    fresnel_coefficients(leaf, n_from=1.0, n_to=N).reflectance_s.sum().backward()
    # Along the surface R_s falls as 1 - 4 a / b.
    assert leaf.grad[0].item() == pytest.approx(-4.0 / math.sqrt(N * N - 1.0), rel=1e-6)


def test_diffuse_light_is_reflected_as_the_squared_index_demands():
    """Over all directions, what does not pass upward is n^2 times what does not pass downward (Kubelka)."""
    angle = (np.arange(200_000) + 0.5) * (0.5 * np.pi / 200_000)
    weight = 2.0 * np.sin(angle) * np.cos(angle) * (0.5 * np.pi / 200_000)
    from_air = np.sum(weight * fresnel_coefficients(np.cos(angle), n_from=1.0, n_to=N).reflectance)
    from_water = np.sum(weight * fresnel_coefficients(np.cos(angle), n_from=N, n_to=1.0).reflectance)
    assert from_air == pytest.approx(0.066, abs=1e-3)
    # The midpoint rule over the kink at the critical angle is good to (2e5)^-1.5.
    assert 1.0 - from_water == pytest.approx((1.0 - from_air) / N**2, abs=1e-6)
