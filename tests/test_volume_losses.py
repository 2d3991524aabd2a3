"""Losses on weights, density, priors and patches: closed forms, loops, gradients; nothing where they must vanish."""

import math
from dataclasses import fields

import numpy as np
import pytest
import torch
from analytic_volume import BOX, WATER, AnalyticVolume, floor_at, looking_down, seen_by
from volume_scenes import Backdrop

from fields.models import PATCH_PX, Losses
from fields.volume import losses
from fields.volume.paths import Paths
from fields.volume.photographs import COLUMNS, Photographs, PriorImages, prior_columns
from fields.volume.renderer import Rendered, VolumeRenderer
from fields.volume.sampling import Cells, Samples
from refract import PinholeCamera

LENGTH = 0.1


def number(value: torch.Tensor) -> float:
    return value.detach().item()


def rendered_from(weights: torch.Tensor, edges: torch.Tensor) -> Rendered:
    samples = Samples(0.5 * (edges[:, 1:] + edges[:, :-1]), edges[:, 1:] - edges[:, :-1], edges)
    return Rendered(torch.full((len(weights), 3), 0.5, dtype=weights.dtype), weights, samples)


@pytest.fixture
def batch():
    """Three paths with random weights over uneven intervals, float64."""
    torch.manual_seed(0)
    paths = seen_by(looking_down())[:3]
    for name in ("near", "far", "origin", "air", "wet", "crossing"):
        setattr(paths, name, getattr(paths, name).double())
    inner = torch.rand(3, 6, dtype=torch.float64).sort(dim=1).values
    shares = torch.cat([torch.zeros(3, 1), inner, torch.ones(3, 1)], dim=1)
    edges = paths.near[:, None] + shares * (paths.far - paths.near)[:, None]
    weights = torch.rand(3, 7, dtype=torch.float64) / 7.0
    return paths, edges, weights


def test_transparency_is_what_the_weights_leave(batch):
    _, edges, weights = batch
    assert number(losses.transparency_loss(rendered_from(weights, edges))) == pytest.approx(
        1.0 - number(weights.sum()) / 3
    )


def test_distortion_is_the_double_sum_of_its_equation(batch):
    paths, edges, weights = batch
    total = 0.0
    for path in range(3):
        near, far = number(paths.near[path]), number(paths.far[path])
        s, w = [(number(e) - near) / (far - near) for e in edges[path]], weights[path].tolist()
        middle = [0.5 * (a + b) for a, b in zip(s[1:], s[:-1], strict=True)]
        total += sum(w[i] * w[j] * abs(middle[i] - middle[j]) for i in range(7) for j in range(7))
        total += sum(w[i] ** 2 * (s[i + 1] - s[i]) for i in range(7)) / 3.0
    assert number(losses.distortion_loss(paths, rendered_from(weights, edges))) == pytest.approx(total / 3, rel=1e-12)


def opacity_is(formula) -> AnalyticVolume:
    """A volume of which a piece of `LENGTH` stops a share that is a formula of positions."""
    return AnalyticVolume(lambda x: -torch.log1p(-formula(x.double())) / LENGTH)


def test_even_density_costs_nothing_however_high_it_is():
    for density in (0.0, 3.0, 1e6):
        drawn = losses.draw_nodes(AnalyticVolume(lambda x, d=density: torch.full((len(x),), d)), LENGTH)
        assert number(losses.density_loss(*drawn)) == 0.0


def test_the_density_loss_of_a_ramp_is_its_closed_form():
    slope = torch.tensor([0.3, -0.1, 0.05], dtype=torch.float64)
    model = opacity_is(lambda x: 0.5 + x @ slope)
    torch.manual_seed(0)
    drawn = losses.draw_nodes(model, LENGTH, drawn=4000, points=8)
    torch.testing.assert_close(drawn[1].mean(dim=(0, 1)), LENGTH * slope, rtol=1e-5, atol=1e-7)  # float32 places
    node = 2.0 / torch.tensor(BOX.counts(losses.NODES))
    variance = number((slope**2 * node**2 / 12.0).sum()) * 7 / 8
    expected = number(torch.expm1(LENGTH * slope.abs()).mean()) + math.expm1(variance)
    # The variance is a mean over 4000 nodes: 1 % of a term that is a hundredth of the sum.
    assert number(losses.density_loss(*drawn)) == pytest.approx(expected, rel=1e-3)


def test_the_density_loss_stays_finite_at_an_opaque_wall():
    drawn = losses.draw_nodes(floor_at(0.0, width=1e-6, density=1e6), LENGTH)
    assert number(drawn[1].abs().max()) <= 1.0
    assert number(losses.density_loss(*drawn)) < math.e


def test_gradients_of_the_density_losses_are_those_of_finite_differences():
    def loss(slope: torch.Tensor) -> torch.Tensor:
        model = opacity_is(lambda x: 0.5 + 0.2 * torch.sin(x @ slope))
        torch.manual_seed(3)
        return losses.density_loss(*losses.draw_nodes(model, LENGTH, drawn=4, points=3)) + losses.gaussian_density_loss(
            model, LENGTH, points=5
        )

    slope = torch.tensor([0.9, -0.4, 0.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(loss, (slope,))


def test_the_gaussian_form_lets_ramps_pass_and_charges_curvature_by_its_closed_form():
    slope = torch.tensor([0.3, -0.1, 0.05], dtype=torch.float64)
    ramp = losses.gaussian_density_loss(opacity_is(lambda x: 0.5 + x @ slope), LENGTH)
    assert number(ramp) < 1e-14  # positions are float32: 1e-7, squared
    torch.manual_seed(0)
    bend = losses.gaussian_density_loss(opacity_is(lambda x: 0.1 + 0.1 * (x**2).sum(dim=-1)), LENGTH, points=40000)
    # a_s - a is q l^2 times the mean of 4 chi-square numbers of 3 degrees: mean 3, variance 6 / 4.
    expected = (0.1 * LENGTH**2) ** 2 * (9.0 + 6.0 / 4.0)
    assert number(bend) == pytest.approx(expected, rel=0.03)  # 40000 points: 0.6 % standard deviation


def test_the_printed_losses_of_a_ramp_of_density_are_their_closed_forms():
    slope = torch.tensor([0.3, -0.1, 0.05], dtype=torch.float64)
    ramp = AnalyticVolume(lambda x: 2.0 + x.double() @ slope)
    torch.manual_seed(0)
    # The box is 2 m wide: half of its edge is 1 m, so that density and gradient have the same numbers per metre.
    node = 2.0 / torch.tensor(BOX.counts(losses.NODES))
    variance = number((slope**2 * node**2 / 12.0).sum()) * 7 / 8
    expected = number(torch.exp(slope.abs()).mean()) + math.exp(variance)
    assert number(losses.printed_density_loss(ramp, LENGTH, drawn=2000, points=8)) == pytest.approx(expected, rel=1e-5)
    assert number(losses.gaussian_density_loss(ramp, LENGTH, of=losses.density_per_half)) < 1e-12
    assert number(losses.printed_density_loss(AnalyticVolume(lambda x: torch.full((len(x),), 1e6)), LENGTH)) == 2.0


def test_the_printed_exponential_goes_on_along_its_tangent_and_stays_finite_at_a_wall():
    x = torch.tensor([-1.0, losses.LIMIT, losses.LIMIT + 2.0, 1e9], dtype=torch.float64)
    found = losses.limited_exp(x) / math.exp(losses.LIMIT)
    torch.testing.assert_close(found[:3], torch.tensor([math.exp(-1.0 - losses.LIMIT), 1.0, 3.0], dtype=torch.float64))
    assert math.isfinite(number(losses.printed_density_loss(floor_at(0.0, width=1e-6, density=1e6), LENGTH)))


def test_what_is_not_empty_costs_its_opacity():
    fog = AnalyticVolume(lambda x: torch.full((len(x),), 0.7))
    assert number(losses.empty_loss(fog, LENGTH)) == pytest.approx(1.0 - math.exp(-0.07), rel=1e-5)
    torch.manual_seed(0)
    assert number(losses.empty_loss(floor_at(0.0, density=1e4), LENGTH, points=4000)) == pytest.approx(0.5, abs=0.04)


SWITCHES = [Losses(**{f.name: 1.0, "patch_px": 4}) for f in fields(Losses) if f.name != "patch_px"]


@pytest.fixture
def trained_on():
    """A renderer, paths with colours and priors that disagree with it, what they show of it, and the proxy."""
    torch.manual_seed(0)
    model = AnalyticVolume(lambda x: 6.0 * torch.sigmoid(8.0 * torch.sin(4.0 * x[:, 0] + 3.0 * x[:, 2])))
    renderer = VolumeRenderer(model, background=Backdrop((0.0, 0.0, 0.0)))
    paths, cells = seen_by(looking_down()), Cells.everywhere(BOX, 32)
    paths.rgb = torch.rand(len(paths), 3)
    known = torch.rand(len(paths), COLUMNS)
    known[:, 2], known[:, 3:] = 1.0, torch.nn.functional.normalize(known[:, 3:], dim=1)
    paths.priors = known
    return renderer, paths, renderer.render(paths, cells.samples(paths, 32, jitter=False)), cells


@pytest.mark.parametrize("switch", SWITCHES, ids=str)
def test_each_switch_adds_its_weight_times_its_loss_and_reaches_what_it_should(switch, trained_on):
    renderer, paths, rendered, cells = trained_on
    torch.manual_seed(1)
    once = losses.added_loss(switch, renderer, paths, rendered, cells, None)
    assert math.isfinite(number(once))
    assert number(once) > 0.0
    (gradient,) = torch.autograd.grad(once, [renderer.model.scale])
    assert torch.isfinite(gradient).all()
    assert number(gradient.abs().max()) > 0.0


def test_without_weights_nothing_is_added_and_nothing_drawn(trained_on):
    state = torch.get_rng_state()
    total = losses.added_loss(Losses(), *trained_on, None)
    assert number(total) == 0.0
    assert not total.requires_grad
    assert torch.equal(torch.get_rng_state(), state)
    assert Losses(distortion=0.1).patch == 1
    assert Losses(ssim=0.1).patch == PATCH_PX
    assert Losses(ssim=0.1, patch_px=6).patch == 6


CAMERA = looking_down(size=8)


def stopped_at(s: torch.Tensor, opacity: float = 1.0) -> Rendered:
    """All light of paths (N) stops at one sample of three, the middle one, at lengths (N,)."""
    weights = torch.tensor([0.0, opacity, 0.0], dtype=s.dtype).expand(len(s), 3)
    places = s[:, None] + torch.tensor([-0.5, 0.0, 0.5], dtype=s.dtype)
    return Rendered(torch.zeros(len(s), 3), weights, Samples(places, torch.ones_like(places), places))


def paths_with(**known) -> Paths:
    """All 64 paths of a camera with priors from images of one kind."""
    paths = seen_by(CAMERA)
    rows, columns = np.mgrid[:8, :8]
    paths.priors = PriorImages(**known).at(CAMERA, rows.ravel(), columns.ravel())
    return paths


def test_priors_travel_with_the_pixels_that_they_were_given_for():
    cameras = [CAMERA, looking_down(0.2, size=8)]
    index = np.arange(64.0).reshape(8, 8)
    images = [np.repeat(index[..., None], 3, axis=2).astype(np.uint8)] * 2
    normal = np.broadcast_to([0.0, 0.6, 0.8], (8, 8, 3))
    known = [PriorImages(depth=index), PriorImages(normal=normal)]
    paths = Photographs(cameras, images, [np.arange(64)] * 2, priors=known).draw(200, BOX, np.random.default_rng(0))
    terms, _, normals = prior_columns(paths)
    first = paths.view == 0
    pixel = torch.round(255.0 * paths.rgb[:, 0])
    torch.testing.assert_close(terms[first, 0] / terms[first, 1], pixel[first])
    assert terms[~first].isnan().all()
    assert normals[first].isnan().all()
    assert torch.equal(normals[~first], torch.tensor([0.0, 0.6, 0.8]).expand(int((~first).sum()), 3))


def test_paths_without_priors_carry_no_columns_and_a_loss_on_them_says_so():
    paths = seen_by(CAMERA)
    assert paths.priors.shape == (64, 0)
    assert paths[:3].priors.shape == (3, 0)
    with pytest.raises(ValueError, match="the paths carry no priors"):
        losses.relative_depth_loss(paths, stopped_at(torch.full((64,), 5.0)), 2.0)


def test_wrong_priors_are_refused():
    with pytest.raises(ValueError, match="one size"):
        PriorImages(depth=np.ones((2, 2)), normal=np.ones((2, 3, 3)))


def test_scale_and_shift_of_each_view_are_exact_in_closed_form():
    rng = np.random.default_rng(0)
    view = torch.from_numpy(rng.integers(0, 3, 60)) * 4
    terms = torch.from_numpy(rng.uniform(1.0, 2.0, (60, 2)))
    scales = {0: (2.0, -3.0), 4: (0.1, 40.0), 8: (-1.0, 5.0)}
    wanted = torch.tensor([scales[v] for v in view.tolist()], dtype=torch.float64)
    fit, fitted = losses.fit_views(terms, (terms * wanted).sum(dim=1), view)
    assert fitted.all()
    torch.testing.assert_close(fit, wanted, rtol=1e-9, atol=0.0)  # normal equations square a condition of about 10
    noise = torch.from_numpy(rng.normal(size=60))
    fit, _ = losses.fit_views(terms, noise, view)
    for v in (0, 4, 8):
        oracle = np.linalg.lstsq(terms[view == v].numpy(), noise[view == v].numpy(), rcond=None)[0]
        np.testing.assert_allclose(fit[view == v][0], oracle, rtol=1e-9)


def test_too_few_pixels_or_an_even_depth_are_not_fitted():
    terms = torch.stack([torch.arange(20.0), torch.ones(20)], dim=1)
    assert not losses.fit_views(terms[:7], torch.ones(7), torch.zeros(7, dtype=torch.int64))[1].any()
    assert not losses.fit_views(torch.ones(20, 2), torch.ones(20), torch.zeros(20, dtype=torch.int64))[1].any()
    assert losses.fit_views(terms, torch.ones(20), torch.zeros(20, dtype=torch.int64))[1].all()


@pytest.mark.parametrize("is_inverse", [False, True])
def test_monocular_depth_of_any_scale_and_shift_costs_nothing_where_it_is_true(is_inverse, rng):
    """Of pixels well off the axis, so that depth along it and length along the ray differ."""
    camera = PinholeCamera(CAMERA.centre, CAMERA.cam_from_local, 6.0, 6.0, 4.0, 4.0, 8, 8)
    axial = rng.uniform(3.0, 6.0, (8, 8))
    ahead = camera.directions(camera.pixel_centres()) @ camera.cam_from_local[2]
    stored = 7.0 * (1.0 / axial if is_inverse else axial) - 20.0
    rows, columns = np.mgrid[:8, :8]
    paths = seen_by(camera)
    paths.priors = PriorImages(depth=stored, is_inverse=is_inverse).at(camera, rows.ravel(), columns.ravel())
    length = torch.from_numpy((axial / ahead).ravel())
    assert losses.relative_depth_loss(paths, stopped_at(length), 2.0).item() < 1e-5  # priors are float32
    off = length.clone()
    off[20] += 0.4
    found = losses.relative_depth_loss(paths, stopped_at(off), 2.0).item()
    assert found > 0.4 / 64 / 2.0 * 0.8  # one pixel of 64 off by 0.4 m; the fit takes some of it


def test_the_normal_loss_is_its_equation_in_the_local_frame():
    paths = paths_with(normal=np.broadcast_to([0.0, 0.0, 1.0], (8, 8, 3)))
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(64, 3)
    level = torch.tensor([[1.0, 0.0, 0.0]]).expand(64, 3)
    assert losses.normal_prior_loss(paths, up).item() == 0.0
    assert losses.normal_prior_loss(paths, level).item() == pytest.approx(3.0)


def two_patches(seed: int) -> torch.Tensor:
    return torch.rand(2, 5, 5, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_correlation_is_that_of_a_loop_and_blind_to_gain_and_offset():
    x, y = two_patches(0), two_patches(1)
    total = 0.0
    for patch in range(2):
        for channel in range(3):
            a, b = (v[patch, :, :, channel].numpy().ravel() for v in (x, y))
            cov = np.mean((a - a.mean()) * (b - b.mean()))
            total += 1.0 - (cov + losses.NOISE) / math.sqrt((a.var() + losses.NOISE) * (b.var() + losses.NOISE))
    assert losses.ncc_loss(x, y).item() == pytest.approx(total / 6.0, rel=1e-12)
    assert losses.ncc_loss(x, x).item() == pytest.approx(0.0, abs=1e-15)
    # Blind but for the variance of one grey value against that of the patch, 1/12.
    assert losses.ncc_loss(0.5 * x + 0.2, x).item() == pytest.approx(0.0, abs=12.0 * 4.0 * losses.NOISE)
    assert losses.ncc_loss(-x, x).item() == pytest.approx(2.0, rel=1e-3)


def test_structural_similarity_is_that_of_a_loop_over_windows():
    x, y = two_patches(0), two_patches(1)
    values = []
    for patch in range(2):
        for channel in range(3):
            for row in range(3):
                for column in range(3):
                    window = (slice(row, row + 3), slice(column, column + 3), channel)
                    a, b = (v[patch][window].numpy().ravel() for v in (x, y))
                    cov = np.mean((a - a.mean()) * (b - b.mean()))
                    light = (2.0 * a.mean() * b.mean() + losses.C1) / (a.mean() ** 2 + b.mean() ** 2 + losses.C1)
                    values.append(light * (2.0 * cov + losses.C2) / (a.var() + b.var() + losses.C2))
    assert losses.ssim_loss(x, y).item() == pytest.approx(0.5 * (1.0 - np.mean(values)), rel=1e-10)
    assert losses.ssim_loss(x, x).item() == pytest.approx(0.0, abs=1e-14)


def test_hidden_pixels_count_neither_in_correlation_nor_in_similarity():
    x, y = two_patches(0), two_patches(1)
    shown = torch.ones(2, 5, 5, dtype=torch.float64)
    assert losses.masked_ncc(x, y, shown).item() == pytest.approx(1.0 - losses.ncc_loss(x, y).item())
    assert losses.ssim_loss(x, y, shown).item() == pytest.approx(losses.ssim_loss(x, y).item())
    shown[0, :, 3:], shown[1, 0] = 0.0, 0.0
    total, windows = 0.0, []
    for patch in range(2):
        kept = shown[patch].numpy().astype(bool)
        for channel in range(3):
            a, b = (v[patch, :, :, channel].numpy() for v in (x, y))
            cov = np.mean((a[kept] - a[kept].mean()) * (b[kept] - b[kept].mean()))
            spread = math.sqrt((a[kept].var() + losses.NOISE) * (b[kept].var() + losses.NOISE))
            total += kept.sum() * (cov + losses.NOISE) / spread / 3.0
            for row in range(3):
                for column in range(3):
                    if kept[row : row + 3, column : column + 3].all():
                        window = (slice(patch, patch + 1), slice(row, row + 3), slice(column, column + 3))
                        windows.append(
                            losses.ssim_loss(*(v[window][..., channel : channel + 1] for v in (x, y))).item()
                        )
    assert losses.masked_ncc(x, y, shown).item() == pytest.approx(total / shown.sum().item(), rel=1e-12)
    assert losses.ssim_loss(x, y, shown).item() == pytest.approx(np.mean(windows), rel=1e-10)
    assert losses.ssim_loss(x, y, torch.zeros(2, 5, 5)).item() == 0.0


def test_half_a_patch_is_refused():
    with pytest.raises(ValueError, match="whole patches of 4 x 4 px"):
        losses.as_patches(torch.zeros(24, 3), 4)


def photographs() -> Photographs:
    """Two photographs whose colours tell row, column and view, and the left part of each shows the scene."""
    cameras = [looking_down(), looking_down(0.2)]
    rows, columns = np.mgrid[:24, :24].astype(np.uint8)
    images = [np.stack([rows, columns, np.full_like(rows, view)], axis=-1) for view in range(2)]
    return Photographs(cameras, images, [np.flatnonzero(columns < 11)] * 2)


@pytest.mark.parametrize("size", [1, 3, 4])
def test_patches_are_squares_of_neighbours_row_by_row_inside_what_shows_the_scene(size):
    paths = photographs().draw(300, BOX, np.random.default_rng(0), size)
    seen = torch.round(255.0 * paths.rgb).long().view(300, size, size, 3)
    first = seen[:, :1, :1]
    steps = torch.stack(torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij"), dim=-1)
    assert torch.equal(seen[..., :2] - first[..., :2], steps.expand(300, -1, -1, -1))
    assert torch.equal(seen[..., 2], paths.view.view(300, size, size))
    corners = {tuple(c) for c in first[:, 0, 0, :2].tolist()}
    # All corners that fit, from the first to the last, and none beyond.
    assert {r for r, _ in corners} == set(range(24 - size + 1))
    assert {c for _, c in corners} == set(range(11 - size + 1))


def test_patches_larger_than_what_shows_the_scene_are_refused():
    with pytest.raises(ValueError, match="12 x 12 px; draw smaller patches"):
        photographs().draw(1, BOX, np.random.default_rng(0), 12)


@pytest.mark.parametrize("water", [None, WATER])
def test_virtual_paths_pass_their_points_at_their_lengths_and_bend_as_a_camera_there_sees_them(water):
    camera = looking_down(0.7, 0.2)
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.9, 0.9, (576, 3)).astype(np.float32))
    centres = torch.from_numpy(camera.centre.astype(np.float32)).expand(576, 3)
    moved, length = losses.paths_through(centres, points, water, seen_by(looking_down(), water), BOX)
    torch.testing.assert_close(moved.at(length[:, None])[:, 0], points, rtol=0.0, atol=5e-6)  # float32, 6 m
    pixels = camera.project(points.double().numpy(), water)
    np.testing.assert_allclose(moved.air.numpy(), camera.directions(pixels), atol=5e-6)
    assert ((moved.near <= length) & (length <= moved.far)).all()


def test_virtual_patches_of_a_floor_look_like_those_photographed_and_of_other_texture_they_do_not():
    floor = VolumeRenderer(floor_at(-0.2, width=0.002, density=1000.0))
    paths, cells = seen_by(looking_down(), WATER), Cells.everywhere(BOX, 16)
    rendered = floor.render(paths, cells.samples(paths, 256, jitter=False))
    values = []
    for seen in (rendered.rgb.detach(), 0.5 * rendered.rgb.detach() + 0.2, torch.rand(len(paths), 3)):
        torch.manual_seed(0)
        paths.rgb = seen
        values.append(losses.virtual_patch_loss(floor, paths, rendered, cells, WATER, 4).item())
    # Correlation is blind to gain and offset, similarity is not; noise has next to none of either: (1 - 0)^2 + 1.
    assert values[0] < 0.1
    assert values[0] < values[1] < 0.7
    assert values[2] > 1.5


def test_points_that_a_virtual_view_cannot_see_are_left_out():
    paths, cells = seen_by(looking_down(), None), Cells.everywhere(BOX, 16)
    renderer = VolumeRenderer(floor_at(0.0))
    rendered = renderer.render(paths, cells.samples(paths, 64, jitter=False))
    assert losses.virtual_view(renderer, paths, rendered, cells, None)[1].float().mean() > 0.9
    # Weights moved 0.6 m below the floor: every virtual view stops at the floor before it.
    rendered.samples.edges += 0.6
    assert not losses.virtual_view(renderer, paths, rendered, cells, None)[1].any()
    rendered.weights.data.zero_()
    assert not losses.virtual_view(renderer, paths, rendered, cells, None)[1].any()
