"""Windows that widen where photographs have little in common, and heights of pairs of photographs of water."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, ring
from rippled_pair import SIZE, rippled_pair

from fields.sweep.bed import is_supported
from fields.sweep.kernels.arrays import run_job
from fields.sweep.kernels.stack import Hypotheses
from fields.sweep.maps import HeightMap, OrderedMaps, height_std, trusted
from fields.sweep.matching import RADII, Reference, match_view, match_with_adaptive_windows, radius_for
from fields.sweep.sweep import sweep
from fields.sweep.view_pass import SweepSettings
from fields.sweep.wide_windows import averaged, wet_pairs, window_std, with_wide_windows

SHAPE, NOISE_M = (170, 204), 0.5
# As many pixels as a wide window has on a side.
WINDOW_PX = 17


def wide_map(seed: int = 0) -> HeightMap:
    """A sloping bed with an error for each window of its own."""
    rng = np.random.default_rng(seed)
    row, column = np.indices(SHAPE)
    noise = NOISE_M * rng.standard_normal((SHAPE[0] // WINDOW_PX, SHAPE[1] // WINDOW_PX))
    height = -3.0 + 0.01 * column - 0.02 * row + np.kron(noise, np.ones((WINDOW_PX, WINDOW_PX)))
    one = np.ones(SHAPE, np.float16)
    return HeightMap(0, height.astype(np.float32), np.float16(0.95) * one, one.astype(np.uint8), 0 * one)


def test_the_std_of_windows_is_that_of_their_errors_and_not_of_a_slope():
    found = [np.mean(window_std(wide_map(seed)) ** 2) for seed in range(10)]
    # Ten maps of 120 windows, of which second differences share values.
    assert np.sqrt(np.mean(found)) == pytest.approx(NOISE_M, rel=0.1)
    flat = wide_map()
    flat.height[:] = -3.0 + 0.01 * np.indices(SHAPE)[1]
    assert window_std(flat).max() < 1e-3


def test_averaged_heights_err_by_what_their_spread_says():
    ratios = []
    for seed in range(10):
        m = averaged(wide_map(seed))
        row, column = np.indices(SHAPE)
        # Without the rim, where a mean of a slope leans inwards.
        inner = np.s_[30:-30, 30:-30]
        error = (m.height - (-3.0 + 0.01 * column - 0.02 * row))[inner]
        std = height_std(m.height, m.agreeing, m.spread, 1.0)[inner]
        ratios.append(np.mean(error**2) / np.mean(std**2))
    assert 0.5 < np.sqrt(np.mean(ratios)) < 1.0


def test_a_false_match_does_not_pull_the_mean():
    m, wrong = wide_map(), wide_map()
    wrong.height[80:90, 100:110] += 8.0
    assert np.abs(averaged(wrong).height - averaged(m).height).max() < 0.3


def block(neighbours: int, water: object):
    return SimpleNamespace(water=water, neighbours=lambda view, count: list(range(neighbours)))


@pytest.mark.parametrize(("neighbours", "water"), [(2, object()), (1, None), (12, None)])
def test_maps_stay_as_they_are_where_a_third_photograph_looks_or_all_is_dry(neighbours, water):
    maps = OrderedMaps({0: wide_map()}, [0])
    assert with_wide_windows(block(neighbours, water), maps, (-5.0, 5.0), None) is maps


def test_two_photographs_of_water_are_a_pair():
    assert wet_pairs(block(1, object()), [0, 1]) == [0, 1]


@pytest.mark.slow
def test_ripples_that_moved_leave_the_bed_in_its_place():
    inside, errors = [], []
    for seed in range(4):
        pair, bound = rippled_pair(seed), (-8.0, 4.0)
        narrow = sweep(pair.block, [0, 1], SweepSettings(bound), lambda _share: None)
        wide = with_wide_windows(pair.block, narrow, bound, None)
        for before, after, truth in zip(narrow, wide, pair.truth, strict=True):
            tolerance = pair.block.agreement_tolerance(after.view, [1 - after.view], -pair.depth)
            ours = np.s_[: SIZE[1], : SIZE[0]]
            of_ripples, kept = (is_supported(m.height, trusted(m), tolerance)[ours] for m in (before, after))
            # Without wide windows hardly a pixel is a point.
            assert of_ripples.mean() < 0.02
            assert kept.mean() > 0.15
            error = (after.height[ours] - truth)[kept]
            std = height_std(after.height, after.agreeing, after.spread, tolerance)[ours][kept]
            errors.append(error)
            inside.append(np.abs(error) < 1.96 * std)
    # Of beds 2 to 4 m deep, at 6 cm a pixel.
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.1
    assert np.concatenate(inside).mean() > 0.8


# Waves of 3 to 10 px: windows hold as many independent values as pixels, nearly.
BED = PlaneBed(TILTED, -2.0, lengths=(0.04, 0.15))
OTHERS, STEP, NUM_HYPOTHESES = [1, 2, 3, 4, 5, 6], 0.04, 41


def matched(device, images, match):
    """What matching with windows of 5 px finds, the last radius [px], and the errors of its heights [m]."""
    cameras = ring(6)
    truth = BED.true_height(cameras[0]).astype(np.float32)
    start = np.full_like(truth, truth.mean() - 0.5 * STEP * (NUM_HYPOTHESES - 1))
    stack = BED.block(device, cameras, images).stack(1.0)
    found = run_job(device, match(Reference(stack, 0, OTHERS, 2), Hypotheses(start, STEP, NUM_HYPOTHESES)))
    images, radius = found if match is match_with_adaptive_windows else (found, 2)
    return images, radius, np.abs(images[0] - truth)[8:-8, 8:-8]


def lit(rng, contrast: float) -> list[np.ndarray]:
    """The photographs, the light on each of which has a pattern of its own."""
    found = []
    for camera in ring(6):
        pattern = cv2.GaussianBlur(rng.normal(size=(camera.height, camera.width)), (0, 0), 0.7)
        found.append((128.0 + BED.photograph(camera)) * np.exp(contrast * pattern / pattern.std()) - 128.0)
    return [image.astype(np.float32) for image in found]


def test_quiet_images_keep_their_windows(device):
    found, radius, _ = matched(device, None, match_with_adaptive_windows)
    assert radius == 2
    for each, narrow in zip(found, matched(device, None, match_view)[0], strict=True):
        np.testing.assert_array_equal(each, narrow)


def test_light_that_differs_in_each_photograph_gets_wider_windows_and_these_find_the_bed(device, rng):
    images = lit(rng, 0.4)
    _, radius, wide = matched(device, images, match_with_adaptive_windows)
    _, _, narrow = matched(device, images, match_view)
    assert radius >= 4
    assert (wide < STEP).mean() > (narrow < STEP).mean() + 0.2


def test_windows_between_many_missing_pixels_stay_narrow(device, rng):
    images = lit(rng, 0.4)
    hole = (np.arange(72)[:, None] % 13 < 5) & (np.arange(96) % 13 < 5)
    images = [np.where(hole, np.float32(np.nan), image) for image in images]
    _, radius, _ = matched(device, images, match_with_adaptive_windows)
    assert radius == 2


@pytest.mark.parametrize("count", [3, 40, 400])
def test_lower_scores_and_more_hypotheses_ask_for_wider_windows(count):
    radii = [radius_for(score, (300, 400), 2, count) for score in (0.95, 0.7, 0.5, 0.3, 0.1)]
    longer = [radius_for(score, (300, 400), 2, 10 * count) for score in (0.95, 0.7, 0.5, 0.3, 0.1)]
    assert radii == sorted(radii)
    assert (radii[0], radii[-1]) == (2, RADII[-1])
    assert all(a <= b for a, b in zip(radii, longer, strict=True))


def test_windows_stay_a_small_part_of_the_image():
    assert radius_for(0.1, (24, 32), 2, 40) == 2
