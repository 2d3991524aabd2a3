"""Spectral slope of the bed, estimated from what the photographs resolve of it."""

from __future__ import annotations

import numpy as np
import pytest
from solved_tiles import level, residuals, white

from fields.solver.roughness import spectral_slope_of
from fields.solver.uncertainty import PRIOR_SPECTRAL_SLOPE, expected_variances

ROUGHNESS = 0.01


def bed(spectral_slope: float, seed: int, size: int = 96) -> np.ndarray:
    """Heights (size, size) [m] whose power falls so, and which bend by `ROUGHNESS` from pixel to pixel."""
    along = 2.0 - 2.0 * np.cos(2.0 * np.pi * np.fft.fftfreq(size))
    symbol = (along[:, None] + along) ** 2
    symbol[0, 0] = np.inf
    waves = np.fft.fft2(np.random.default_rng(seed).standard_normal((size, size))) * symbol ** (-0.5 * spectral_slope)
    heights = np.fft.ifft2(waves).real
    return heights * ROUGHNESS / np.diff(heights, 2, axis=0).std()


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_a_bed_that_is_rougher_at_small_scale_is_told_from_that_of_the_prior(noise):
    found = [
        spectral_slope_of([residuals(noise * white(8, 1 + seed), relief=bed(spectral_slope, seed))], ROUGHNESS, 1.0)
        for spectral_slope, seed in [(0.5, 0), (0.5, 1), (0.7, 0), (0.7, 1), (1.0, 0), (1.0, 1)]
    ]
    assert max(found[:2]) < min(found[2:4])
    assert max(found[2:4]) < min(found[4:])
    assert found == pytest.approx([0.5, 0.5, 0.7, 0.7, 1.0, 1.0], abs=0.2)


def test_where_noise_hides_the_bed_it_is_that_of_the_prior():
    assert spectral_slope_of([residuals(white(8))], ROUGHNESS, 1.0) == PRIOR_SPECTRAL_SLOPE
    assert spectral_slope_of([level(1.0, ROUGHNESS)], ROUGHNESS, 1.0) == PRIOR_SPECTRAL_SLOPE


def test_more_is_smoothed_away_of_a_bed_that_is_rougher_at_small_scale():
    tile, result = level(1.0 / 0.02**2, ROUGHNESS)
    rough, prior = (
        expected_variances(tile, result, 1.0, spectral_slope) for spectral_slope in (0.7, PRIOR_SPECTRAL_SLOPE)
    )
    shares = [np.median(each.relief / each.changed_relief) for each in (rough, prior)]
    assert shares[0] > 1.2 * shares[1]
    assert np.array_equal(rough.noise, prior.noise)
