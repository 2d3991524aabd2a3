"""The bound of the bed from thumbnails."""

from __future__ import annotations

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, ring

from fields.sweep.block import Block
from fields.sweep.sweep import find_range, without_chance_matches
from refract import FlatWater

LIMITS = (-4.0, 0.0)
# Wide views, as those of surveys are: nearly all of an image is seen by others at every height tried.
WIDE = {"focal": 400.0, "size": (96, 72)}


@pytest.mark.parametrize(
    "bed",
    [PlaneBed(TILTED, -2.0, slope=0.2), PlaneBed(FlatWater((0.0, 0.0, -1.8), n_water=1.34), -2.0, 0.6)],
    ids=["wet", "shore"],
)
def test_the_range_contains_the_bed_and_not_much_more(device, bed):
    cameras = ring(4, **WIDE)
    truth = np.concatenate([bed.true_height(camera).ravel() for camera in cameras])
    limits = tuple(truth.mean() + np.array([-2.0, 2.0]))
    low, high = find_range(bed.block(device, cameras), limits)
    # The range is that of 99 % of the matched pixels, widened; the rim of an image is seen by few others.
    assert limits[0] <= low < np.quantile(truth, 0.01)
    assert np.quantile(truth, 0.99) < high <= limits[1]
    # A quarter more on each side, a step of 0.5 px (8 cm), and what false matches on the rim add: at worst it is 2.9 m.
    assert high - low < 0.8 * (limits[1] - limits[0])


def test_the_range_stays_within_the_limits(device):
    bed = PlaneBed(None, -2.0, slope=0.4)
    assert find_range(bed.block(device, ring(4)), (-2.1, -1.9)) == pytest.approx((-2.1, -1.9), abs=0.06)


def test_images_that_do_not_belong_together_have_no_range(device, rng):
    cameras = ring(3, **WIDE)
    noise = [rng.normal(0.0, 40.0, (c.height, c.width)).astype(np.float32) for c in cameras]
    with pytest.raises(
        ValueError, match=r"only \d+ thumbnail pixels match .* from -4.0 to 0.0 m over the water; check"
    ):
        find_range(Block(device, cameras, noise, TILTED, -2.0), LIMITS)


@pytest.mark.parametrize("ground", [None, (90.0, 90.0, 95.0, 95.0)], ids=["no texture", "ground that no view shows"])
def test_where_nothing_can_match_there_is_no_range(device, ground):
    cameras = ring(2, **WIDE)
    grey = [np.full((c.height, c.width), 12.0, np.float32) for c in cameras]
    with pytest.raises(ValueError, match="only 0 thumbnail pixels match"):
        find_range(Block(device, cameras, grey, None, -2.0, ground=ground), LIMITS)


def test_matches_by_chance_do_not_widen_the_range(rng):
    limits = (-25.0, 14.0)
    bed, chance = rng.normal(-3.0, 0.4, 1500), rng.uniform(*limits, 60)
    found = without_chance_matches(np.concatenate([bed, chance]), limits)
    assert np.quantile(found, 0.005) > -6.0
    assert np.quantile(found, 0.995) < 0.0
    assert np.isin(found, bed).sum() > 0.99 * len(bed)


def test_a_bed_at_all_heights_and_a_few_of_a_mast_are_no_chance(rng):
    limits = (-10.0, 2.0)
    slope = rng.uniform(*limits, 5000)
    assert len(without_chance_matches(slope, limits)) == len(slope)
    mast = np.concatenate([rng.normal(-4.0, 0.3, 5000), np.linspace(-4.0, 0.0, 60)])
    assert len(without_chance_matches(mast, limits)) == len(mast)


@pytest.mark.parametrize("half", [0.05, 0.2, 0.6])
def test_any_narrow_range_about_the_bed_is_taken(device, half):
    """Of a pair far above, thumbnails resolve a few heights in it, or none; it is narrow already."""
    bed = PlaneBed(None, -2.0, slope=0.02)
    limits = (-2.0 - half, -2.0 + half)
    low, high = find_range(bed.block(device, ring(2, **WIDE)), limits)
    assert limits[0] <= low < -1.95
    assert -2.05 < high <= limits[1]
