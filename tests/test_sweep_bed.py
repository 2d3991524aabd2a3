"""From height maps to points: every piece of the bed once, only what is trusted, back on the pixel it came from."""

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import SIZE, TILTED, PlaneBed, ring

from fields.sweep.bed import BedPoints, has_neighbours, points_of, std_of_kept, unique_pixels, with_slope_std
from fields.sweep.block import Block
from fields.sweep.maps import HeightMap, trusted
from refract import FlatWater

HEIGHT, GSD = -2.0, 0.05


def level_map(view: int, height: float = HEIGHT, agreeing: int = 3) -> HeightMap:
    """A map of one height over the water plane, confirmed by `agreeing` views."""
    shape = SIZE[::-1]
    full = [np.full(shape, value, np.float32) for value in (height, 0.9, 0.01)]
    return HeightMap(view, *full[:2], np.full(shape, agreeing, np.uint8), full[2])


def seen_from(block: Block, m: HeightMap, other: int) -> np.ndarray:
    """Pixels (height, width, 2) of another view at which the points of a map appear, in float64."""
    camera = block.cameras[m.view]
    points = camera.paths(camera.pixel_centres(), block.water).at_height(m.height.astype(np.float64), block.water)
    return block.cameras[other].project(points, block.water)


def slow_unique(block: Block, maps: list[HeightMap]) -> list[np.ndarray]:
    """`unique_pixels` pixel by pixel in float64, for maps of one height each."""
    steepness = [block.cameras[m.view].cam_from_local[2][2] for m in maps]
    claimed, kept = [np.zeros(m.height.shape, bool) for m in maps], {}
    order = [int(i) for i in np.argsort(steepness)]
    for place, index in enumerate(order):
        m = maps[index]
        kept[index] = trusted(m) & ~claimed[index]
        tolerance = block.agreement_tolerance(m.view, [o.view for o in maps if o is not m], float(m.height[0, 0]))
        for later in order[place + 1 :]:
            if abs(maps[later].height[0, 0] - m.height[0, 0]) >= tolerance:
                continue
            uv = seen_from(block, m, maps[later].view)[kept[index]]
            rows, columns = m.height.shape
            inside = (uv >= 0.5).all(axis=1) & (uv[:, 0] < columns - 0.5) & (uv[:, 1] < rows - 0.5)
            for u, v in uv[inside]:
                claimed[later][int(v - 0.5) : int(v - 0.5) + 2, int(u - 0.5) : int(u - 0.5) + 2] = True
    return [kept[i] for i in range(len(maps))]


def test_one_confirmation_needs_a_good_match_two_do_not():
    m = level_map(0)
    cases = [(0, 1.0, False), (1, 0.75, False), (1, 0.85, True), (2, -0.5, True), (3, 0.1, True)]
    m.agreeing[0, :5], m.score[0, :5] = [c[0] for c in cases], [c[1] for c in cases]
    np.testing.assert_array_equal(trusted(m)[0, :5], [c[2] for c in cases])


def test_each_piece_of_the_bed_is_taken_once_as_a_slow_twin_takes_it(device):
    block = PlaneBed(TILTED, -2.0).block(device, ring(3))
    maps = [level_map(view) for view in (2, 0, 3)]
    maps[1].agreeing[:30, :50] = 0
    found, slow = unique_pixels(block, maps, GSD), slow_unique(block, maps)
    for keep, expected in zip(found, slow, strict=True):
        # A path within 1e-4 px of a pixel's border may round to either side of it.
        assert (keep != expected).mean() < 1e-3
    assert sum(k.sum() for k in found) < 0.7 * sum(k.size for k in found)
    steepest = min(range(3), key=lambda i: block.cameras[maps[i].view].cam_from_local[2][2])
    np.testing.assert_array_equal(found[steepest], trusted(maps[steepest]))


def test_a_bed_at_another_height_is_another_piece_of_it(device):
    block = PlaneBed(TILTED, -2.0).block(device, ring(3))
    tolerance = block.agreement_tolerance(0, [1], HEIGHT)
    for offset, all_kept in ((0.5 * tolerance, False), (2.0 * tolerance, True)):
        maps = [level_map(0), level_map(1, HEIGHT + offset)]
        assert all(keep.all() for keep in unique_pixels(block, maps, GSD)) == all_kept


@pytest.fixture
def half_kept(rng):
    """A camera, a map with random heights about the surface, a mask and colours."""
    camera = ring(1)[1]
    m = level_map(1)
    m.height[:] = rng.uniform(-3.0, 1.0, m.height.shape)
    m.agreeing[:] = rng.integers(1, 9, m.height.shape)
    keep = rng.uniform(size=m.height.shape) < 0.5
    return camera, m, keep, rng.integers(0, 255, (*m.height.shape, 3), dtype=np.uint8)


def test_points_appear_at_the_pixels_they_were_taken_from(half_kept):
    camera, m, keep, rgb = half_kept
    points = points_of(camera, TILTED, m, keep, rgb, std_of_kept(m, keep, 0.1))
    assert len(points) == keep.sum()
    assert points.xyz.dtype == np.float64
    np.testing.assert_allclose(camera.project(points.xyz, TILTED), camera.pixel_centres()[keep], atol=1e-7)
    np.testing.assert_allclose(-TILTED.depth(points.xyz), m.height[keep], atol=1e-9)
    np.testing.assert_array_equal(points.wet, m.height[keep] < 0.0)
    np.testing.assert_array_equal(points.rgb, rgb[keep])
    np.testing.assert_array_equal(points.num_views, m.agreeing[keep] + 1)
    surface = TILTED.height(points.xyz[:, 0], points.xyz[:, 1])
    np.testing.assert_allclose(points.depth, surface - points.xyz[:, 2], atol=1e-6)
    rays = camera.directions(camera.pixel_centres()[keep])
    np.testing.assert_allclose(np.cos(points.incidence), -(rays @ TILTED.up), atol=1e-6)


def test_a_dry_survey_has_no_depth_and_counts_heights_from_local_zero(half_kept):
    camera, m, keep, rgb = half_kept
    points = points_of(camera, None, m, keep, rgb, std_of_kept(m, keep, 0.1))
    assert np.isnan(points.depth).all()
    assert not points.wet.any()
    np.testing.assert_allclose(points.xyz[:, 2], m.height[keep], atol=1e-12)


def test_a_padded_map_gives_the_points_of_the_image_in_it(half_kept):
    camera, m, keep, rgb = half_kept
    padded = HeightMap(1, *(np.pad(a, ((0, 8), (0, 16))) for a in (m.height, m.score, m.agreeing, m.spread)))
    found, expected = (points_of(camera, TILTED, of, keep, rgb, std_of_kept(of, keep, 0.1)) for of in (padded, m))
    np.testing.assert_array_equal(found.xyz, expected.xyz)
    np.testing.assert_array_equal(found.std, expected.std)


def test_points_have_the_std_of_the_solver_where_it_has_one(half_kept):
    camera, m, keep, rgb = half_kept
    of_map = std_of_kept(m, keep, 0.1)[keep]
    solved = np.full(m.height.shape, 0.25, dtype=np.float32)
    np.testing.assert_array_equal(std_of_kept(m, keep, 0.1, solved)[keep], 0.25)
    solved[:, ::2] = np.nan
    found = points_of(camera, TILTED, m, keep, rgb, std_of_kept(m, keep, 0.1, solved)).std
    np.testing.assert_array_equal(found, np.where(np.isnan(solved)[keep], of_map, 0.25))


def test_points_of_several_views_join_and_can_be_chosen_from(half_kept):
    camera, m, keep, rgb = half_kept
    one = points_of(camera, FlatWater((0.0, 0.0, 0.0), n_water=1.0), m, keep, rgb, std_of_kept(m, keep, 0.1))
    both = BedPoints.concatenate([one, one[one.wet]])
    assert len(both) == len(one) + one.wet.sum()
    np.testing.assert_array_equal(both[len(one) :].xyz, one.xyz[one.wet])
    assert both.rgb.dtype == np.uint8


def test_points_of_a_surface_have_company_and_chance_agreements_have_not(rng):
    gsd = 0.03
    x, y = np.meshgrid(np.arange(30) * gsd, np.arange(20) * gsd)
    surface = np.stack([x.ravel(), y.ravel(), 0.3 * x.ravel() - 2.0], axis=-1)
    stray = np.stack([*rng.uniform(0.0, 0.6, (2, 12)), np.linspace(1.0, 9.0, 12)], axis=-1)
    found = has_neighbours(np.concatenate([surface, stray]), gsd)
    assert found[: len(surface)].all()
    assert not found[len(surface) :].any()
    assert not has_neighbours(surface[:3], gsd).any()
    assert has_neighbours(surface[:0], gsd).shape == (0,)


@pytest.mark.parametrize(("rise", "apart", "stays"), [(0.5, 0.2, False), (1.2, 0.2, True), (1.2, 2.0, False)])
def test_on_a_wall_pixels_that_lie_far_apart_stay(device, rise, apart, stays):
    cameras = ring(3)
    # Half a pixel beside the first: its pixels show what lies between those of the first.
    beside = replace(cameras[0], cx=cameras[0].cx + 0.5)
    block = PlaneBed(TILTED, -2.0).block(device, [cameras[0], beside, *cameras[1:]])
    tolerance, middle = block.agreement_tolerance(0, [1], HEIGHT), SIZE[0] // 2
    maps = [level_map(0), level_map(1)]
    for m, shift in zip(maps, (0.0, 0.5), strict=True):
        m.height[:] += (rise * tolerance * np.clip(np.arange(SIZE[0]) - shift - middle, -3.0, 3.0)).astype(np.float32)
    _, second = unique_pixels(block, maps, apart * tolerance)
    np.testing.assert_array_equal(second[5:-5, middle], stays)


def placed(std, incidence: float) -> BedPoints:
    """Points with a std [m] each, seen at an incidence [rad]."""
    std = np.asarray(std, np.float32)
    nothing = np.zeros(len(std), np.float32)
    xyz, rgb, few = np.zeros((len(std), 3)), np.zeros((len(std), 3), np.uint8), nothing.astype(np.uint8)
    return BedPoints(xyz, rgb, std, few, nothing, nothing + np.float32(incidence), nothing == 0.0)


@pytest.mark.parametrize("n", [1.0, 1.34])
def test_beside_an_edge_std_is_that_of_a_point_that_moves_along_its_ray_and_on_level_ground_as_it_was(n):
    incidence, std = np.radians(30.0), 0.02
    height = np.full((20, 30), HEIGHT, np.float32)
    height[:, 15:] += 1.0
    keep = np.zeros(height.shape, bool)
    keep[10, [3, 12, 13, 16, 17]] = True
    water = FlatWater((0.0, 0.0, 0.0), n_water=n)
    pixels_off = np.tan(np.arcsin(np.sin(incidence) / n)) * std / GSD
    there = np.hypot(std, pixels_off * np.sqrt(0.5**2 - std**2))
    found = with_slope_std(placed([std] * 5, incidence), height, keep, GSD, water).std
    np.testing.assert_allclose(found, [std, std, there, there, std], rtol=1e-5)


def test_heights_that_differ_by_their_noise_alone_say_nothing_of_slopes(rng):
    height = rng.uniform(HEIGHT - 0.019, HEIGHT + 0.019, (40, 50)).astype(np.float32)
    points = placed([0.02] * height.size, 0.6)
    found = with_slope_std(points, height, np.ones(height.shape, bool), GSD, None).std
    np.testing.assert_array_equal(found, points.std)


def test_slopes_add_no_more_to_std_than_the_range_of_the_heights_there():
    """Heights that are known to 0.3 m only, on a flat ray beside a step of 1 m, and to more than half of the step."""
    height = np.full((9, 9), HEIGHT, np.float32)
    height[:, 4:] += 1.0
    keep = np.zeros(height.shape, bool)
    keep[4, 3:5] = True
    expected = [np.sqrt(0.3**2 + 4.0 * (0.5**2 - 0.3**2)), 0.7]
    np.testing.assert_allclose(
        with_slope_std(placed([0.3, 0.7], 1.2), height, keep, GSD, None).std, expected, rtol=1e-5
    )


def test_heights_that_one_other_view_confirms_need_the_surface_around_them(rng):
    from fields.sweep.bed import is_supported

    height = np.full((60, 80), -2.0, np.float32)
    confirmed = np.ones(height.shape, dtype=bool)
    # Chance matches: sparse, and at any height.
    confirmed[:, 40:] = rng.random((60, 40)) < 0.2
    height[:, 40:] = rng.uniform(-8.0, 4.0, (60, 40))
    # And a wrong one within the surface.
    height[30, 20] = 1.0
    found = is_supported(height, confirmed, 0.1)
    assert found[2:58, 2:30].sum() == 56 * 28 - 1
    assert not found[30, 20]
    assert not found[:, 50:].any()
