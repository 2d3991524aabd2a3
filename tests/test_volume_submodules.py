"""Submodules: cells on the ground, the blend of rendered pixels as printed, looks that match, what views do without."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_volume import AnalyticVolume, floor_at
from analytic_volume import looking_down as high_over
from torch import nn
from volume_scenes import WATER, Backdrop, Slab, looking_down

from fields.image_store import as_stored
from fields.volume import submodules
from fields.volume.fitted import appearance_vectors
from fields.volume.paths import Box
from fields.volume.photographs import pixels_over
from fields.volume.renderer import VolumeRenderer, render_volume
from fields.volume.sampling import Cells

GRID = submodules.Grid(Box(np.array([-1.0, -1.0, -2.0]), np.array([1.0, 1.0, -0.5])), (2, 1))
RED, BLUE = (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)


def coloured(number: int, radiance, background: nn.Module | None = None) -> submodules.Submodule:
    """An opaque bed at 1.5 m under water in the box of a cell, of one colour."""
    box = GRID.box_of(number)
    renderer = VolumeRenderer(Slab(1e3, -1.5, box, radiance), background=background)
    return submodules.Submodule(number, renderer, Cells.everywhere(box, 16))


def test_cells_cover_the_ground_once_and_their_boxes_share_half_a_cell():
    grid = submodules.Grid(Box(np.zeros(3), np.array([6.0, 4.0, 1.0])), (3, 2))
    assert grid.names() == ["0_0", "1_0", "2_0", "0_1", "1_1", "2_1"]
    places = np.array([[1.0, 1.0], [3.0, 1.0], [5.0, 3.9], [-9.0, 9.0], [2.0, 1.99]])
    assert grid.owner(places).tolist() == [0, 1, 5, 3, 1]
    middle = grid.box_of(1)
    assert (middle.low.tolist(), middle.high.tolist()) == ([1.5, 0.0, 0.0], [4.5, 2.5, 1.0])
    assert grid.box_of(0).high[0] - middle.low[0] == 0.5 * grid.size[0]


@pytest.mark.parametrize(
    ("said", "size", "counts"),
    [("3x2", (1.0, 9.0), (3, 2)), ("4", (5.0, 5.0), (2, 2)), ("6", (30.0, 20.0), (3, 2)), ("5", (1.0, 9.0), (1, 5))],
)
def test_a_number_of_cells_is_shared_out_as_squares(said, size, counts):
    assert submodules.counts_of(said, np.array(size)) == counts


def test_ground_of_cells_that_are_left_out_is_that_of_the_nearest_trained_one():
    grid = submodules.Grid(Box(np.zeros(3), np.array([6.0, 4.0, 1.0])), (3, 2), trained=(0, 2))
    places = np.array([[1.0, 1.0], [2.9, 1.0], [3.1, 1.0], [5.0, 3.9], [1.0, 3.0], [5.0, 1.0]])
    assert grid.owner(places).tolist() == [0, 0, 2, 2, 0, 2]
    assert grid.owner(places[2]) == 2
    whole = submodules.ground_shares(GRID, bed(), looking_down(x=-2.0), WATER)
    only = submodules.ground_shares(replace(GRID, trained=(1,)), bed(), looking_down(x=-2.0), WATER)
    assert only.tolist() == [0.0, pytest.approx(whole.sum())]


def slow_blend(camera, several, power: float) -> np.ndarray:
    """Equation (1) transcribed, pixel by pixel."""
    pictures = [render_volume(s.renderer, camera, WATER, s.cells, samples=32).rgb for s in several]
    shown = [set(pixels_over(camera, s.box, WATER).tolist()) for s in several]
    rgb = np.zeros((camera.height, camera.width, 3))
    for row in range(camera.height):
        for column in range(camera.width):
            above, below = np.zeros(3), 0.0
            for picture, submodule, own in zip(pictures, several, shown, strict=True):
                shows = row * camera.width + column in own
                middle = 0.5 * (submodule.box.low + submodule.box.high)
                weight = shows * sum((camera.centre - middle) ** 2) ** (-0.5 * power)
                above, below = above + weight * picture[row, column], below + weight
            rgb[row, column] = above / below if below else 0.0
    return rgb


def test_pixels_are_blended_by_the_inverse_distance_of_the_camera_as_printed():
    several, camera = [coloured(0, RED), coloured(1, BLUE)], looking_down(x=0.4)
    weights = submodules.pose_weights(camera.centre, [each.box for each in several], 4.0)
    seen = submodules.render_submodules(zip(weights, several, strict=True), GRID, camera, WATER, samples=32)
    expected = slow_blend(camera, several, 4.0)
    # Colours are single precision.
    np.testing.assert_allclose(seen.rgb, expected, atol=1e-6)
    # Cells meet at x = 0; the boxes overlap over half a cell about it, where both colours are seen.
    both = (seen.rgb[..., 0] > 0.5) & (seen.rgb[..., 2] > 0.5)
    assert 0.1 < both.mean() < 0.5
    assert weights[1] > weights[0]


def test_places_are_not_blended_but_those_of_the_submodule_whose_ground_it_is():
    camera = looking_down()
    high, low = coloured(0, RED), coloured(1, BLUE)
    low.renderer.model.top = -1.8
    seen = submodules.render_submodules([(0.5, high), (0.5, low)], GRID, camera, WATER, samples=64)
    known = np.isfinite(seen.distance)
    heights, owner = seen.points[known][:, 2], GRID.owner(seen.points[known])
    np.testing.assert_allclose(heights, np.where(owner == 0, -1.5, -1.8), atol=0.03)
    assert set(owner) == {0, 1}


def test_with_a_background_a_submodule_shows_all_pixels():
    camera = looking_down()
    grey = Backdrop((0.5, 0.5, 0.5))
    alone = submodules.render_submodules([(1.0, coloured(0, RED, grey))], GRID, camera, WATER, samples=32)
    assert (alone.rgb > 0.05).all()
    assert alone.rgb[0, -1].tolist() == pytest.approx([0.5] * 3, abs=1e-3)
    without = submodules.render_submodules([(1.0, coloured(0, RED))], GRID, camera, WATER, samples=32)
    assert without.rgb[0, -1].tolist() == [0.0, 0.0, 0.0]
    assert np.isnan(without.distance[0, -1])


def bed(height: float = -1.5) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.99, 0.99, 100), np.linspace(-0.99, 0.99, 100))
    return np.stack([x, y, np.full(x.shape, height)], axis=-1).reshape(-1, 3)


def test_what_a_view_shows_of_each_cells_ground_follows_from_the_bed():
    over = submodules.ground_shares(GRID, bed(), looking_down(), WATER)
    aside = submodules.ground_shares(GRID, bed(), looking_down(x=1.5), WATER)
    assert over[0] == pytest.approx(over[1], abs=0.05)
    assert aside[1] > 10 * aside[0]
    # A board over the eastern cell hides its bed, and is the ground of that cell itself.
    board = bed(0.5)[bed()[:, 0] > 0.0] * (0.5, 1.0, 1.0)
    hidden = submodules.ground_shares(GRID, np.concatenate([bed(), board]), looking_down(), WATER)
    assert hidden[0] <= over[0]
    assert submodules.kept(aside, 0.05).tolist() == [1]
    assert submodules.kept(np.zeros(3)).tolist() == [0, 1, 2]
    assert submodules.kept(np.array([0.001, 0.002, 0.0]), 0.01).tolist() == [1]


def lit(number: int, grid: submodules.Grid, vectors: torch.Tensor, gain: float) -> submodules.Submodule:
    """A floor whose colours are brighter by a gain of its own than the vector says."""
    box = grid.box_of(number)
    model = Lit(floor_at(0.0).density, box, gain)
    renderer = VolumeRenderer(model, appearance=appearance_vectors(*vectors.shape))
    renderer.appearance.weight.data[:] = vectors
    return submodules.Submodule(number, renderer, Cells.everywhere(box, 16))


class Lit(AnalyticVolume):
    """An analytic volume whose colours have a gain."""

    def __init__(self, density, box, gain):
        super().__init__(density, box)
        self.gain = gain

    def radiance(self, features, direction, appearance):
        return self.gain * super().radiance(features, direction, appearance)


DRY = submodules.Grid(Box(np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0])), (3, 1))


def test_a_look_is_matched_to_that_of_a_neighbour_and_nothing_else_changes():
    source, target = lit(0, DRY, torch.zeros(1, 3), 1.0), lit(1, DRY, torch.ones(2, 3), 0.5)
    before = {k: v.clone() for k, v in target.renderer.state_dict().items()}
    cameras = [high_over(x) for x in (-0.5, 0.0, 0.4)]
    assert submodules.match_submodule(target, source, cameras, bed(0.0), None)
    # The gain of 0.5 is made up for by exp of the mean of the vector; 2 % is a grey value or two.
    assert float(torch.exp(submodules.vectors_of(target).mean())) == pytest.approx(2.0, rel=0.02)
    assert all(torch.equal(before[k], v) for k, v in target.renderer.state_dict().items() if "appearance" not in k)


def matched(several: list[submodules.Submodule], cameras: list) -> list[tuple[int, int]]:
    """Submodules matched to the first one or to another that is, with those they are matched to."""
    pairs = submodules.matching_pairs([each.box for each in several], 0, bed(0.0))
    return [(m, n) for m, n in pairs if submodules.match_submodule(several[m], several[n], cameras, bed(0.0), None)]


def test_looks_go_from_neighbour_to_neighbour():
    """The cells at both ends share no ground: the third is matched through the second."""
    gains = (1.0, 0.7, 0.5)
    several = [lit(n, DRY, torch.full((2, 3), 0.3), gain) for n, gain in enumerate(gains)]
    several[0].renderer.appearance = submodules.single_vector(torch.zeros(3))
    cameras = [high_over(x) for x in (-0.6, 0.0, 0.6)]
    assert matched(several, cameras) == [(1, 0), (2, 1)]
    found = [float(torch.exp(submodules.vectors_of(each).mean())) for each in several]
    assert found == pytest.approx([1.0 / gain for gain in gains], rel=0.03)


def test_one_that_shares_no_ground_keeps_the_mean_of_its_own():
    far = lit(2, DRY, torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]), 1.0)
    root = lit(0, DRY, torch.zeros(1, 3), 1.0)
    assert matched([root, far], [high_over()]) == []
    assert submodules.vectors_of(far).tolist() == [[0.5, 1.0, 1.5]]


def test_submodules_without_vectors_cannot_be_matched():
    with pytest.raises(ValueError, match="no appearance vectors to match; train them"):
        submodules.vectors_of(coloured(0, RED))


def test_only_the_wanted_pixels_of_a_view_are_rendered():
    submodule, camera = coloured(0, RED), looking_down()
    whole = render_volume(submodule.renderer, camera, WATER, submodule.cells, samples=16)
    some = np.array([3, 200, 301])
    part = render_volume(submodule.renderer, camera, WATER, submodule.cells, samples=16, shown=some)
    # Chunks of other sizes round otherwise.
    np.testing.assert_allclose(part.rgb.reshape(-1, 3)[some], whole.rgb.reshape(-1, 3)[some], atol=1e-6)
    rest = np.setdiff1d(np.arange(camera.width * camera.height), some)
    assert not part.rgb.reshape(-1, 3)[rest].any()
    assert np.isnan(part.distance.ravel()[rest]).all()
    assert float(as_stored(torch.tensor(RED[0]))) == pytest.approx(whole.rgb.max(), abs=1e-3)
