"""The layer about a bed: its raster, its coordinates, and where bent paths meet it."""

import numpy as np
import pytest
import torch
from plane_field import level_layer
from plane_survey import TILTED, PlaneBed, look, ring

from fields.volume.layer import GAP_CELLS, Layer
from fields.volume.paths import Paths, Rays
from refract import FlatWater, PinholeCamera

SLOPE = 0.1


def every_path(camera: PinholeCamera, water: FlatWater | None, layer: Layer | None) -> Paths:
    pixels = camera.pixel_centres()[::5, ::5].reshape(-1, 2)
    grey = np.zeros((len(pixels), 3), dtype=np.uint8)
    return Rays.of(camera, pixels, grey, 0).paths(water, layer)


def middle(paths: Paths) -> torch.Tensor:
    """Positions (N, 3) half way through the layer."""
    return paths.at(0.5 * (paths.near + paths.far)[:, None])[:, 0]


def test_a_cell_has_the_median_height_of_its_points_and_a_gap_that_of_the_nearest():
    columns, rows = np.meshgrid(np.arange(40), np.arange(40))
    is_gap = (abs(columns - 10) < 3) & (abs(rows - 10) < 3)
    is_hole = (abs(columns - 26) < 8) & (abs(rows - 26) < 8)
    assert 2 * 3 - 1 < 2 * GAP_CELLS < 2 * 8 - 1
    kept = ~is_gap & ~is_hole
    xy = np.column_stack([columns[kept], rows[kept]]) + 0.5
    z = np.where(xy[:, 0] > 14.0, 3.0, 0.0)
    # The median of two values is their mean.
    points = np.concatenate([np.column_stack([xy, z + add]) for add in (0.0, 2.0, 7.0, 1.0)])
    layer = Layer.of_points(points, 1.0, 0.25)
    own = layer.height[1:41, 1:41], layer.known[1:41, 1:41]
    np.testing.assert_allclose(own[0], np.where(columns + 0.5 > 14.0, 4.5, 1.5))
    assert own[1][is_gap].all()
    assert not own[1][26, 26]
    assert not layer.known[0].any()
    np.testing.assert_allclose((layer.low[2], layer.high[2], layer.cell), (1.25, 4.75, 1.0))


def test_coordinates_count_from_the_bed():
    layer = level_layer(-2.0, slope_x=SLOPE, half=0.2)
    x = torch.tensor([[0.0, 0.0, -2.0], [1.0, 2.0, -1.8], [-2.0, -2.0, -2.4]])
    torch.testing.assert_close(layer.above(x), torch.tensor([0.0, 0.1, -0.2]), atol=1e-6, rtol=0.0)
    u = torch.tensor([[0.5, 0.5, 0.5], [0.625, 0.75, 0.75], [0.25, 0.25, 0.0]])
    torch.testing.assert_close(layer.unit(x), u, atol=1e-5, rtol=0.0)
    np.testing.assert_allclose(layer.size, [8.0, 8.0, 0.4])


@pytest.mark.parametrize("water", [TILTED, None])
def test_paths_end_about_the_place_where_they_meet_the_bed(water):
    bed, layer = PlaneBed(water, -2.0, SLOPE), level_layer(-2.0, slope_x=SLOPE, half=0.2)
    for camera in ring(3):
        paths = every_path(camera, water, layer)
        truth = camera.paths(camera.pixel_centres(), water).at_height(bed.true_height(camera), water)
        # Float32 coordinates of ten metres, bilinear over tilted cells.
        np.testing.assert_allclose(middle(paths), truth[::5, ::5].reshape(-1, 3), atol=2e-5)
        ends = paths.at(torch.stack([paths.near, paths.far], dim=1))
        falls = -paths.direction(paths.near[:, None])[:, 0, 2]
        torch.testing.assert_close(
            (paths.far - paths.near) * falls, torch.full((len(paths),), 0.4), atol=1e-5, rtol=0.0
        )
        assert (layer.above(ends[:, 0]) > 0.0).all()
        assert (layer.above(ends[:, 1]) < 0.0).all()
        free, place = every_path(camera, water, None), middle(paths)
        along = free.direction(0.5 * (paths.near + paths.far)[:, None])[:, 0]
        beside = place - 0.15 * along
        moved = layer.meeting_near(beside, along)
        torch.testing.assert_close(moved, torch.full((len(paths),), 0.15), atol=1e-3, rtol=0.0)
        again = layer.about(free, 0.5 * (paths.near + paths.far))
        torch.testing.assert_close(again.near, paths.near, atol=1e-5, rtol=0.0)


def test_of_several_meetings_the_first_counts_and_paths_beside_the_bed_miss():
    layer = level_layer(-2.0)
    layer.height[:, 40:45] = -0.5  # A wall of half a metre's width
    layer = Layer(layer.low, np.array([4.0, 4.0, -0.4]), layer.height, layer.known, layer.half)
    oblique = look((-6.0, 0.0, 6.0), (0.8, 0.0, -2.0))
    found = middle(every_path(oblique, None, layer))
    hidden = (found[:, 0] > 0.55) & (found[:, 0] < 1.5)
    assert not hidden.any()
    assert ((found[:, 2] > -1.9) & (found[:, 0] < 0.1)).any()
    beside = every_path(look((6.0, 0.0, 8.0), (6.0, 0.0, -2.0)), None, layer)
    assert (beside.far <= beside.near).any()
    layer.known[:] = False
    gone = every_path(oblique, None, layer)
    assert (gone.far == gone.near).all()
