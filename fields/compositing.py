"""Volume rendering along bent rays: from the thickness of samples to weights, and from weights to height and colour."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

# Colour is looked up only where a sample matters (MDW-NeRF).
MIN_COLOUR_WEIGHT = 1e-2


def log_transmittance(distance: Tensor, width: Tensor) -> Tensor:
    """Logarithm of the share of light that comes down to a signed distance [m], positive above the bed.

    The share is the Laplace distribution function, ``1 - exp(-d / width) / 2`` above the bed and ``exp(d / width) / 2``
    below it, so that the density tends to 1 / width inside, as in VolSDF. There that function is the density itself,
    which puts the middle of the weights 0.34 widths under the bed; here (as in NeuS) it lies on the bed, for any width.
    """
    above = torch.log1p(-0.5 * torch.exp(-distance.clamp(min=0.0) / width))
    return above + distance.clamp(max=0.0) / width


def render_weights(thickness: Tensor) -> Tensor:
    """Weights w_i = T_i (1 - exp(-thickness_i)) of samples (rays, samples), in the order of travel.

    ``thickness`` is the density times the length of each sample, and T_i what those before it let pass. Weights sum to
    at most 1; what is missing passed through.
    """
    # Not the sum less the sample's own: of an opaque sample rounding would leave nothing of those before it.
    before = nn.functional.pad(torch.cumsum(thickness[:, :-1], dim=1), (1, 0))
    return torch.exp(-before) * -torch.expm1(-thickness)


def with_opaque_end(weights: Tensor, meets: Tensor | float = 1.0) -> Tensor:
    """Weights (rays, samples) whose last sample takes all light that passes the others: every ray ends there.

    ``meets`` (rays, 1) is zero for rays that meet nothing at all.
    """
    remaining = (1.0 - weights[:, :-1].sum(dim=1, keepdim=True)) * meets
    return torch.cat([weights[:, :-1], remaining], dim=1)


def composite(weights: Tensor, radiance_of: Callable[[Tensor], Tensor], opacity: Tensor | None = None) -> Tensor:
    """Linear radiance (rays, 3) of samples with weights (rays, samples), times the opacity (rays, 1), 1 where None.

    ``radiance_of`` gives the colours (n, 3) of the samples at flat indices (n,). Samples too light to be looked up take
    the others' colour: left black, they would push a bed about, and darken what is thin. Of many samples half their
    mean weight counts, so that light fog has a colour, too.
    """
    least = min(MIN_COLOUR_WEIGHT, 0.5 / weights.shape[1])
    painted = weights.detach() > least
    where = painted.view(-1).nonzero()[:, 0]
    colours = weights.new_zeros(weights.numel(), 3).index_put((where,), radiance_of(where)).view(*weights.shape, 3)
    share = weights * painted
    total = share.sum(dim=1, keepdim=True)
    share = share / total if opacity is None else share * (opacity / total.clamp(min=least))
    return (share[..., None] * colours).sum(dim=1)


def quantile_height(weights: Tensor, edges: Tensor, level: float = 0.5) -> Tensor:
    """Height [m] at which the accumulated weight of each ray passes a level of its total; linear inside an interval.

    Parameters
    ----------
    weights : (rays, samples)
    edges : (rays, samples + 1) [m]
        Heights of the intervals' ends, in the order of travel.
    """
    total = torch.cumsum(weights, dim=1)
    target = level * total[:, -1:]
    index = (total < target).sum(dim=1, keepdim=True).clamp(max=weights.shape[1] - 1)
    weight = weights.gather(1, index)
    before = total.gather(1, index) - weight
    share = ((target - before) / weight.clamp(min=1e-12)).clamp(0.0, 1.0)
    start, end = edges.gather(1, index), edges.gather(1, index + 1)
    return (start + share * (end - start))[:, 0]
