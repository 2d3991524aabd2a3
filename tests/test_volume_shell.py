"""The shell about the box: inversion in closed form, its two ends, and a backdrop learned from paths."""

import math

import numpy as np
import pytest
import torch
from analytic_volume import BOX, WATER, AnalyticVolume, looking_down, seen_by
from torch import nn

from fields.volume.paths import Box, paths_along
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.shell import Shell, inverted
from refract import PinholeCamera

LONG_BOX = Box(np.array([-3.0, -1.0, -2.0]), np.array([5.0, 2.0, 1.0]))


def random_paths(rng, count: int = 200):
    """Starts inside and outside the unit sphere, and unit directions, float64."""
    origin = torch.from_numpy(rng.normal(size=(count, 3)) * rng.uniform(0.1, 3.0, (count, 1)))
    return origin, nn.functional.normalize(torch.from_numpy(rng.normal(size=(count, 3))), dim=1)


def test_an_inverted_point_lies_on_the_path_at_one_over_u(rng):
    origin, direction = random_paths(rng)
    u = Shell.first(origin, direction)[:, None] * torch.tensor([1.0, 0.7, 0.2, 1e-3], dtype=torch.float64)
    found = inverted(origin, direction, u)
    point = found[..., :3] / found[..., 3:]
    away = point - origin[:, None]
    t = (away * direction[:, None]).sum(dim=-1)
    assert float(t.min()) > -1e-12
    # Points at 1000 semi-axes: 1e3 times the rounding of float64, with a square root at the closest point.
    torch.testing.assert_close(away, t[..., None] * direction[:, None], rtol=0.0, atol=2e-7)
    torch.testing.assert_close(found[..., :3].norm(dim=-1), torch.ones_like(t), rtol=1e-7, atol=0.0)


def test_paths_from_inside_begin_on_the_ellipsoid_where_its_equation_says(rng):
    origin, direction = random_paths(rng)
    origin = 0.9 * origin / origin.norm(dim=1, keepdim=True).clamp(min=1.0)
    assert torch.equal(Shell.first(origin, direction), torch.ones(len(origin), dtype=torch.float64))
    found = inverted(origin, direction, torch.ones(len(origin), 1, dtype=torch.float64))[:, 0, :3]
    for o, d, p in zip(origin.numpy(), direction.numpy(), found.numpy(), strict=True):
        roots = np.roots([1.0, 2.0 * (o @ d), o @ o - 1.0])
        np.testing.assert_allclose(p, o + roots.real.max() * d, atol=1e-12)


def test_paths_that_pass_outside_begin_at_their_closest_point():
    origin = torch.tensor([[-5.0, 2.0, 0.0], [5.0, 2.0, 0.0], [-5.0, 0.5, 0.0]])
    ahead = torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3)
    found = Shell.first(origin, ahead)
    assert found.tolist() == pytest.approx([1 / 2, 1 / math.sqrt(29.0), 1.0])


def test_coordinates_are_continuous_across_the_ellipsoid(rng):
    """Paths that just miss the sphere and those that just meet it see the same point of it."""
    direction = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    seen = []
    for aside in (1.0 - 1e-9, 1.0 + 1e-9):
        origin = torch.tensor([[aside, 0.0, -3.0]], dtype=torch.float64)
        u = Shell.first(origin, direction)[:, None]
        seen.append(inverted(origin, direction, u)[0, 0])
    # The path that meets it leaves it at a height of sqrt(2e-9).
    torch.testing.assert_close(seen[0], seen[1], rtol=0.0, atol=1.01 * math.sqrt(2e-9))


def test_corners_of_the_box_lie_on_the_ellipsoid_and_bent_paths_go_on_in_water():
    shell = Shell(LONG_BOX)
    corners = torch.tensor([[x, y, z] for x in (-3.0, 5.0) for y in (-1.0, 2.0) for z in (-2.0, 1.0)])
    torch.testing.assert_close(((corners - shell.centre) / shell.axes).norm(dim=1), torch.ones(8))
    paths = seen_by(looking_down(), WATER)
    origin, direction = Shell(BOX).scaled(paths)
    exit_point = paths.at(paths.far[:, None])[:, 0]
    torch.testing.assert_close(origin * math.sqrt(3.0), exit_point)
    torch.testing.assert_close(direction, paths.wet)  # of a cube the semi-axes are equal


def test_paths_that_miss_the_box_go_on_in_the_water_from_its_surface():
    sideways = torch.tensor([[0.9, 0.0, -math.sqrt(1.0 - 0.81)]], dtype=torch.float64).numpy()
    origin = np.array([[20.0, 0.0, 5.0]])
    paths = paths_along(origin, sideways, WATER, torch.zeros(1, 3), BOX, torch.zeros(1, dtype=torch.int64))
    assert paths.near.item() == paths.far.item() == 0.0
    start, direction = Shell(BOX).scaled(paths)
    assert start[0, 2].item() * math.sqrt(3.0) == pytest.approx(2.0, abs=1e-5)
    assert direction[0, 0].item() == pytest.approx(0.9 / 1.333, abs=1e-6)


def test_light_of_the_shell_adds_up_to_the_colours_of_its_layers():
    """With one colour everywhere the shell shows it, whatever its density: what passes all layers is the sky's."""
    shell = Shell(BOX)
    nn.init.zeros_(shell.colour[-1].weight)
    shell.colour[-1].bias.data = torch.tensor([0.2, 0.5, -0.1])
    seen = shell(seen_by(looking_down(), WATER))
    expected = nn.functional.softplus(torch.tensor([0.2, 0.5, -0.1]), beta=4.0)
    torch.testing.assert_close(seen, expected.expand_as(seen))


def test_an_empty_shell_shows_the_sky_of_each_direction_and_no_parallax():
    shell = Shell(BOX)
    shell.network[-1].bias.data[0] = -60.0  # softplus of it is 1e-26
    direction = torch.nn.functional.normalize(torch.tensor([[0.3, 0.1, -1.0]]), dim=1).expand(5, 3)
    origins = np.random.default_rng(0).uniform(-3.0, 3.0, (5, 3))
    view = torch.zeros(5, dtype=torch.int64)
    seen = shell(paths_along(origins, direction.numpy(), None, torch.zeros(5, 3), BOX, view))
    torch.testing.assert_close(seen, seen[:1].expand_as(seen), rtol=1e-5, atol=1e-6)


def test_colours_of_one_place_differ_by_direction_and_by_photograph():
    torch.manual_seed(0)
    shell = Shell(BOX, appearance=2)
    nn.init.zeros_(shell.network[-1].weight)  # the same density and features everywhere
    to_all_sides = np.random.default_rng(0).normal(size=(50, 3))
    to_all_sides /= np.linalg.norm(to_all_sides, axis=1, keepdims=True)
    view = torch.zeros(50, dtype=torch.int64)
    paths = paths_along(np.zeros((50, 3)), to_all_sides, None, torch.zeros(50, 3), BOX, view)
    bright, dark = (shell(paths, torch.full((50, 2), number)) for number in (2.0, -2.0))
    assert (bright.std(dim=0) > 0.001).all()
    assert ((bright - dark).abs().mean(dim=0) > 0.001).all()


def test_a_shell_learns_a_distant_backdrop_behind_an_empty_box():
    torch.manual_seed(0)
    renderer = VolumeRenderer(AnalyticVolume(lambda x: torch.zeros(len(x))), background=Shell(BOX))
    camera = PinholeCamera(np.zeros(3), np.eye(3), 12.0, 12.0, 12.0, 12.0, 24, 24)
    paths = seen_by(camera)
    paths.rgb = 0.5 + 0.3 * torch.sin(3.0 * paths.air)
    optimiser = torch.optim.Adam(renderer.background.parameters(), lr=0.01)
    samples = Cells.everywhere(BOX, 8).samples(paths, 4, jitter=False)
    for _ in range(60):
        loss = ((renderer.render(paths, samples).rgb - paths.rgb) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss.item() < 1e-3  # from 0.05, the variance of the backdrop
