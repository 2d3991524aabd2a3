"""Priors: carried from images to paths, their losses in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from analytic_volume import BOX, WATER, floor_at, looking_down, seen_by

from fields.volume.losses import (
    fit_views,
    normal_prior_loss,
    relative_depth_loss,
)
from fields.volume.paths import Paths
from fields.volume.photographs import COLUMNS, Photographs, PriorImages, prior_columns
from fields.volume.renderer import Rendered, VolumeRenderer
from fields.volume.sampling import Cells, Samples
from refract import PinholeCamera

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
        relative_depth_loss(paths, stopped_at(torch.full((64,), 5.0)), 2.0)


def test_wrong_priors_are_refused():
    with pytest.raises(ValueError, match="one size"):
        PriorImages(depth=np.ones((2, 2)), normal=np.ones((2, 3, 3)))


def test_scale_and_shift_of_each_view_are_exact_in_closed_form():
    rng = np.random.default_rng(0)
    view = torch.from_numpy(rng.integers(0, 3, 60)) * 4
    terms = torch.from_numpy(rng.uniform(1.0, 2.0, (60, 2)))
    scales = {0: (2.0, -3.0), 4: (0.1, 40.0), 8: (-1.0, 5.0)}
    wanted = torch.tensor([scales[v] for v in view.tolist()], dtype=torch.float64)
    fit, fitted = fit_views(terms, (terms * wanted).sum(dim=1), view)
    assert fitted.all()
    torch.testing.assert_close(fit, wanted, rtol=1e-9, atol=0.0)  # normal equations square a condition of about 10
    noise = torch.from_numpy(rng.normal(size=60))
    fit, _ = fit_views(terms, noise, view)
    for v in (0, 4, 8):
        oracle = np.linalg.lstsq(terms[view == v].numpy(), noise[view == v].numpy(), rcond=None)[0]
        np.testing.assert_allclose(fit[view == v][0], oracle, rtol=1e-9)


def test_too_few_pixels_or_an_even_depth_are_not_fitted():
    terms = torch.stack([torch.arange(20.0), torch.ones(20)], dim=1)
    assert not fit_views(terms[:7], torch.ones(7), torch.zeros(7, dtype=torch.int64))[1].any()
    assert not fit_views(torch.ones(20, 2), torch.ones(20), torch.zeros(20, dtype=torch.int64))[1].any()
    assert fit_views(terms, torch.ones(20), torch.zeros(20, dtype=torch.int64))[1].all()


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
    assert relative_depth_loss(paths, stopped_at(length), 2.0).item() < 1e-5  # priors are float32
    off = length.clone()
    off[20] += 0.4
    found = relative_depth_loss(paths, stopped_at(off), 2.0).item()
    assert found > 0.4 / 64 / 2.0 * 0.8  # one pixel of 64 off by 0.4 m; the fit takes some of it


def test_the_normal_loss_is_its_equation_in_the_local_frame():
    paths = paths_with(normal=np.broadcast_to([0.0, 0.0, 1.0], (8, 8, 3)))
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(64, 3)
    level = torch.tensor([[1.0, 0.0, 0.0]]).expand(64, 3)
    assert normal_prior_loss(paths, up).item() == 0.0
    assert normal_prior_loss(paths, level).item() == pytest.approx(3.0)


def test_normals_of_a_floor_agree_with_a_prior_that_points_up():
    paths, cells = seen_by(looking_down(), WATER), Cells.everywhere(BOX, 32)
    renderer = VolumeRenderer(floor_at(0.0))
    depth = renderer.render(paths, cells.samples(paths, 64, jitter=False)).depth
    normals = renderer.model.normals(paths.at(depth[:, None])[:, 0], 0.03)
    paths.priors = torch.full((len(paths), COLUMNS), math.nan)
    paths.priors[:, 3:] = torch.tensor([0.0, 0.0, 1.0])
    assert normal_prior_loss(paths, normals).item() < 1e-4  # differences of float32 densities
