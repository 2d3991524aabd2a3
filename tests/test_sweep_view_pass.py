"""Views in a pass: columns that see an area, and edges at which all heights are tried."""

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, look, match, ring, texture

from fields.sweep import matching
from fields.sweep.kernels.arrays import run_job
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.matching import DiscontinuitySearch, Reference
from fields.sweep.tiles import CornerRays, side_of_squares
from fields.sweep.view_pass import columns_over_area, columns_seeing_area, search_discontinuities
from refract import FlatWater

AREA, BOUND = (-0.35, -0.25, 0.2, 0.3), (-2.3, -1.9)
BED = PlaneBed(TILTED, -2.0)


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_columns_hold_every_pixel_that_sees_the_area_within_the_bound_and_not_all_others(water):
    for camera in ring(6):
        columns = columns_seeing_area(camera, water, AREA, BOUND, 1)
        path, across = camera.paths(camera.pixel_centres(), water), np.arange(camera.width)
        sees = np.zeros((camera.height, camera.width), dtype=bool)
        for height in np.linspace(*BOUND, 9):
            x, y, _ = np.moveaxis(path.at_height(height, water), -1, 0)
            sees |= (x > AREA[0]) & (x < AREA[2]) & (y > AREA[1]) & (y < AREA[3])
        inside = (across >= columns[:, :1]) & (across < columns[:, 1:])
        assert sees.any()
        assert inside[sees].all()
        assert inside.mean() < sees.mean() + 0.5


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_columns_by_heights_hold_the_pixels_over_the_area_and_fewer_than_those_of_the_bound(water):
    for camera in ring(6):
        coarse, across = camera.scaled(0.5), np.arange(camera.width)
        # Half of a step of 0.4 m: both heights count beside it.
        before = np.where(np.arange(coarse.width) < coarse.width // 2, *BOUND) + np.zeros((coarse.height, 1))
        rays_of = partial(CornerRays.of, camera, water)
        columns = columns_over_area(camera, (camera.height, camera.width), AREA, before.astype(np.float32), rays_of)
        path = camera.paths(camera.pixel_centres(), water)
        x, y, _ = np.moveaxis(path.at_height(np.where(across < camera.width // 2, *BOUND), water), -1, 0)
        over = (x > AREA[0]) & (x < AREA[2]) & (y > AREA[1]) & (y < AREA[3])
        inside = (across >= columns[:, :1]) & (across < columns[:, 1:])
        bound = columns_seeing_area(camera, water, AREA, BOUND, 1)
        assert inside[over].all()
        assert over.any()
        assert over.mean() < inside.mean() < (bound[:, 1] - bound[:, 0]).sum() / inside.size


def test_an_area_beside_the_image_needs_no_pixel():
    columns = columns_seeing_area(ring(6)[0], TILTED, (50.0, 50.0, 51.0, 51.0), BOUND, 2)
    assert (columns[:, 0] == columns[:, 1]).all()


def test_wanted_columns_have_the_heights_of_a_whole_image_and_the_others_none(device):
    cameras, step, count, radius = ring(6), 0.04, 9, 2
    stack = BED.stack(device, cameras)
    start = (BED.true_height(cameras[0]) - step * (count // 2)).astype(np.float32)
    columns = np.tile([0, 0], (stack.height, 1))
    columns[20:50] = 31, 64
    part, whole = (match(stack, [1, 2, 3, 4, 5, 6], start, step, count, radius, each) for each in (columns, None))
    for found, expected in zip(part, whole, strict=True):
        np.testing.assert_allclose(found[20:50, 31:64], expected[20:50, 31:64], rtol=1e-4, atol=1e-4)
    assert (part[1][:18] == -1.0).all()
    assert (part[1][:, 70:] == -1.0).all()


@pytest.mark.parametrize("tide", [0.0, 0.15])
@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_corner_rays_are_the_paths_of_pixels_on_both_sides_of_the_water(water, tide):
    camera = replace(ring(6)[2], tide=tide if water is not None else 0.0)
    rays = CornerRays.of(camera, water, (3, 5))
    side = side_of_squares(camera)
    row, column = np.mgrid[:4, :6] * float(side)
    paths = camera.paths(np.stack([column, row], axis=-1), water)
    for level in (-2.3, -0.4, 0.0, 0.1, 0.8):
        height = np.full(row.shape, level)
        expected = paths.at_height(height, water)[..., :2]
        np.testing.assert_allclose(rays.places(height.astype(np.float32)), expected, atol=1e-5)


@pytest.mark.parametrize("level", [-20.0, 0.0, 0.005, 1500.0])
def test_corner_rays_of_a_dry_camera_are_its_paths_wherever_the_frame_has_its_origin(level):
    camera = ring(6)[2]
    camera = replace(camera, centre=(*np.array(camera.centre)[:2], level))
    rays = CornerRays.of(camera, None, (3, 5))
    row, column = np.mgrid[:4, :6] * float(side_of_squares(camera))
    paths = camera.paths(np.stack([column, row], axis=-1), None)
    for over in (-12.0, -0.2, 0.3):
        height = np.full(row.shape, level + over)
        expected = paths.at_height(height, None)[..., :2]
        assert np.isnan(expected).all() == (over > 0.0)
        np.testing.assert_allclose(rays.places(height.astype(np.float32)), expected, atol=1e-3)


WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.34)
LOW, HIGH = -2.0, -1.6
SEARCH = DiscontinuitySearch(radius=1, spacing_px=0.5, tile_px=8, reach_px=2.0, around_px=5, least_score=0.6)
# Too high pixels beside the edge, and the pixels at it whose windows hold both sides.
FAT_PX, EDGE_PX = 4, 3


@dataclass(frozen=True)
class Terrace:
    """A bed with a step of 0.4 m, high in the west; its wall is painted as the ground that it stands on."""

    def true_height(self, camera) -> np.ndarray:
        path = camera.paths(camera.pixel_centres(), WATER)
        return np.where(path.at_height(HIGH, WATER)[..., 0] < 0.0, HIGH, LOW).astype(np.float32)

    def photograph(self, camera) -> np.ndarray:
        path, height = camera.paths(camera.pixel_centres(), WATER), self.true_height(camera)
        points = path.at_height(height, WATER)
        ground = texture(points[..., 0], points[..., 1], seed=4)
        return np.where(height == HIGH, texture(points[..., 0], points[..., 1]), ground).astype(np.float32)


def searched_by(stack, neighbours, found, parallax, search, matched=None):
    """What the search makes of height, score and curvature."""
    job = search_discontinuities(Reference(stack, 0, neighbours, 2), found, parallax, search, matched)
    return run_job(stack.device, job)


def searched(device, height, truth, *, score=0.9, search=SEARCH, matched=None):
    """What the search makes of a height map of the middle view."""
    cameras = ring(8)
    stack = ViewStack.build(device, cameras, [Terrace().photograph(c) for c in cameras], WATER)
    found = (height, np.full_like(truth, score), np.full_like(truth, 5.0))
    parallax = PlaneBed(WATER, LOW).block(device, cameras).parallax(0, list(range(1, 9)), LOW)
    return found, searched_by(stack, list(range(1, 9)), found, parallax, search, matched)


@pytest.fixture
def fattened() -> tuple[np.ndarray, np.ndarray]:
    """True heights of the middle view, and the same with the high side some pixels too wide."""
    truth = Terrace().true_height(ring(8)[0])
    edge = int((truth[0] == HIGH).sum())
    height = truth.copy()
    height[:, edge : edge + FAT_PX] = HIGH
    return truth, height


def test_ground_that_took_the_height_of_the_wall_beside_it_is_found(device, fattened):
    truth, height = fattened
    edge = int((truth[0] == HIGH).sum())
    _, (found, score, curvature) = searched(device, height, truth)
    beside = np.s_[4:-4, edge + EDGE_PX : edge + FAT_PX + 5]
    assert (np.abs(height - truth)[beside] > 0.3).mean() > 0.1
    assert (np.abs(found - truth)[beside] < 0.02).mean() > 0.97
    assert (score[beside] > 0.9).mean() > 0.9
    assert np.abs(found - truth).mean() < 0.5 * np.abs(height - truth).mean()
    assert (curvature[beside] != 5.0).any()


def test_pixels_without_a_step_around_keep_their_heights(device, fattened):
    truth, height = fattened
    edge = int((truth[0] == HIGH).sum())
    before, after = searched(device, height, truth)
    far = np.ones(truth.shape, dtype=bool)
    far[:, edge - SEARCH.around_px - 2 : edge + FAT_PX + SEARCH.around_px + 2] = False
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old[far], new[far])


@pytest.mark.parametrize("case", ["too low scores for the windows", "a level bed", "an image smaller than a tile"])
def test_there_is_nothing_to_search_in(device, fattened, case):
    truth, height = fattened
    if case == "a level bed":
        height = np.full_like(truth, LOW)
    if case == "an image smaller than a tile":
        truth, height = truth[:6], height[:6]
    before, after = searched(device, height, truth, score=0.5 if "scores" in case else 0.9)
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)


def test_tiles_in_several_batches_give_what_one_batch_gives(device, fattened, monkeypatch):
    truth, height = fattened
    _, whole = searched(device, height, truth)
    monkeypatch.setattr(matching, "SAMPLES_PER_LAUNCH", 8 * 10 * 10 * 25 * 3)
    _, parts = searched(device, height, truth)
    np.testing.assert_allclose(whole[0], parts[0], atol=1e-5)


class Wall:
    """A wall of 2 m across the view, its foot at `south` [m] north of the origin, painted along its length and height.

    The ground before it is low; nothing is over it.
    """

    south = 0.1

    def seen(self, camera):
        """Height of the wall at each pixel centre, and whether it is under water and over the ground, and its paint."""
        path = camera.paths(camera.pixel_centres(), WATER)
        upper, lower = path.at_height(-0.5, WATER), path.at_height(LOW, WATER)
        share = (self.south - upper[..., 1]) / (lower[..., 1] - upper[..., 1])
        point = upper + share[..., None] * (lower - upper)
        on_wall = (share > 0.0) & (share < 1.0)
        paint = texture(point[..., 0], point[..., 2])
        ground = texture(lower[..., 0], lower[..., 1], seed=4)
        return np.where(on_wall, point[..., 2], LOW).astype(np.float32), np.where(on_wall, paint, ground), on_wall


def test_a_wall_is_found_better_by_upright_windows_than_by_level_ones(device):
    wall = Wall()
    cameras = [look((x, -6.0, 5.0), (0.0, 0.0, -1.2)) for x in (0.0, -1.5, -0.8, 0.8, 1.5)]
    truth, _, on_wall = wall.seen(cameras[0])
    images = [wall.seen(camera)[1].astype(np.float32) for camera in cameras]
    stack = ViewStack.build(device, cameras, images, WATER)
    rough = cv2.blur(truth, (9, 9))
    found = (rough, np.full_like(truth, 0.9), np.zeros_like(truth))
    parallax = PlaneBed(WATER, -1.2).block(device, cameras).parallax(0, [1, 2, 3, 4], -1.2)
    search = replace(SEARCH, around_px=12)
    errors = []
    for walls in (False, True):
        height, _, _ = searched_by(stack, [1, 2, 3, 4], found, parallax, replace(search, walls=walls))
        errors.append(np.abs(height - truth)[10:-10, 10:-10][on_wall[10:-10, 10:-10]])
    assert len(errors[0]) > 300
    level, upright = (np.mean(error < 0.02) for error in errors)
    assert upright > level + 0.05


def test_beyond_what_was_matched_nothing_is_searched(device, fattened):
    truth, height = fattened
    matched, middle, beyond = np.zeros(truth.shape, dtype=bool), len(truth) // 2, SEARCH.tile_px
    matched[:middle] = True
    _, (whole, *_) = searched(device, height, truth)
    _, (part, *_) = searched(device, height, truth, matched=matched)
    np.testing.assert_array_equal(part[middle:], height[middle:])
    assert (whole[middle:] != height[middle:]).any()
    # A tile has the heights of its wanted pixels alone.
    np.testing.assert_array_equal(part[: middle - beyond], whole[: middle - beyond])
