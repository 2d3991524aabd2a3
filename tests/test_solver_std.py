"""Std of solved heights, part by part: noise, relief that is smoothed away, shifts; and the spectral slope of beds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from solved_tiles import level, plain_tile, residuals, white

from fields.solver.gauss_newton import CG_RESIDUAL, TileSolution, gradient_response
from fields.solver.noise import NoiseShares, Shifts, median_response, noise_shares, null_solutions_of, shifts_of
from fields.solver.roughness import spectral_slope_of
from fields.solver.tile import SolverTile
from fields.solver.uncertainty import (
    PRIOR_SPECTRAL_SLOPE,
    ExpectedVariances,
    effective_sample_weight,
    expected_variances,
    smoothed_relief,
    smoothing_change,
    solve_normal_equations,
    subpixel_relief,
)

INFORMATION, ROUGHNESS, RESPONSE = 1.0 / 0.02**2, 0.01, 0.8
STILL = Shifts(0.0, 0.0)


@pytest.mark.parametrize("roughness", [0.003, 0.03])
def test_noise_and_relief_of_the_prior_are_the_diagonal_of_the_inverse(roughness):
    tile, result = level(INFORMATION, roughness)
    unit = np.zeros(len(tile), dtype=np.float32)
    unit[20 * 40 + 20] = 1.0
    exact = result.differences.solve(result.information, result.stiffness, unit, CG_RESIDUAL)[20 * 40 + 20]
    found = expected_variances(tile, result, 1.0)
    assert (found.noise + found.relief)[20 * 40 + 20] == pytest.approx(exact, rel=0.05)


def heights(result: TileSolution, relief: np.ndarray, seed: int = 3) -> np.ndarray:
    """What the solver makes of a bed (N,) [m] seen with independent noise, to which residuals answer in part."""
    noise = np.random.default_rng(seed).standard_normal(len(relief))
    effective = RESPONSE * result.information
    return solve_normal_equations(
        result, effective * relief + np.sqrt(result.information) * noise, RESPONSE, CG_RESIDUAL
    )


def test_noise_moves_heights_and_their_changes_as_expected():
    tile, result = level(INFORMATION, ROUGHNESS, 120)
    expected = expected_variances(tile, result, RESPONSE)
    found = heights(result, np.zeros(len(tile)))
    assert np.mean(found**2) == pytest.approx(np.mean(expected.noise), rel=0.15)
    assert np.mean(smoothing_change(result, found, RESPONSE) ** 2) == pytest.approx(
        np.mean(expected.changed_noise), rel=0.15
    )


def bed_of_the_prior(result: TileSolution, size: int) -> np.ndarray:
    """A bed (size * size,) [m] that bends as the prior says."""
    along = 2.0 - 2.0 * np.cos(2.0 * np.pi * np.fft.fftfreq(size))
    symbol = along[:, None] + along
    symbol[0, 0] = np.inf
    spectrum = np.fft.fft2(np.random.default_rng(6).standard_normal((size, size))) / symbol
    return np.fft.ifft2(spectrum).real.ravel() / np.sqrt(result.stiffness[0])


def relief(tile: SolverTile, result: TileSolution, bed: np.ndarray) -> tuple[np.ndarray, ExpectedVariances]:
    expected = expected_variances(tile, result, RESPONSE)
    change = smoothing_change(result, heights(result, bed), RESPONSE)
    return smoothed_relief(tile, change, expected, 1.0, 1.0), expected


@pytest.mark.parametrize("times", [0.0, 1.0, 3.0])
def test_relief_that_is_smoothed_away_is_known_without_the_bed(times):
    size = 120
    tile, result = level(INFORMATION, ROUGHNESS, size)
    bed = times * bed_of_the_prior(result, size)
    lost = solve_normal_equations(result, RESPONSE * result.information * bed, RESPONSE, CG_RESIDUAL) - bed
    found, expected = relief(tile, result, bed)
    inner = np.abs(np.array(tile.places) - size // 2).max(axis=0) < size // 2 - 8
    # A bed without relief cannot be told from one with little of it.
    assert np.mean(found[inner]) == pytest.approx(np.mean(lost[inner] ** 2), rel=0.3, abs=0.2 * expected.relief.mean())


def test_relief_is_where_it_is():
    size = 120
    tile, result = level(INFORMATION, ROUGHNESS, size)
    rough = tile.places[1] > size // 2
    found, _ = relief(tile, result, 3.0 * bed_of_the_prior(result, size) * rough)
    beyond = np.abs(tile.places[1] - size // 2) > 12
    assert np.median(found[rough & beyond]) > 10.0 * np.median(found[~rough & beyond])


@pytest.mark.parametrize(("values", "low", "high"), [(np.inf, 100.0, np.inf), (8.0, 4.0, 16.0)])
def test_a_tile_counts_for_its_places_as_much_as_they_are_alike(values, low, high):
    random, size, number = np.random.default_rng(7), 40_000, 10.0
    scale = np.ones(size) if np.isinf(values) else values / random.chisquare(values, size)
    found = effective_sample_weight(scale * random.chisquare(number, size) / number, np.ones(size, dtype=bool), number)
    assert low < np.max(found) < high


def test_a_tile_hardly_counts_about_an_edge():
    ratio = np.random.default_rng(7).chisquare(10.0, 40_000) / 10.0
    ratio[:100] = 30.0
    found = effective_sample_weight(ratio, np.ones(len(ratio), dtype=bool), 10.0)
    np.testing.assert_allclose(found[:100], 2.0)
    assert np.median(found) > 100.0


def test_noise_of_its_own_in_each_pixel_counts_once_and_noise_that_neighbours_share_more():
    shared = ndimage.gaussian_filter(white(8), (0.0, 0.8, 0.8))
    alone, more = (
        noise_shares(null_solutions_of([residuals(noise)], ROUGHNESS, 1.0), 1.0, STILL, is_wet=True)
        for noise in (white(8), shared / shared.std())
    )
    assert alone.height_variance_ratio == pytest.approx(1.0, abs=0.25)
    assert alone.smoothing_variance_ratio == pytest.approx(1.0, abs=0.25)
    # Over long waves the signs of the texture take a part of it back.
    assert more.height_variance_ratio > 1.25 * alone.height_variance_ratio


@pytest.mark.parametrize(("relief_m", "low", "high"), [(0.0, 0.0, 0.1), (0.03, 1.0, 1.0)])
def test_residuals_tell_whether_heights_follow_the_bed_from_pixel_to_pixel(relief_m, low, high):
    relief = relief_m * white(1, seed=4)[0] / 3.0
    found = noise_shares(
        null_solutions_of([residuals(white(8), relief=relief)], ROUGHNESS, 1.0), 1.0, STILL, is_wet=True
    )
    assert low <= found.excess_relief <= high


def test_heights_have_no_more_noise_than_the_residuals_along_them():
    null_solutions = null_solutions_of([residuals(white(8))], ROUGHNESS, 1.0)
    quieter = replace(null_solutions, residual_squared=0.5 * null_solutions.remainder_squared)
    whole, half = (
        noise_shares(each, 1.0, STILL, is_wet=True).height_variance_ratio for each in (null_solutions, quieter)
    )
    assert half == pytest.approx(0.5 * whole, rel=0.15)


def test_bends_of_noise_are_none_of_the_bed():
    tile, result = level(INFORMATION, ROUGHNESS, 120)
    expected = expected_variances(tile, result, RESPONSE)
    noisy = replace(result, height=heights(result, np.zeros(len(tile))))
    differences = subpixel_relief(tile, noisy, expected, 1.0, 1.0)
    assert np.mean(differences) == pytest.approx(np.mean(expected.differences_noise), rel=0.15)
    assert np.mean(subpixel_relief(tile, noisy, expected, 1.0, 0.0)) < 0.4 * np.mean(differences)


def test_bends_beyond_noise_are_those_of_the_bed_about_a_height():
    tile, result = level(INFORMATION, ROUGHNESS, 120)
    expected, bent = (
        expected_variances(tile, result, RESPONSE),
        replace(result, height=20.0 * heights(result, np.zeros(len(tile)))),
    )
    found, all_of_it = (subpixel_relief(tile, bent, expected, 1.0, excess) for excess in (0.0, 1.0))
    assert np.mean(found) > 0.95 * np.mean(all_of_it)
    # A few values are small by chance: of single heights a twentieth has a fifth of the mean.
    assert np.quantile(found, 0.05) > 0.5 * np.mean(found)


def test_an_edge_is_no_relief_of_the_ground_beside_it():
    tile, result = level(INFORMATION, ROUGHNESS, 120)
    columns = np.nonzero(tile.inside)[1]
    edge = replace(result, height=np.where(columns < columns.mean(), 0.0, 1.0))
    found = np.sqrt(subpixel_relief(tile, edge, expected_variances(tile, result, RESPONSE), 0.0, 0.0))
    distance = np.abs(columns - columns.mean())
    assert found[distance < 1.0].min() > 0.3
    assert found[distance > 4.0].max() < 0.04


def test_shifts_are_no_noise():
    null_solutions = null_solutions_of([residuals(white(8), shift_px=0.3)], ROUGHNESS, 1.0)
    all_noise, rest = (
        noise_shares(null_solutions, 1.0, Shifts(px, 0.0), is_wet=True).height_variance_ratio for px in (0.0, 0.3)
    )
    assert rest < 0.7 * all_noise


def test_two_photographs_tell_neither_noise_that_is_shared_nor_shifts():
    sample = [residuals(white(2), shift_px=0.3)]
    assert noise_shares(null_solutions_of(sample, ROUGHNESS, 0.9), 0.9, STILL, is_wet=True) == NoiseShares(
        0.9, 1.0, 1.0, 1.0
    )
    assert shifts_of(sample, 1.0, is_wet=True).variance(np.array([2.0])) == 0.0


def test_shifts_of_photographs_are_measured_beyond_their_noise():
    still, moved = (shifts_of([residuals(white(8), shift_px=shift)], 1.0, is_wet=False) for shift in (0.0, 0.3))
    assert still.pose_std_px < 0.03
    assert moved.pose_std_px == pytest.approx(0.3, rel=0.25)


def test_shifts_that_grow_with_the_depth_are_those_of_waves():
    sample = [residuals(white(8), depth, 0.1 * depth) for depth in (0.0, 1.0, 3.0)]
    found = shifts_of(sample, 1.0, is_wet=True)
    assert found.wave_std_px_per_m == pytest.approx(0.1, rel=0.25)
    assert found.pose_std_px < 0.05
    assert (np.diff(found.variance(np.array([0.0, 1.0, 2.0]))) > 0.0).all()


def test_the_response_is_that_to_small_steps():
    step = np.array([0.01, -0.01, 0.01, 1.0])
    information = np.array([1.0, 2.0, 3.0, 4.0])
    change = np.array([0.8, 0.8, 0.8, 0.0]) * information * step
    assert gradient_response(information, np.ones(4), step, np.ones(4) + change) == pytest.approx(0.8)
    assert np.isnan(gradient_response(information, np.ones(4), np.zeros(4), np.ones(4)))


def test_the_response_of_a_survey_is_that_of_most_samples():
    _, result = level(INFORMATION, ROUGHNESS)
    samples = [(plain_tile(40), replace(result, response=value)) for value in (0.8, 0.9, 7.0, np.nan)]
    assert median_response(samples) == pytest.approx(0.9)
    assert median_response(samples[3:]) == 1.0


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
