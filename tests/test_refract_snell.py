"""Bending a ray at a plane: Snell's law, its invariants, and what happens where no ray passes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from refract import bend

EPS = np.finfo(np.float64).eps
ROUNDINGS = 8 * EPS  # eight roundings on the way through bend; measured worst 4 EPS
INDEX_PAIRS = [(1.0, 1.333), (1.333, 1.0), (1.0, 1.0), (1.333, 1.34), (1.0, 1.6), (1.6, 1.0)]
UP = np.array([0.0, 0.0, 1.0])


def downward(angle):
    """Unit rays (..., 3) that fall at ``angle`` [rad] to the vertical, toward +x."""
    angle = np.asarray(angle, dtype=np.float64)
    return np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=-1)


def scattered(rng, count):
    """Random unit normals and unit rays that meet them from their own side."""
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    ray = rng.normal(size=(count, 3))
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    ray *= -np.sign(np.sum(ray * normal, axis=-1, keepdims=True))
    return ray, normal


@pytest.mark.parametrize(("n_from", "n_to"), INDEX_PAIRS)
def test_sines_to_the_normal_scale_with_the_index_at_every_angle(n_from, n_to):
    angle = np.radians(np.linspace(0.0, 89.9999, 20_001))
    bent = bend(downward(angle), UP, n_from=n_from, n_to=n_to)
    passes = n_from * np.sin(angle) < n_to * (1.0 - 1e-15)
    residual = n_from * np.sin(angle) - n_to * bent[:, 0]
    assert np.abs(residual[passes]).max() < ROUNDINGS
    assert (bent[passes, 2] < 0.0).all()


def test_equal_indices_return_the_ray_to_the_last_bit(rng):
    ray, normal = scattered(rng, 10_000)
    np.testing.assert_array_equal(bend(ray, normal, n_from=1.333, n_to=1.333), ray)


def test_grazing_rays_enter_the_water_at_the_critical_angle():
    grazing = downward(np.pi / 2 - np.array([1e-3, 1e-6, 1e-9, 1e-12, 1e-15]))
    bent = bend(grazing, UP, n_from=1.0, n_to=1.333)
    # sin(a) = 1 - delta^2 / 2: the last four angles have the critical sine to the last bit
    np.testing.assert_allclose(bent[1:, 0], 1.0 / 1.333, rtol=1e-12)
    np.testing.assert_allclose(bent[1:, 2], -math.sqrt(1.0 - 1.0 / 1.333**2), rtol=1e-12)


def test_total_reflection_starts_at_the_critical_angle_and_gives_nan():
    critical = math.asin(1.0 / 1.333)  # 48.6066 deg
    assert math.degrees(critical) == pytest.approx(48.61, abs=0.005)
    just = 1e-9
    assert np.isfinite(bend(downward(critical - just), UP, n_from=1.333, n_to=1.0)).all()
    assert np.isnan(bend(downward(critical + just), UP, n_from=1.333, n_to=1.0)).all()


def test_totally_reflected_rays_have_zero_gradient_and_leave_the_others_alone():
    angle = np.radians([20.0, 60.0, math.degrees(math.asin(1 / 1.333)) + 1e-6])
    rays = torch.tensor(downward(angle), requires_grad=True)
    up = torch.tensor(UP, requires_grad=True)
    bent = bend(rays, up, n_from=1.333, n_to=1.0)
    bent.nansum().backward()
    assert torch.isnan(bent).all(dim=-1).tolist() == [False, True, True]
    assert rays.grad[1:].abs().max() == 0.0
    assert rays.grad[0].abs().min() > 0.0
    assert torch.isfinite(up.grad).all()


def test_gradient_is_finite_exactly_at_the_critical_angle():
    # 0.8 and 0.6 with an index of 1.25: the cosine in air is zero, and its root has an infinite slope
    ray = torch.tensor([0.8, 0.0, -0.6], dtype=torch.float64, requires_grad=True)
    bent = bend(ray, torch.tensor(UP), n_from=1.25, n_to=1.0)
    bent.nansum().backward()
    assert torch.isfinite(ray.grad).all()


def test_indices_cannot_be_swapped_by_position():
    with pytest.raises(TypeError):
        bend(-UP, UP, 1.0, 1.333)
