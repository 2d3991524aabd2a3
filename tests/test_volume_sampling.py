"""Samples along paths, what each stands for; weights, the law of the bed and heights, in closed form and by loops."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import laplace
from test_volume_paths import whole
from volume_scenes import BOX, WATER, looking_down

from fields.volume import sampling
from fields.volume.paths import Box


def test_the_inverse_of_the_accumulated_mass_is_that_of_numpy():
    rng = np.random.default_rng(0)
    edges = np.cumsum(rng.uniform(0.1, 1.0, (5, 9)), axis=1)
    mass = rng.uniform(0.0, 1.0, (5, 8)) * (rng.random((5, 8)) > 0.3)
    levels = np.sort(rng.random((5, 40)), axis=1)
    found = sampling.inverse_cdf(*(torch.as_tensor(v) for v in (edges, mass, levels))).numpy()
    for row in range(5):
        total = np.r_[0.0, np.cumsum(mass[row])] / mass[row].sum()
        filled = np.r_[True, mass[row] > 0]  # np.interp wants a rising function
        start = np.where(mass[row] > 0, edges[row, :-1], np.nan)
        for level, value in zip(levels[row], found[row], strict=True):
            k = np.searchsorted(total[1:], level, side="right")
            share = (level - total[k]) / (total[k + 1] - total[k])
            assert value == pytest.approx(start[k] + share * (edges[row, k + 1] - edges[row, k]), abs=1e-12)
        assert filled[0]


@pytest.mark.parametrize("jitter", [False, True])
def test_samples_lie_in_the_bins_with_mass_and_share_their_length(jitter):
    edges = torch.linspace(0.0, 8.0, 9).expand(3, -1).contiguous()
    mass = torch.tensor([[0.0, 1, 1, 0, 0, 1, 0, 0], [1.0] * 8, [0.0] * 8])
    samples = sampling.samples_by_mass(edges, mass, 12, jitter, dense=False)
    bins = samples.s.floor().long().clamp(max=7)
    assert (mass[0][bins[0]] == 1.0).all()
    torch.testing.assert_close(samples.length.sum(dim=1), torch.tensor([3.0, 8.0, 8.0]))
    assert (samples.s.diff(dim=1) > 0.0).all()
    assert (samples.edges[:, :-1] <= samples.s + 1e-6).all()
    assert (samples.s <= samples.edges[:, 1:] + 1e-6).all()
    # Over many draws a jittered sample is anywhere in its piece; without jitter it is the middle.
    if not jitter:
        torch.testing.assert_close(samples.s[1], samples.edges[1].unfold(0, 2, 1).mean(dim=1))


def test_dense_samples_stand_for_what_lies_between_their_edges():
    edges = torch.linspace(0.0, 4.0, 5)[None]
    samples = sampling.samples_by_mass(edges, torch.tensor([[1.0, 3.0, 0.0, 4.0]]), 8, False, dense=True)
    expected = torch.tensor([[0.0, 1.0, 4 / 3, 5 / 3, 2.0, 3.25, 3.5, 3.75, 4.0]])
    torch.testing.assert_close(samples.edges[:, [0, 1, 2, 3, 5, 6, 7, 8]], expected[:, [0, 1, 2, 3, 5, 6, 7, 8]])
    torch.testing.assert_close(samples.length.sum(dim=1), torch.tensor([4.0]))


def test_cells_hold_what_they_are_said_to():
    box = Box(np.array([0.0, 0.0, 0.0]), np.array([4.0, 2.0, 1.0]))
    cells = sampling.Cells.everywhere(box, 8)
    assert cells.occupied.shape == (8, 4, 2)
    cells.occupied.zero_()
    cells.occupied[5, 1, 0] = True
    x = torch.tensor([[2.6, 0.6, 0.2], [2.4, 0.6, 0.2], [2.6, 0.6, 0.6], [2.6, 0.6, -0.1], [9.0, 0.6, 0.2]])
    assert cells.holds(x).tolist() == [True, False, False, False, False]
    centre = cells.centres().view(8, 4, 2, 3)[5, 1, 0]
    torch.testing.assert_close(centre, torch.tensor([2.75, 0.75, 0.25]))


def cells_about(box: Box, num: int, points: np.ndarray, margin: float) -> sampling.Cells:
    """Cells that a field with mass at points (N, 3) has left."""
    every = sampling.Cells.everywhere(box, num)
    opacity = torch.zeros(every.occupied.shape)
    index = np.floor((points - box.low) / box.size * np.array(opacity.shape)).astype(int)
    index = index[(index < opacity.shape).all(axis=1)]
    opacity[tuple(index.T)] = 1.0
    return every.refined(opacity.view(-1), 0.5, margin)


def test_cells_with_mass_are_thickened_by_the_margin_within_the_box():
    box = Box(np.zeros(3), np.array([4.0, 4.0, 2.0]))
    occupied = cells_about(box, 20, np.array([[2.1, 2.1, 1.1], [0.01, 0.01, 0.01]]), margin=0.4).occupied.numpy()
    expected = np.zeros_like(occupied)
    expected[8:13, 8:13, 3:8] = True
    expected[:3, :3, :3] = True
    np.testing.assert_array_equal(occupied, expected)


def test_samples_lie_in_occupied_cells_and_all_over_a_path_that_misses_them():
    paths = whole(looking_down(tilt=0.2), WATER)
    points = np.stack(np.meshgrid(np.linspace(-1, 0, 60), np.linspace(-1, 1, 60), [-1.5]), axis=-1).reshape(-1, 3)
    cells = cells_about(BOX, 40, points, margin=0.04)
    samples = cells.samples(paths, 16, jitter=True)
    held = cells.holds(paths.at(samples.s))
    share = (
        paths.near[:, None] + (torch.arange(sampling.BINS) + 0.5) / sampling.BINS * (paths.far - paths.near)[:, None]
    )
    crosses = cells.holds(paths.at(share)).any(dim=1)
    assert 0.2 < crosses.float().mean() < 0.9
    # The cells are asked at the middles of 128 bins of some 12 mm: a sample may stand half a bin beside.
    assert held[crosses].float().mean() > 0.9
    torch.testing.assert_close(samples.length[~crosses].sum(dim=1), (paths.far - paths.near)[~crosses])
    step = ((paths.far - paths.near) / sampling.BINS)[crosses]
    count = samples.length.sum(dim=1)[crosses] / step
    torch.testing.assert_close(count, count.round(), rtol=0, atol=1e-2)


def steps_down(num: int, *, top: float = 1.0, bottom: float = -1.0, dtype=torch.float64) -> torch.Tensor:
    """Ends (1, num + 1) of even intervals, downwards."""
    return torch.linspace(top, bottom, num + 1, dtype=dtype)[None]


def weights_about(bed: float, ends: torch.Tensor, width: float) -> torch.Tensor:
    """Weights of the law of a bed at a height, from far above it; the last sample takes the rest."""
    log_t = sampling.log_transmittance(ends - bed, torch.tensor(width, dtype=ends.dtype))
    log_t = torch.cat([torch.zeros_like(log_t[:, :1]), log_t[:, 1:]], dim=1)
    weights = sampling.render_weights(log_t[:, :-1] - log_t[:, 1:])
    return torch.cat([weights[:, :-1], 1.0 - weights[:, :-1].sum(1, keepdim=True)], dim=1)


def test_weights_are_what_arrives_times_what_stays(rng):
    thickness = rng.uniform(0.0, 2.0, (5, 9))
    found = sampling.render_weights(torch.from_numpy(thickness)).numpy()
    for i in range(5):
        for k in range(9):
            arrives = math.exp(-sum(thickness[i, j] for j in range(k)))
            assert found[i, k] == pytest.approx(arrives * (1.0 - math.exp(-thickness[i, k])), rel=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_of_any_thickness_are_shares_and_sum_to_what_does_not_pass(rng, dtype):
    drawn = 10.0 ** rng.uniform(-8.0, 38.0, (400, 12)) * rng.integers(0, 2, (400, 12))
    drawn[rng.random(drawn.shape) < 0.05] = np.inf
    thickness = torch.as_tensor(drawn, dtype=dtype).requires_grad_()
    weights = sampling.render_weights(thickness)
    assert ((weights >= 0.0) & (weights <= 1.0)).all()
    passed = torch.exp(-thickness.double().sum(dim=1))
    # Twelve roundings.
    torch.testing.assert_close(weights.sum(dim=1).double(), 1.0 - passed, rtol=0.0, atol=12 * torch.finfo(dtype).eps)
    weights.sum().backward()
    assert torch.isfinite(thickness.grad).all()


def test_of_many_samples_light_fog_has_a_colour():
    weights = torch.full((2, 200), 0.63 / 200)
    assert (weights < sampling.MIN_COLOUR_WEIGHT).all()
    grey = sampling.composite(weights, lambda where: torch.full((len(where), 3), 0.5), weights.sum(dim=1, keepdim=True))
    torch.testing.assert_close(grey, torch.full((2, 3), 0.5 * 0.63))


@pytest.mark.parametrize("width", [0.01, 0.3])
def test_transmittance_is_the_laplace_distribution_function(width):
    d = np.linspace(-40.0 * width, 40.0 * width, 161)
    found = sampling.log_transmittance(torch.from_numpy(d), torch.tensor(width, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(found, laplace.logcdf(d, scale=width), rtol=1e-12, atol=1e-15)


def test_the_law_and_its_gradients_are_finite_far_away_and_smooth_at_the_bed():
    d = torch.tensor([-1e3, -1e-9, 0.0, 1e-9, 1e3], requires_grad=True)
    width = torch.tensor(0.01, requires_grad=True)
    value = sampling.log_transmittance(d, width)
    assert value[1:4].tolist() == pytest.approx([-math.log(2.0)] * 3, abs=1e-6)
    value.sum().backward()
    assert torch.isfinite(d.grad).all()
    assert torch.isfinite(width.grad)
    assert torch.autograd.gradcheck(
        sampling.log_transmittance,
        (torch.tensor([-0.3, -0.01, 0.02, 0.4]).double().requires_grad_(), torch.tensor(0.1).double().requires_grad_()),
    )


@pytest.mark.parametrize("width", [0.003, 0.05, 0.4])
@pytest.mark.parametrize("num", [6, 16])
def test_the_middle_of_the_weights_is_the_bed_for_any_width(num, width):
    """Exact where the bed lies on an end of an interval or in its middle; between them off by a share of a step."""
    ends, step = steps_down(num), 2.0 / num
    places = torch.linspace(-0.4, 0.4, 33, dtype=torch.float64) * step + float(ends[0, num // 2])
    off = [float(sampling.quantile_height(weights_about(float(b), ends, width), ends)[0] - b) for b in places]
    assert off[16] == pytest.approx(0.0, abs=1e-12)
    assert np.mean(off) == pytest.approx(0.0, abs=1e-12)
    # What linear interpolation of an exponential costs: h / (8 w) steps for wide laws, half a step for sharp ones.
    assert np.abs(off).max() < step * min(0.5, step / (8.0 * width))


def test_quantiles_are_those_of_a_slow_walk_along_the_ray(rng):
    # What passed through does not count.
    weights = rng.dirichlet(np.ones(7), 40) * rng.uniform(0.2, 1.0, (40, 1))
    weights[::3, 2] = 0.0  # an empty sample on the way
    ends = np.sort(rng.uniform(-1.0, 1.0, (40, 8)))[:, ::-1].copy()
    for level in (0.16, 0.5, 0.84):
        found = sampling.quantile_height(torch.from_numpy(weights), torch.from_numpy(ends), level).numpy()
        for i in range(40):
            left = level * weights[i].sum()
            for k in range(7):
                if weights[i, k] >= left:
                    break
                left -= weights[i, k]
            truth = ends[i, k] + left / weights[i, k] * (ends[i, k + 1] - ends[i, k])
            assert found[i] == pytest.approx(truth, abs=1e-12)


def test_a_ray_without_any_weight_has_a_height_inside_its_ends():
    ends = steps_down(4, dtype=torch.float32)
    assert -1.0 <= float(sampling.quantile_height(torch.zeros(1, 4), ends)[0]) <= 1.0


def test_an_opaque_end_takes_what_the_samples_before_it_let_pass():
    weights = torch.tensor([[0.2, 0.3, 0.1], [0.5, 0.5, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(sampling.with_opaque_end(weights).sum(dim=1), torch.ones(2, dtype=torch.float64))
    torch.testing.assert_close(sampling.with_opaque_end(weights)[:, :2], weights[:, :2])
    meets = torch.tensor([[1.0], [0.0]])
    assert sampling.with_opaque_end(weights, meets)[:, 2].tolist() == pytest.approx([0.5, 0.0])


def test_samples_too_light_to_be_looked_up_take_the_colour_of_the_others():
    weights = torch.tensor([[0.6, 0.5 * sampling.MIN_COLOUR_WEIGHT, 0.2], [0.0, 0.0, 0.0]])
    asked = []

    def look(where: torch.Tensor) -> torch.Tensor:
        asked.extend(where.tolist())
        return torch.tensor([[1.0, 0.0, 0.4], [0.0, 1.0, 0.4]])

    opacity = weights.sum(dim=1, keepdim=True)
    found = sampling.composite(weights, look, opacity)
    assert asked == [0, 2]
    torch.testing.assert_close(found[0], opacity[0] * torch.tensor([0.75, 0.25, 0.4]))
    assert not found[1].any()
    opaque = sampling.composite(weights[:1], look)
    torch.testing.assert_close(opaque[0], torch.tensor([0.75, 0.25, 0.4]))
