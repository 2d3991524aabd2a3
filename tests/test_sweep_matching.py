"""Matching of one view among height hypotheses: plane beds of known height, masks, edges and strips."""

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, match, ring

from fields.sweep import matching
from refract import FlatWater

STEP, NUM_HYPOTHESES, RADIUS = 0.04, 9, 2
BEDS = {
    "wet": PlaneBed(TILTED, -2.0),
    "dry": PlaneBed(None, -2.0),
    "shore": PlaneBed(FlatWater((0.0, 0.0, -2.0), n_water=1.34, slope_x=0.01, slope_y=0.02), -2.0, slope=0.3),
    "index one": PlaneBed(FlatWater((0.0, 0.0, 0.0), n_water=1.0), -2.0),
}
# Errors of a noise-free plane, in steps of 0.04 m (0.6 px of parallax): half of the pixels, and 90 % of them; what is
# left is bilinear interpolation, most where few neighbours see the bed. Measured at worst 0.025 and 0.127.
HALF, MOST = 0.04, 0.18
# Mean error over the view [m]; measured at worst 0.6 mm, and 0.95 mm at a slope of 0.3.
BIAS_M = 1e-3


def is_close(error) -> bool:
    """Whether errors [m] of heights are as small as said above."""
    half, most = np.quantile(np.abs(error), [0.5, 0.9])
    return half < HALF * STEP and most < MOST * STEP and abs(error.mean()) < BIAS_M


def match_plane(device, bed: PlaneBed, offset: float, *, spoil=None, cameras=None):
    """True heights of view 0 and those of `match_view`, on hypotheses centred `offset` [m] off the truth."""
    cameras = cameras or ring(6)
    images = [bed.photograph(camera) for camera in cameras]
    if spoil is not None:
        spoil(images, cameras)
    block = bed.block(device, cameras, images)
    truth = bed.true_height(cameras[0])
    start = truth + offset - STEP * (NUM_HYPOTHESES // 2)
    return truth, *match(block.stack(1.0), list(range(1, len(cameras))), start, STEP, NUM_HYPOTHESES, RADIUS)


@pytest.mark.parametrize(
    ("bed", "offset"), [*((bed, 0.35) for bed in BEDS), *(("wet", offset) for offset in (-0.5, -0.25, 0.0, 0.25, 0.5))]
)
def test_hypotheses_about_the_bed_find_a_plane_to_a_fraction_of_a_step(device, bed, offset):
    """Parabolas through three scores may pull heights to a hypothesis ("pixel locking"): wherever it lies, not here."""
    truth, height, score, curvature = match_plane(device, BEDS[bed], offset * STEP)
    found = curvature > 0.0
    assert found.mean() > 0.85
    assert is_close((height - truth)[found])
    assert np.median(score[found]) > 0.998


def test_one_range_for_a_whole_image_finds_relief_that_it_spans(device):
    bed, cameras = BEDS["shore"], ring(6)
    truth = bed.true_height(cameras[0])
    start = np.full(truth.shape, truth.min() - 2.4 * STEP, np.float32)
    count = int(np.ceil(np.ptp(truth) / STEP)) + 5
    stack = bed.stack(device, cameras)
    height, _, curvature = match(stack, [1, 2, 3, 4, 5, 6], start, STEP, count, RADIUS)
    assert truth.min() < 0.0 < truth.max()
    error = (height - truth)[curvature > 0.0]
    assert abs(np.median(error)) < BIAS_M
    # Windows are level here, the bed rises by 0.3: each then mixes heights of 2 cm.
    assert np.quantile(np.abs(error), 0.9) < STEP


def test_where_no_window_is_complete_the_score_says_so_and_the_nearest_height_stands_in(device):
    _, height, score, curvature = match_plane(device, BEDS["wet"], 0.0)
    edge = np.ones(height.shape, dtype=bool)
    edge[RADIUS:-RADIUS, RADIUS:-RADIUS] = False
    assert (score[edge] == -1.0).all()
    assert (curvature[score == -1.0] == 0.0).all()
    known = np.argwhere(score > -1.0)
    for row, column in np.argwhere(score == -1.0)[::37]:
        distance = np.hypot(*(known - (row, column)).T)
        # The distance transform is exact to about 5 %: the height is that of one of the nearest.
        near = known[distance <= 1.06 * distance.min() + 0.5]
        assert height[row, column] in height[near[:, 0], near[:, 1]]


def test_strips_give_what_the_whole_image_gives(device, monkeypatch):
    bed, cameras = BEDS["wet"], ring(3)
    stack, start = bed.stack(device, cameras), bed.true_height(cameras[0]) - 0.1
    whole = match(stack, [1, 2, 3], start, STEP, 5, RADIUS)
    monkeypatch.setattr(matching, "SAMPLES_PER_LAUNCH", 1)  # the fewest rows that a strip may have
    for array, in_strips in zip(whole, match(stack, [1, 2, 3], start, STEP, 5, RADIUS), strict=True):
        np.testing.assert_array_equal(in_strips, array)


def mask_disc(images, cameras):
    for image, camera in zip(images, cameras, strict=True):
        points = camera.paths(camera.pixel_centres(), TILTED).at_height(BEDS["wet"].true_height(camera), TILTED)
        image[np.hypot(points[..., 0], points[..., 1]) < 0.2] = np.nan


def mask_own_corner(images, cameras):
    images[0][:30, :40] = np.nan


@pytest.mark.parametrize("spoil", [mask_disc, mask_own_corner])
def test_masked_pixels_match_nothing_and_leave_the_others_alone(device, spoil):
    images = [BEDS["wet"].photograph(camera) for camera in ring(6)]
    spoil(images, ring(6))
    masked = np.isnan(images[0])
    truth, height, score, curvature = match_plane(device, BEDS["wet"], 0.0, spoil=spoil)
    assert masked.any()
    assert (score[masked] == -1.0).all()
    found = curvature > 0.0
    assert found.any()
    assert np.isfinite(height).all()
    assert is_close((height - truth)[found])


def test_an_image_without_texture_gives_scores_near_zero(device):
    def flatten(images, cameras):
        for image in images:
            image[:] = 30.0

    _, _, score, _ = match_plane(device, BEDS["wet"], 0.0, spoil=flatten)
    # Sums of squares of 30 in float32 against the floor of 1: a tenth of the figure of 97 in test_sweep_scoring.
    assert np.abs(score[score > -1.0]).max() < 1e-3


def test_an_image_smaller_than_the_window_matches_nothing(device):
    cameras = ring(2, size=(4, 3))
    _, height, score, curvature = match_plane(device, BEDS["wet"], 0.0, cameras=cameras)
    assert height.shape == (3, 4)
    assert (score == -1.0).all()
    assert (curvature == 0.0).all()
    assert np.isfinite(height).all()
