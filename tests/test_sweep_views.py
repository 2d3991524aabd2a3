"""Who sees what: coverage, choice of views and neighbours, parallax; and the block that holds them."""

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, look, ring
from scipy.sparse import csr_array

from fields.device import choose_device
from fields.sweep import views
from fields.sweep.block import Block
from refract import FlatWater

WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.34)


def flight(num: int = 6, *, spacing: float = 0.8, height: float = 10.0):
    """Nadir views in a line along x over the local origin."""
    return [look((spacing * i, 0.0, height), (spacing * i, 0.0, -2.0)) for i in range(num)]


def test_axes_meet_the_ground_where_they_point_and_never_if_they_look_up():
    cameras = [look((1.0, 2.0, 10.0), (4.0, 6.0, 0.0)), look((1.0, 2.0, 10.0), (4.0, 6.0, 20.0))]
    found = views.ground_points(cameras, 5.0)
    np.testing.assert_allclose(found[0], [2.5, 4.0, 5.0], atol=1e-12)
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize(("num", "spacing"), [(3, 0.8), (70, 0.3)])  # of the second not all are searched together
def test_coverage_says_of_each_cell_who_sees_it_through_the_water(num, spacing):
    cameras = flight(num, spacing=spacing)
    seen, cells = views.coverage(cameras, WATER, -2.0)
    assert seen.shape == (num, len(cells))
    np.testing.assert_array_equal(cells[:, 2], -2.0)
    seen = seen.toarray()
    for camera, mine in zip(cameras, seen, strict=True):
        pixel = camera.project(cells, WATER)
        inside = (pixel > 0.0).all(axis=1) & (pixel < (camera.width, camera.height)).all(axis=1)
        np.testing.assert_array_equal(mine, inside)
        assert 0 < mine.sum() < len(cells)
    # The grid spans all that is seen: no cell on its rim is.
    rim = (cells[:, :2] == cells[:, :2].min(axis=0)).any(axis=1) | (cells[:, :2] == cells[:, :2].max(axis=0)).any(
        axis=1
    )
    assert not seen[:, rim].any()


@pytest.mark.parametrize("water", [None, WATER, TILTED])
@pytest.mark.parametrize("change", [{}, {"tide": 0.2}, {"motion": np.array([1e-3, 0.0, 0.0])}])
def test_a_footprint_holds_where_the_border_of_its_photograph_meets_the_ground(water, change):
    cameras = [replace(camera, **change) for camera in ring(5)]
    heights = (-2.5, -1.0)
    for camera, found in zip(cameras, views.Footprint.of_each(cameras, water, heights), strict=True):
        along = np.linspace(0.0, 1.0, 17)
        border = np.array([(x, y) for x in along for y in along if {x, y} & {0.0, 1.0}])
        paths = camera.paths(border * (camera.width, camera.height), water)
        ends = np.concatenate([paths.at_height(np.full(len(border), h), water)[:, :2] for h in heights])
        low, high = ends.min(axis=0), ends.max(axis=0)
        # Wider by 2 % of the longer side, as the border is seen at some places alone.
        margin = 0.02 * (high - low).max()
        np.testing.assert_allclose(found.low, low - margin, atol=1e-9)
        np.testing.assert_allclose(found.high, high + margin, atol=1e-9)


def slow_greedy(seen, chosen, times):
    """The greedy choice with all gains counted anew in every round."""
    chosen, need = list(chosen), np.minimum(seen.sum(axis=0), times)
    have = seen[chosen].sum(axis=0)
    while True:
        gain = (seen & (have < need)).sum(axis=1)
        gain[chosen] = 0
        if gain.max() == 0:
            return chosen
        chosen.append(int(gain.argmax()))
        have = have + seen[chosen[-1]]


def test_gains_that_are_kept_up_to_date_choose_as_gains_counted_anew(rng):
    for _ in range(20):
        seen = rng.random((rng.integers(3, 40), 200)) < rng.uniform(0.02, 0.5)
        start, times = list(range(rng.integers(0, 3))), int(rng.integers(1, 7))
        assert views._greedy(csr_array(seen), start, times) == slow_greedy(seen, start, times)


def test_on_a_long_flight_a_view_still_sees_many_cells_and_its_neighbours():
    cameras = flight(60, spacing=0.5)
    seen, cells = views.coverage(cameras, WATER, -2.0)
    # Eight cells across its narrow side, and more along the other; fewer would make overlap a matter of chance.
    assert seen.sum(axis=1).min() >= 8 * 8
    assert set(views.neighbours(cameras, seen, cells, 30, list(range(60)), 2)) == {29, 31}


@pytest.mark.parametrize("times", [1, 2, 3, 100])
def test_cover_sees_every_cell_as_often_as_asked_or_as_it_can_be(times):
    cameras = [*flight(8), *ring(5)]
    seen, cells = views.coverage(cameras, WATER, -2.0)
    chosen = views.cover(seen, cells, cameras, times, 0)
    assert chosen == sorted(set(chosen))
    needed = np.minimum(seen.sum(axis=0), times)
    assert (seen[chosen].sum(axis=0) >= needed).all()
    if times == 100:
        assert chosen == list(range(len(cameras)))
    if times == 1:
        assert len(chosen) < len(cameras)


def test_cover_looks_at_each_place_from_the_four_quarters_too():
    around = [look((9.0 * x, 9.0 * y, 10.0), (0.0, 0.0, -2.0)) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    cameras = [*ring(6), *around, *around]
    seen, cells = csr_array(np.ones((len(cameras), 9), dtype=bool)), np.zeros((9, 3))
    assert len(views.cover(seen, cells, cameras, 2, 0)) == 2
    chosen = views.cover(seen, cells, cameras, 2, 1)
    # Two of the steep ones, and one of each pair of obliques, whose rays lie 46 deg off the vertical.
    assert [c for c in chosen if c >= 7] == [7, 8, 9, 10]
    assert len([c for c in chosen if c < 7]) == 2
    assert len(views.cover(seen, cells, cameras, 2, 5)) == 2 + 8


def test_neighbours_are_others_that_overlap_at_most_as_many_as_asked_the_best_angle_first():
    cameras = [*flight(4), look((50.0, 0.0, 10.0), (50.0, 0.0, -2.0)), *ring(6)]
    seen, cells = views.coverage(cameras, WATER, -2.0)
    everyone = list(range(len(cameras)))
    for view in everyone:
        found = views.neighbours(cameras, seen, cells, view, everyone, 5)
        assert view not in found
        assert len(found) == len(set(found)) <= 5
        assert all((seen[o] * seen[view]).sum() >= 0.05 * seen[view].sum() for o in found)
    assert views.neighbours(cameras, seen, cells, 4, everyone, 5) == []
    found = views.neighbours(cameras, seen, cells, 0, everyone, 1)
    # A ring of 3 m radius, 12 m over the bed, is seen 14 deg from the middle; the next of the line stands 4 deg off.
    assert found[0] >= 5
    assert views.neighbours(cameras, seen, cells, 0, [0, 1, 3, 4], 8) == [1]


def test_each_part_of_a_view_has_neighbours_where_any_view_sees_it():
    cameras = ring(11)
    # All but two see nine tenths of the first view, these two little more than the last tenth.
    seen = np.ones((12, 40), dtype=bool)
    seen[1:10, 36:] = False
    seen[10:, :30] = False
    cells = np.column_stack([np.linspace(-2.0, 2.0, 40), np.zeros(40), np.full(40, -2.0)])
    found = views.neighbours(cameras, csr_array(seen), cells, 0, list(range(12)), 8)
    assert {10, 11} & set(found)
    assert len(found) == 8


def test_views_from_the_same_place_are_no_neighbours():
    # A burst shows no parallax, and matches at every height.
    cameras = [camera for camera in ring(4) for _ in range(3)]
    seen, cells = views.coverage(cameras, WATER, -2.0)
    assert set(views.neighbours(cameras, seen, cells, 0, list(range(15)), 20)) == set(range(3, 15))


def test_neighbours_stand_around_the_view():
    cameras = ring(8)
    seen, cells = views.coverage(cameras, WATER, -2.0)
    found = views.neighbours(cameras, seen, cells, 0, list(range(9)), 4)
    azimuths = np.sort([np.arctan2(*cameras[o].centre[1::-1]) for o in found])
    gaps = np.diff([*azimuths, azimuths[0] + 2.0 * np.pi])
    assert gaps.max() < np.radians(140.0)


def _parallax(cameras, water, others, height):
    return views.parallax(cameras, water, views.middle_path(cameras[0], water), others, height)


@pytest.mark.parametrize("water", [None, WATER, TILTED])
@pytest.mark.parametrize("tide", [0.0, 0.2])
def test_parallax_is_that_of_the_pixels_in_each_camera(water, tide):
    cameras = [replace(camera, tide=tide) for camera in ring(5)]
    camera, others = cameras[0], [1, 2, 3, 4]
    middle = np.full((2, 2), (camera.width / 2, camera.height / 2))
    ends = camera.paths(middle, water).at_height(np.array([-2.05, -1.95]), water)
    moves = [np.linalg.norm(np.diff(cameras[other].project(ends, water), axis=0)) / 0.1 for other in others]
    # Points are searched together or camera by camera: the same but for rounding of pixels over 0.1 m.
    expected = np.quantile(moves, 0.75)
    np.testing.assert_allclose(_parallax(cameras, water, others, -2.0), expected, rtol=1e-9)


def test_parallax_is_never_zero():
    assert _parallax([flight(1)[0]] * 2, WATER, [1], -2.0) == 1e-3


def test_a_block_needs_two_views_with_images():
    bed, device = PlaneBed(WATER, -2.0), choose_device("torch")
    with pytest.raises(ValueError, match=r"needs two views or more.* got 1 and 1"):
        bed.block(device, flight(1))
    with pytest.raises(ValueError, match="got 2 and 1"):
        Block(device, flight(2), [bed.photograph(flight(1)[0])], WATER, -2.0)


def test_a_block_that_sees_no_ground_is_refused():
    up = [look((0.1 * i, 0.0, 10.0), (0.0, 20.0, 30.0)) for i in range(3)]
    with pytest.raises(ValueError, match="no photograph looks down"):
        Block(choose_device("torch"), up, [np.zeros((72, 96), np.float32)] * 3, None, 0.0)


def test_a_block_covers_only_the_area_asked_for():
    block = PlaneBed(WATER, -2.0).block(choose_device("torch"), flight(6, spacing=1.2))
    assert block.cover(1, 0, (-0.3, -0.3, 0.3, 0.3)) == [0]
    assert block.cover(1, 0, (900.0, 0.0, 901.0, 1.0)) == block.cover(1, 0)  # seen by none: no reason to leave all out
    assert len(block.cover(1, 0)) >= 4


def test_a_block_scales_images_with_their_cameras_and_forgets_them():
    bed = PlaneBed(TILTED, -2.0)
    block = bed.block(choose_device("torch"), ring(2))
    half = block.stack(0.5)
    assert (half.width, half.height) == (48, 36)
    assert block.stack(0.5) is half
    # The mean of 2 x 2 pixels at the half-size centre: the waves of 8 px and more lose little.
    error = half.images[1] - bed.photograph(half.cameras[1])
    assert np.abs(error).mean() < 0.1 * bed.photograph(half.cameras[1]).std()
    block.release(0.5)
    assert block.stack(0.5) is not half


def test_overlap_is_judged_under_the_cameras_however_far_off_the_water_has_its_point():
    """A sloped plane given by a point 2 km away lies 40 m under that point here."""
    device = choose_device("torch")
    near = FlatWater((0.0, 0.0, 0.0), n_water=1.34, slope_x=0.02)
    far = FlatWater((2000.0, 0.0, 40.0), n_water=1.34, slope_x=0.02)
    cameras = ring(3)
    images = [np.zeros((c.height, c.width), dtype=np.float32) for c in cameras]
    blocks = [Block(device, cameras, images, water, -2.0) for water in (near, far)]
    np.testing.assert_allclose(blocks[0].cells, blocks[1].cells, atol=1e-9)
    np.testing.assert_array_equal(blocks[0].seen.toarray(), blocks[1].seen.toarray())


def oblique(num: int = 3):
    """Views 55 degrees from the vertical, whose footprints reach further than those of steep ones as wide."""
    return [look((0.8 * i, 0.0, 10.0), (0.8 * i, 17.0, -2.0)) for i in range(num)]


@pytest.mark.parametrize("near", [flight(3), oblique()], ids=["steep", "oblique"])
def test_cells_of_photographs_far_apart_lie_about_each(near, monkeypatch):
    far = [replace(camera, centre=np.add(camera.centre, (80.0, 3.0, 0.0))) for camera in near]
    ground = (-10.0, -5.0, 100.0, 30.0)
    seen, cells = views.coverage([*near, *far], WATER, -2.0, ground)
    assert len(cells) < 20_000
    assert not seen[:3, cells[:, 0] > 40.0].sum()
    # The same cells are seen as in the whole grid.
    monkeypatch.setattr(views, "MOST_CELLS", 10**6)
    whole, all_cells = views.coverage([*near, *far], WATER, -2.0, ground)
    assert len(all_cells) > 5 * len(cells)
    np.testing.assert_array_equal(seen.sum(axis=1), whole.sum(axis=1))


def test_cells_of_photographs_far_apart_are_as_many_as_where_each_lies_alone(monkeypatch):
    near = flight(3)
    far = [replace(camera, centre=np.add(camera.centre, (5000.0, 40.0, 0.0))) for camera in near]
    seen, cells = views.coverage([*near, *far], WATER, -2.0)
    assert len(cells) < 2000
    # Cells as large: a small grid has more.
    monkeypatch.setattr(views, "GRID_CELLS", 1)
    alone, _ = views.coverage(near, WATER, -2.0)
    for own in (seen[:3, cells[:, 0] < 100.0], seen[3:, cells[:, 0] > 100.0]):
        # But for where the nodes lie.
        assert own.sum() == pytest.approx(alone.sum(), rel=0.2)
        assert (own.sum(axis=0) >= 2).any()


def test_a_view_far_higher_than_the_others_has_no_more_than_so_many_cells():
    high = look((2000.0, 0.0, 2000.0), (2000.0, 0.0, -2.0))
    _, cells = views.coverage([*flight(3), high], WATER, -2.0)
    assert len(cells) < 1.1 * views.MOST_CELLS**2
