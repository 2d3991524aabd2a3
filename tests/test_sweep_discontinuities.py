"""Steps of the bed: what is searched, where, and what the search finds beside a wall."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from plane_survey import PlaneBed, look, ring, texture

from fields.sweep import matching
from fields.sweep.kernels.arrays import run_job
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.matching import DiscontinuitySearch, Reference
from fields.sweep.view_pass import search_discontinuities
from refract import FlatWater

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
