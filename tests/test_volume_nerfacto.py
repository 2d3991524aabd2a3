"""The hash grid against a slow reference; proposals against their equations; what learns from what."""

import itertools
import math

import numpy as np
import pytest
import torch
from plane_survey import look
from volume_models import check_interface, check_learning, positions, require_rates, store_and_load
from volume_scenes import BOX

from fields.device import choose_device
from fields.factors import geometric_scales
from fields.volume.model import Setup
from fields.volume.nerfacto import (
    EVEN_SHARE,
    HashGrid,
    HashSettings,
    HashVolume,
    Histogram,
    Proposal,
    ProposalSettings,
    bound_of,
    hash_grid,
    interlevel_loss,
    nerfacto,
)
from fields.volume.paths import Box, Paths, paths_of
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import samples_by_mass
from fields.water_column import WaterColumn

SMALL = HashSettings(levels=5, log2_table=10, n_min=6, n_max=48, hidden=16, geometry=7)
CUBE = Box(np.zeros(3), np.full(3, 2.0))


def grid(box: Box = BOX, *, seed: int = 0, **changes) -> HashGrid:
    """A small grid, its table of order 1, in float64."""
    torch.manual_seed(seed)
    sizes = {"levels": 5, "log2_table": 10, "n_min": 6, "n_max": 48} | changes
    made = HashGrid(box, **sizes).double()
    torch.nn.init.normal_(made.table)
    return made


def slow_rows(box: Box, n: float, log2_table: int) -> tuple[list[int], dict]:
    """Cells of one level along each axis, and the row of each node, as the module's equation (2) says."""
    cells = [max(round(round(n) * float(size) / box.edge), 2) for size in box.size]
    rows = {}
    is_dense = math.prod(c + 1 for c in cells) <= 2**log2_table
    for node in itertools.product(*(range(c + 1) for c in cells)):
        x, y, z = node
        dense = x + (cells[0] + 1) * (y + (cells[1] + 1) * z)
        rows[node] = dense if is_dense else (x ^ 2654435761 * y ^ 805459861 * z) % 2**log2_table
    return cells, rows


def slow_features(made: HashGrid, box: Box, x: np.ndarray, scales: list[float], log2_table: int) -> list[float]:
    """Features at one position [m], corner by corner."""
    table, features, first = made.table.detach().numpy(), [], 0
    for n in scales:
        cells, rows = slow_rows(box, n, log2_table)
        place = [float((x[k] - box.low[k]) / box.size[k]) * cells[k] for k in range(3)]
        low = [min(int(p), c - 1) for p, c in zip(place, cells, strict=True)]
        total = np.zeros(2)
        for corner in itertools.product((0, 1), repeat=3):
            shares = [p - i if c else 1.0 - (p - i) for p, i, c in zip(place, low, corner, strict=True)]
            node = tuple(i + c for i, c in zip(low, corner, strict=True))
            total = total + math.prod(shares) * table[first + rows[node]]
        features += total.tolist()
        first += max(rows.values()) + 1 if len(rows) <= 2**log2_table else 2**log2_table
    assert first == len(table)
    return features


@pytest.mark.parametrize("box", [BOX, CUBE], ids=["flat", "cube"])
def test_features_are_those_of_a_walk_over_levels_and_corners(box, rng):
    made = grid(box, n_max=24)
    scales = geometric_scales(6, 24, 5)
    assert 0 < made.num_dense < 5
    x = rng.uniform(box.low, box.high, (20, 3))
    x[0], x[1] = box.low, box.high
    found = made(box.unit(torch.from_numpy(x))).detach().numpy()
    for value, one in zip(found, x, strict=True):
        np.testing.assert_allclose(value, slow_features(made, box, one, scales, 10), rtol=1e-10, atol=1e-13)


def test_the_gradient_of_the_table_is_that_of_finite_differences(rng):
    made = grid(levels=2, log2_table=5, n_min=2, n_max=6)
    assert made.num_dense == 1
    u = torch.from_numpy(rng.uniform(0.0, 1.0, (6, 3)))

    def features(table):
        return torch.func.functional_call(made, {"table": table}, u)

    assert torch.autograd.gradcheck(features, made.table.detach().clone().requires_grad_(True))


def test_outside_the_box_it_is_as_at_its_border():
    made = grid()
    u = torch.tensor([[-0.3, 0.4, 0.5], [1.3, 0.4, 0.5]], dtype=torch.float64)
    assert torch.equal(made(u), made(u.clamp(0.0, 1.0)))


def test_the_gradient_is_the_same_bit_for_bit_on_any_number_of_threads(rng):
    made = grid().float()
    u = torch.from_numpy(rng.uniform(0.0, 1.0, (20_000, 3))).float()
    threads, gradients = torch.get_num_threads(), []
    try:
        for num in (1, 2, 2):
            torch.set_num_threads(num)
            (gradient,) = torch.autograd.grad(made(u).square().sum(), made.table)
            gradients.append(gradient)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(gradients[0], gradients[1])
    assert torch.equal(gradients[1], gradients[2])


def test_it_is_a_volume_model():
    check_interface(lambda appearance: HashVolume(BOX, SMALL, appearance=appearance))


def test_it_learns_a_bed_under_water():
    check_learning(lambda appearance: HashVolume(BOX, SMALL, appearance=appearance), steps=40, share=0.5)


SMALL_PROPOSAL = ProposalSettings(samples=(40, 24), n_max=(12, 24), n_min=6, levels=3, log2_table=10, hidden=8)


def falling(num: int) -> Paths:
    """Paths straight down through the box, 1.5 m of each, dry; the last misses it."""
    camera = look((0.1, -0.1, 0.0), (0.1, -0.1, -2.0))
    pixels = np.tile([camera.cx, camera.cy], (num, 1))
    pixels[-1, 0] = 1e5
    return paths_of(camera, None, pixels, np.zeros((num, 3)), BOX)


def proposal(seed: int = 0) -> Proposal:
    torch.manual_seed(seed)
    return Proposal(BOX, SMALL_PROPOSAL)


def histograms(rng, num_own: int = 6, num_proposed: int = 9, paths: int = 30) -> tuple[Histogram, Histogram]:
    """Two histograms over the same paths, of random pieces and weights."""
    both = []
    for num in (num_own, num_proposed):
        inner = np.sort(rng.uniform(0.0, 1.0, (paths, num - 1)), axis=1)
        edges = np.column_stack([np.zeros(paths), inner, np.ones(paths)])
        both.append(Histogram(torch.from_numpy(edges), torch.from_numpy(rng.dirichlet(np.ones(num), paths))))
    return both[0], both[1]


def slow_bounds(proposed: Histogram, edges: torch.Tensor) -> np.ndarray:
    """Equation 12, piece by piece."""
    bins, weights, found = proposed.edges.numpy(), proposed.weights.numpy(), []
    for row, own in enumerate(edges.numpy()):
        for start, end in itertools.pairwise(own):
            overlap = (bins[row, :-1] < end) & (bins[row, 1:] > start)
            found.append(weights[row][overlap].sum())
    return np.reshape(found, (len(edges), -1))


def test_samples_are_drawn_evenly_at_first_and_by_the_weights_after_the_annealing():
    torch.manual_seed(0)
    annealed = Proposal(BOX, ProposalSettings((40, 24), (12, 24), 6, 3, 10, 8, annealed=20))
    found = []
    for step in (0, 2, 10, 20, 30):
        annealed.step.fill_(step)
        found.append(annealed.power())
    # 10 t / (9 t + 1).
    assert found == pytest.approx([0.0, 1.0 / 1.9, 5.0 / 5.5, 1.0, 1.0])
    assert proposal().power() == 1.0
    annealed.step.fill_(0)
    paths = falling(2)
    even = annealed.samples(paths, 8, jitter=False)
    torch.testing.assert_close(even.length[0], torch.full((8,), 1.5 / 8.0), rtol=1e-3, atol=0.0)
    with torch.no_grad():  # a view that is rendered meanwhile
        drawn = annealed.samples(paths, 8, jitter=False)
    annealed.step.fill_(20)
    over = annealed.samples(paths, 8, jitter=False)
    assert torch.equal(drawn.length, over.length)
    assert not torch.allclose(drawn.length, even.length, rtol=1e-2)
    annealed.step.fill_(0)
    annealed.loss(even, torch.full((2, 8), 0.1))
    assert int(annealed.step) == 1


def test_nerfacto_anneals_over_a_thirtieth_of_its_training():
    setups = [Setup(BOX, 16, choose_device("torch"), steps=steps) for steps in (30_000, 2000, 14)]
    assert [nerfacto(each).proposal(each).settings.annealed for each in setups] == [1000, 67, 0]
    small = hash_grid(setups[1]).proposal(setups[1]).settings
    assert (small.annealed, small.samples, small.n_max) == (0, (48,), (16,))


def test_pieces_that_only_touch_do_not_overlap():
    proposed = Histogram(torch.tensor([[0.0, 1.0, 2.0, 3.0]]), torch.tensor([[0.5, 0.25, 0.125]]))
    found = bound_of(proposed, torch.tensor([[0.0, 1.0, 1.5, 3.0]]))
    assert found.tolist() == [[0.5, 0.25, 0.375]]


def test_the_loss_is_that_of_the_paper_and_zero_under_a_bound(rng):
    own, proposed = histograms(rng)
    excess = np.maximum(own.weights.numpy() - slow_bounds(proposed, own.edges), 0.0)
    expected = (excess**2 / own.weights.numpy()).sum(axis=1).mean()
    assert expected > 1e-3
    assert interlevel_loss(own, proposed).item() == pytest.approx(expected, rel=1e-12)
    # Itself, and any coarser sum of itself, bounds a histogram; 1e-30 is the square of the rounding of sums to 1.
    assert interlevel_loss(own, own).item() < 1e-30
    coarse = Histogram(own.edges[:, ::2], own.weights.view(len(own.weights), -1, 2).sum(dim=2))
    assert interlevel_loss(own, coarse).item() < 1e-30
    half = Histogram(own.edges, 0.5 * own.weights)  # excess w / 2: the loss is a quarter of the weights, which sum to 1
    assert interlevel_loss(own, half).item() == pytest.approx(0.25, rel=1e-12)


def test_samples_follow_the_weights_but_for_an_even_share():
    made, paths = proposal(), falling(3)
    made.density = lambda index, x: 200.0 * ((x[:, 2] + 1.25).abs() < 0.1)
    drawn = made.samples(paths, 200, jitter=False)
    # Light is stopped between 1.15 and 1.35 m, 2/15 of the way, give or take the first pieces of 0.04 m.
    inside = ((drawn.s[:-1] > 1.11) & (drawn.s[:-1] < 1.39)).float().mean().item()
    assert inside == pytest.approx(1.0 - EVEN_SHARE + EVEN_SHARE * 2.0 / 15.0, abs=0.02)
    # The gaps of the even share are a tenth as dense as even samples would be.
    assert drawn.length[:-1].max() < 1.5 / (200 * EVEN_SHARE) * 1.1


def test_an_empty_box_is_sampled_evenly_and_pieces_cover_the_path():
    made, paths = proposal(), falling(3)
    made.density = lambda index, x: torch.zeros(len(x))
    drawn = made.samples(paths, 16, jitter=False)
    torch.testing.assert_close(drawn.length[:-1], torch.full((2, 16), 1.5 / 16), atol=1e-6, rtol=0.0)  # of sums to 2
    torch.testing.assert_close(drawn.edges[:-1, [0, -1]], torch.tensor([[0.5, 2.0]] * 2))
    assert not drawn.length[-1].any()


def test_every_sample_lies_in_its_piece_and_a_path_that_misses_has_no_length():
    torch.manual_seed(0)
    paths = falling(40)
    for found in (proposal().samples(paths, 24, jitter=jitter) for jitter in (True, False)):
        assert (found.s >= found.edges[:, :-1] - 1e-6).all()  # a few roundings of 2
        assert (found.s <= found.edges[:, 1:] + 1e-6).all()
        assert not found.s.requires_grad
        assert [r.weights.shape[1] for r in found.rounds] == list(SMALL_PROPOSAL.samples)
        assert all(bool(torch.isfinite(r.weights).all()) for r in found.rounds)
        assert not found.rounds[0].weights[-1].any()


def test_the_loss_teaches_the_proposal_alone():
    made, paths = proposal(), falling(20)
    model = HashVolume(BOX, HashSettings(3, 8, 6, 12, hidden=8, geometry=3))
    renderer = VolumeRenderer(model, column=WaterColumn(), proposal=made)
    rendered = renderer.render(paths, renderer.samples(paths, None, 32, jitter=True))
    opaque = rendered.weights + 0.5
    opaque.retain_grad()
    made.loss(rendered.samples, opaque).backward()
    assert opaque.grad is None
    assert all(p.grad is None for p in model.parameters())
    assert [name for name, p in made.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_a_proposal_does_not_learn_from_samples_that_others_drew():
    renderer = VolumeRenderer(HashVolume(BOX, HashSettings(3, 8, 6, 12, hidden=8, geometry=3)), proposal=proposal())
    paths = falling(4)
    even = samples_by_mass(torch.stack([paths.near, paths.far], dim=1), torch.ones(4, 1), 8, False, dense=True)
    with pytest.raises(TypeError, match="samples that it drew itself"):
        renderer.penalty(paths, renderer.render(paths, even))


def test_a_renderer_has_the_proposals_parameters_and_comes_back_bit_for_bit():
    renderer, again = (
        VolumeRenderer(HashVolume(BOX, HashSettings(3, 8, 6, 12, hidden=8, geometry=3)), proposal=proposal(seed))
        for seed in (0, 1)
    )
    require_rates(renderer)
    store_and_load(renderer, again)
    assert torch.equal(renderer.proposal.density(1, positions(9)), again.proposal.density(1, positions(9)))


def test_rounds_of_unequal_number_are_refused():
    with pytest.raises(ValueError, match=r"samples \(64, 32\) and n_max \(128,\) expect one number for each round"):
        ProposalSettings(samples=(64, 32), n_max=(128,))


def test_a_proposal_learns_with_its_volume():
    made = proposal()
    settings = HashSettings(levels=5, log2_table=10, n_min=6, n_max=48, hidden=16, geometry=7)
    check_learning(lambda appearance: HashVolume(BOX, settings), steps=40, share=0.5, proposal=made)
