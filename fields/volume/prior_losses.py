"""Losses from prior knowledge: lengths with a spread, monocular depth, monocular normals."""

from __future__ import annotations

import torch
from torch import Tensor

from fields.volume.paths import Paths
from fields.volume.priors import Priors
from fields.volume.renderer import Rendered

# Scale and shift of a photograph are fitted to at least this many paths of a batch; to two, any depth fits.
MIN_FITTED = 8
# A path meets a surface if its opacity exceeds this.
MIN_OPACITY = 0.5


def length_loss(paths: Paths, rendered: Rendered) -> Tensor:
    """Weights off the path length that the sweep or structure from motion gives, robustly.

        mean over paths of  sum_i w_i rho((s_i - length) / spread) + (1 - sum_i w_i) rho((far - length) / spread)
        rho(e) = log(1 + e^2 / 2)

    The form of DS-NeRF (Deng et al. 2022), which holds the weights of a path and not their mean alone to the depth of a
    point, with the logarithm of a Cauchy density instead of a normal one: priors have outliers. It vanishes where all
    light stops at the prior.
    """
    priors = Priors.of(paths.priors)
    known = torch.isfinite(priors.length) & torch.isfinite(priors.spread)
    length, spread = priors.length[known, None], priors.spread[known, None]
    weights, s = rendered.weights[known], rendered.samples.s[known]
    stopped = (weights * _cauchy((s - length) / spread)).sum(dim=1)
    passed = (1.0 - weights.sum(dim=1)) * _cauchy((paths.far[known, None] - length) / spread)[:, 0]
    return _mean(stopped + passed)


def relative_depth_loss(paths: Paths, rendered: Rendered, edge: float) -> Tensor:
    """Mean departure of mean path lengths from monocular depth, in edges of the box.

    Scale and shift of each photograph are those of least squares in this batch (as in MonoSDF, Yu et al. 2022,
    equation 12), found in closed form; no gradient flows through them. Depth is taken along the bent path: the
    refraction of a view straight down is an affine map of depth, which the fit absorbs.
    """
    priors = Priors.of(paths.priors)
    seen = rendered.opacity.detach() > MIN_OPACITY
    known = torch.isfinite(priors.terms).all(dim=1) & seen
    terms, power, view = priors.terms[known], priors.power[known], paths.view[known]
    length = mean_length(rendered)[known]
    target = length**power
    scale_shift, fitted = fit_views(terms, target.detach(), view)
    departure = (target - (terms * scale_shift).sum(dim=1)) * length.detach() ** (1.0 - power)
    return _mean(departure[fitted].abs()) / edge


def normal_prior_loss(paths: Paths, normals: Tensor) -> Tensor:
    """Mean of ``|n - prior|_1 + 1 - n . prior`` over paths with a prior (MonoSDF, Yu et al. 2022, equation 13)."""
    prior = Priors.of(paths.priors).normal
    known = torch.isfinite(prior).all(dim=1)
    n, prior = normals[known], prior[known]
    return _mean((n - prior).abs().sum(dim=1) + 1.0 - (n * prior).sum(dim=1))


def mean_length(rendered: Rendered) -> Tensor:
    """Mean path length (N,) [m] of the light that stops."""
    return (rendered.weights * rendered.samples.s).sum(dim=1) / rendered.opacity.clamp(min=1e-6)


def fit_views(terms: Tensor, target: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
    """Least squares of ``target = a terms[0] + b terms[1]`` for each view, by its normal equations in float64.

    Parameters
    ----------
    terms, target, view : (N, 2), (N,), (N,) int64

    Returns
    -------
    (a, b) : (N, 2)
        Of the view of each row, dtype of `target`.
    fitted : (N,) bool
        The view has enough rows, and they separate scale from shift.
    """
    views, index = torch.unique(view, return_inverse=True)
    t, y = terms.double(), target.double()
    products = torch.stack([t[:, 0] ** 2, t[:, 0] * t[:, 1], t[:, 1] ** 2, t[:, 0] * y, t[:, 1] * y], dim=1)
    xx, xc, cc, xy, cy = torch.zeros(len(views), 5, dtype=torch.float64).index_add(0, index, products).unbind(1)
    determinant = xx * cc - xc**2
    # The priors are float32: a determinant under their rounding, squared, is none.
    solved = determinant > 1e-12 * xx * cc
    solved &= torch.bincount(index, minlength=len(views)) >= MIN_FITTED
    determinant = torch.where(solved, determinant, 1.0)
    fit = torch.stack([(cc * xy - xc * cy) / determinant, (xx * cy - xc * xy) / determinant], dim=1)
    return fit[index].to(target.dtype), solved[index]


def _cauchy(e: Tensor) -> Tensor:
    return torch.log1p(0.5 * e**2)


def _mean(values: Tensor) -> Tensor:
    """Mean of values (N,), 0 where there are none."""
    return values.sum() / max(len(values), 1)
