"""The sweep over drawn surveys, and the range of heights from thumbnails."""

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from plane_survey import FOCAL, SIZE, TILTED, PlaneBed, look, ring
from slow_cases import slow

from fields.device import choose_device
from fields.sweep.bed import unique_pixels
from fields.sweep.block import Block
from fields.sweep.maps import HeightMap, trusted
from fields.sweep.matching import PASSES, Pass
from fields.sweep.sweep import find_range, sweep, without_chance_matches
from fields.sweep.view_pass import SweepSettings
from refract import FlatWater
from refract.distortion import BROWN, Distortion
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.sidecars import StagedScene

# Coarse to fine in small: images of 96 x 72 px have too few pixels left at a quarter, where PASSES begin.
SMALL = (Pass(0.5, 2, None, 0.5, 6, False), Pass(1.0, 2, 7, 0.4, 6, True), Pass(1.0, 1, 3, 0.25, 8, True))
BEDS = {
    "wet": PlaneBed(TILTED, -2.0, slope=0.1),
    "dry": PlaneBed(None, -2.0, slope=0.1),
    "shore": PlaneBed(FlatWater((0.0, 0.0, -2.0), n_water=1.34, slope_x=0.01, slope_y=0.02), -2.0, slope=0.3),
}
# The corners of the image are 0.075 from the axis: strong terms move them by 3 px.
LENSES = {
    "barrel": Distortion(BROWN, (-10.0, 0.0, 0.0, 0.0, 0.0)),
    "decentred pincushion": Distortion(BROWN, (9.0, 50.0, 0.05, -0.08, 0.0)),
}
# Errors of the trusted heights of one view [m]; a pixel is 1.5 cm. Measured at worst: half of them 0.66 mm, 90 %
# 4.0 mm, median 0.06 mm, mean 0.24 mm.
HALF_M, MOST_M, MEDIAN_M, MEAN_M = 1e-3, 6e-3, 1.2e-4, 5e-4


@pytest.fixture(
    scope="module",
    params=["cpu", pytest.param("torch", marks=pytest.mark.slow), pytest.param("cuda", marks=pytest.mark.gpu)],
)
def device(request):
    """Torch takes twice as long; the default run has it on a drawn survey."""
    chosen = choose_device(request.param)
    if request.param == "cpu" and chosen.name != "llvm":
        pytest.skip(f"Dr.Jit does not run on this CPU: {chosen.reason}")
    return chosen


def ignore(share: float) -> None:
    """Progress that nobody looks at."""


def sweep_plane(device, bed: PlaneBed, *, cameras=None, images=None, chosen=None) -> tuple[Block, list[HeightMap]]:
    """The block of a plane and its maps, of all views or the chosen ones."""
    cameras = cameras or ring(6)
    block, truth = bed.block(device, cameras, images), bed.true_height(cameras[0])
    chosen = list(range(len(cameras))) if chosen is None else chosen
    return block, sweep(block, chosen, SweepSettings((truth.min() - 0.3, truth.max() + 0.4), SMALL), ignore)


def errors(block: Block, bed: PlaneBed, maps: list[HeightMap]) -> list[np.ndarray]:
    """Errors [m] of the trusted heights of each map."""
    return [(m.height - bed.true_height(block.cameras[m.view]))[trusted(m)] for m in maps]


@pytest.fixture(scope="module")
def wet(device) -> tuple[Block, list[HeightMap]]:
    """The block and maps of the wet plane."""
    return sweep_plane(device, BEDS["wet"])


def require_plane(block: Block, bed: PlaneBed, maps: list[HeightMap], share: float) -> None:
    """That a share of each map at least is trusted and errs as little as said above."""
    for m, error in zip(maps, errors(block, bed, maps), strict=True):
        assert trusted(m).mean() > share
        half, most = np.quantile(np.abs(error), [0.5, 0.9])
        assert half < HALF_M
        assert most < MOST_M
        assert abs(np.median(error)) < MEDIAN_M
        assert abs(error.mean()) < MEAN_M


@pytest.mark.parametrize("name", BEDS)
def test_a_sweep_finds_a_plane_in_all_views(device, wet, name):
    block, maps = wet if name == "wet" else sweep_plane(device, BEDS[name])
    assert [m.view for m in maps] == list(range(7))
    require_plane(block, BEDS[name], maps, 0.75)


@pytest.mark.parametrize("name", [slow("barrel"), "decentred pincushion"])
def test_a_sweep_finds_a_plane_through_a_lens_that_distorts(device, name):
    cameras = [replace(camera, distortion=LENSES[name]) for camera in ring(6)]
    moved = cameras[0].directions(cameras[0].pixel_centres()) - ring(6)[0].directions(cameras[0].pixel_centres())
    assert FOCAL * np.abs(moved).max() > 2.0  # px
    block, maps = sweep_plane(device, BEDS["wet"], cameras=cameras)
    require_plane(block, BEDS["wet"], maps, 0.7)


def test_the_spread_says_how_far_heights_err(wet):
    block, maps = wet
    error = np.abs(np.concatenate(errors(block, BEDS["wet"], maps)))
    spread = np.concatenate([m.spread[trusted(m)] for m in maps])
    wide = spread > np.quantile(spread, 0.9)
    assert np.median(error[wide]) > 3.0 * np.median(error[~wide])
    assert all((m.spread[m.agreeing == 0] == 0.0).all() for m in maps)


def test_straight_rays_in_water_put_the_bed_too_high(device):
    bed = PlaneBed(FlatWater((0.0, 0.0, 0.0), n_water=1.34), -2.0)
    images = [bed.photograph(camera) for camera in ring(6)]
    dry = Block(device, ring(6), images, None, -1.5)
    maps = sweep(dry, list(range(7)), SweepSettings((-2.3, -1.0), SMALL), ignore)
    height = np.median(np.concatenate([m.height[trusted(m)] for m in maps]))
    # At 14 deg of incidence, with cameras all around: between the tangential and the sagittal apparent depth.
    angle = np.arctan2(3.0, 10.0 + 2.0 / 1.34)
    root = np.sqrt(1.34**2 - np.sin(angle) ** 2)
    assert -2.0 * np.cos(angle) / root < height < -2.0 * 1.34**2 * np.cos(angle) ** 3 / root**3


def test_what_is_masked_in_all_views_is_found_in_none(device):
    bed, cameras = BEDS["wet"], ring(6)
    images, masks = [], []
    for camera in cameras:
        points = camera.paths(camera.pixel_centres(), bed.water).at_height(bed.true_height(camera), bed.water)
        masks.append(np.hypot(points[..., 0], points[..., 1]) < 0.25)
        images.append(np.where(masks[-1], np.float32(np.nan), bed.photograph(camera)))
    block, maps = sweep_plane(device, bed, images=images)
    for m, masked, error in zip(maps, masks, errors(block, bed, maps), strict=True):
        assert masked.sum() > 500
        assert not trusted(m)[masked].any()
        assert np.isfinite(m.height).all()
        assert trusted(m).mean() > 0.55
        assert np.quantile(np.abs(error), 0.9) < 2 * MOST_M  # more of the pixels lie at a rim


def test_a_view_that_overlaps_with_no_other_is_left_out(device):
    bed, cameras = BEDS["dry"], [*ring(3), look((60.0, 0.0, 10.0), (60.0, 0.0, -2.0))]
    _, maps = sweep_plane(device, bed, cameras=cameras)
    assert [m.view for m in maps] == [0, 1, 2, 3]


def test_only_the_first_pass_goes_without_its_own_number_of_hypotheses(device):
    with pytest.raises(ValueError, match="a pass after the first expects its own number of hypotheses"):
        sweep(BEDS["dry"].block(device, ring(4)), [0, 1], SweepSettings((-2.2, -1.8), (SMALL[0], SMALL[0])), ignore)


def test_progress_rises_to_one_and_counts_the_first_pass_by_its_hypotheses(device):
    shares = []
    maps = sweep(BEDS["dry"].block(device, ring(4)), [3, 0, 2], SweepSettings((-4.5, -0.5), SMALL[:2]), shares.append)
    assert [m.view for m in maps] == [3, 0, 2]
    assert all(m.height.shape == SIZE[::-1] and m.height.dtype == np.float32 for m in maps)
    # Three views in each of two passes, and their comparison.
    assert len(shares) == 7
    assert (np.diff([0.0, *shares]) > 0.0).all()
    assert shares[-1] == 1.0
    # The hypotheses of a wide bound are the longest part of the work.
    assert shares[0] > 2.0 * (shares[3] - shares[2])


@pytest.fixture(scope="module")
def drawn() -> StagedScene:
    """A drawn survey of 8 views of 160 x 120 px, with stones and objects."""
    return stage_drawing(DrawnScene.tiny())


@pytest.fixture(scope="module")
def greys(drawn) -> list[np.ndarray]:
    pictures = (drawn.photograph(i) for i in range(len(drawn.cameras)))
    return [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY).astype(np.float32) - 128.0 for p in pictures]


def test_torch_finds_what_dr_jit_finds_on_a_drawn_survey(drawn, greys):
    if choose_device("cpu").name != "llvm":
        pytest.skip(f"Dr.Jit does not run on this CPU: {choose_device('cpu').reason}")
    results = []
    for name in ("cpu", "torch"):
        block = Block(choose_device(name), list(drawn.cameras), greys, drawn.water, -1.2)
        maps = sweep(block, [0, 2, 4, 5, 7], SweepSettings((-1.6, -0.6)), ignore)
        results.append((maps, unique_pixels(block, maps, 0.029)))
    (ours, kept), (twins, twin_kept) = results
    for m, twin in zip(ours, twins, strict=True):
        sure = trusted(m)
        assert sure.mean() > 0.6
        assert (trusted(twin) != sure).mean() < 1e-3
        step = PASSES[-1].spacing_px / block.parallax(m.view, block.neighbours(m.view, 12), -1.2)
        # Rounding moves places by 1e-4 px; few stand where two hypotheses score alike. Measured: 99 % within 6.1e-4,
        # and 4.9e-4 to 6.0e-4 where grey levels and hypotheses are rounded otherwise, at random: 2.5 times that.
        difference = np.abs(twin.height - m.height)[sure] / step
        assert np.quantile(difference, 0.99) < 1.5e-3
        for field in fields(HeightMap)[2:]:
            a, b = getattr(m, field.name)[sure], getattr(twin, field.name)[sure]
            assert np.isclose(a, b, rtol=1e-2, atol=1e-4).mean() > 0.99, field.name
    assert sum(k.sum() for k in kept) > 15_000
    differing = sum((a != b).sum() for a, b in zip(kept, twin_kept, strict=True))
    assert differing < 1e-3 * sum(k.sum() for k in kept)


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
