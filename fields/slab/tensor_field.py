"""The multi-scale tensor field inside the slab: features, heads and water, rendering along bent rays, training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from fields.compositing import (
    MIN_COLOUR_WEIGHT,
    composite,
    log_transmittance,
    quantile_height,
    render_weights,
    with_opaque_end,
)
from fields.device import Device, half_the_threads
from fields.factors import Factors, anisotropic_grids
from fields.heads import ColourHead, DensityHead
from fields.image_store import as_stored
from fields.slab.rays import Slab, SlabRays, draw_rays
from fields.sweep.maps import Sources
from fields.training import Rates, adam, descend, has_converged, psnr_db, set_rates
from fields.water_column import WaterColumn


@dataclass(frozen=True)
class FieldSettings:
    """Grid and heads of a field."""

    # scales, channels: L and n_f of the paper
    scales: int = 4
    channels: int = 4
    coarsening: float = 8.0  # Cells of the coarsest scale over those of the finest, which measure one GSD
    # Per ray, inside the slab: the paper's sampling within +-s of the proxy surface. Fewer than 100, so that one at
    # least is heavy enough for a colour; others raise ValueError.
    samples: int = 8

    def __post_init__(self):
        if not 2 <= self.samples < 1.0 / MIN_COLOUR_WEIGHT:
            raise ValueError(f"a field has {self.samples} samples per ray, expected 2 to 99")


class TensorField(nn.Module):
    """Density and colour inside a slab about the bed's proxy.

    Vectors run along zeta, planes lie in x and y: in the thin slab other directions add nothing. The raw density
    moves the bed: signed distance = zeta - half * tanh(raw), with a Laplace law of learned width, so that the middle of
    a ray's weights is the bed and a field of zero the proxy. The bed is matt. (A box of any content, with three
    directions and colours that depend on the view: `fields.volume`.) ``column`` is the water over the bed, None for a
    dry survey.
    """

    def __init__(self, slab: Slab, settings: FieldSettings, device: Device, column: WaterColumn | None):
        super().__init__()
        self.slab, self.settings = slab, settings
        cell = np.array([slab.cell, slab.cell, slab.half / 4.0])
        grids = anisotropic_grids(slab.size, cell, settings.coarsening, settings.scales)
        shape = (settings.scales, 1, settings.channels)
        self.factors = Factors(grids, "z", settings.channels, device)
        self.density = DensityHead(*shape, device=device)
        self.colour = ColourHead(*shape)
        self.column = column
        # Half a cell: tails that reach a face of the slab pull the bed away from it.
        self.log_width = nn.Parameter(torch.log(torch.tensor(0.5 * slab.cell, dtype=torch.float32)))

    def _features(self, position: Tensor, zeta: Tensor) -> Tensor:
        """Features (samples, ...) at positions (..., 3) [m], zeta (...) [m] over the proxy."""
        return self.factors(self.slab.box_coordinates(position[..., :2], zeta).view(-1, 3))

    def _thickness(self, features: Tensor, zeta: Tensor) -> Tensor:
        """Density times length (rays, samples) of the intervals, from the features (samples,) at their middles.

        ``zeta`` (rays, samples + 1) [m] are the heights of their ends over the proxy.
        """
        raw = self.density(features).view(len(zeta), -1)
        lift, width = self.slab.half * torch.tanh(raw), self.log_width.exp()
        start = log_transmittance(zeta[:, :-1] - lift, width)
        end = log_transmittance(zeta[:, 1:] - lift, width)
        # What the tail of the law takes above the slab counts to the first sample, so that the middle stays the bed.
        start = torch.cat([torch.zeros_like(start[:, :1]), start[:, 1:]], dim=1)
        return (start - end).clamp(min=0.0)

    def intervals(self, rays: SlabRays, jitter: bool) -> Tensor:
        """Heights (rays, samples + 1) [m] of the intervals' ends, downwards through the slab about each ray's proxy."""
        n = self.settings.samples
        step = 2.0 * self.slab.half / n
        ends = self.slab.half - step * torch.arange(n + 1, dtype=torch.float32)
        shift = (torch.rand(len(rays), 1) - 0.5) * step if jitter else torch.zeros(len(rays), 1)
        return rays.height[:, None] + ends + shift

    def weigh(self, rays: SlabRays, *, jitter: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Weights (rays, samples), interval ends (rays, samples + 1) [m] and features (rays * samples, ...)."""
        ends = self.intervals(rays, jitter)
        z = _middles(ends)
        zeta = ends - self.slab.height_at(rays.at(ends)[..., :2].reshape(-1, 2)).view_as(ends)
        features = self._features(rays.at(z), _middles(zeta))
        weights = render_weights(self._thickness(features, zeta))
        # The bed is opaque: light that passed the slab's lower end met it there.
        return with_opaque_end(weights), ends, features

    def render(self, rays: SlabRays, *, jitter: bool, dry: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Colours (rays, 3) as stored in photographs, weights (rays, samples) and interval ends (rays, samples + 1).

        ``dry`` leaves out what the water does to the light.
        """
        weights, ends, features = self.weigh(rays, jitter=jitter)
        z = _middles(ends)
        radiance = composite(weights, lambda where: self.colour(features[where], None))
        if self.column is not None and not dry:
            bed = (weights.detach() * z).sum(dim=1)
            depth = (-bed).clamp(min=0.0)
            path_length = self.column.path_length(depth, depth * rays.wet.norm(dim=1))
            # Light of dry ground crosses no surface.
            radiance = self.column(radiance, path_length, torch.where(bed < 0.0, rays.reflectance, 0.0))
        return as_stored(radiance), weights, ends

    @torch.no_grad()
    def heights(self, rays: SlabRays) -> tuple[Tensor, Tensor]:
        """Median height [m] of each ray's weights, and half the distance between their 16 and 84 % heights [m]."""
        weights, ends, _ = self.weigh(rays, jitter=False)
        low, high = quantile_height(weights, ends, 0.84), quantile_height(weights, ends, 0.16)
        return quantile_height(weights, ends), 0.5 * (high - low).abs()

    @torch.no_grad()
    def render_surface(self, rays: SlabRays, up: Tensor, *, dry: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Colours (rays, 3) as stored in photographs, median heights (rays,) [m] and upward unit normals (rays, 3).

        ``up`` (3,) is the normal of the water plane, along which heights count.
        """
        colour, weights, ends = self.render(rays, jitter=False, dry=dry)
        height = quantile_height(weights, ends)
        return colour, height, self._normals(rays.at(height), height, up)

    def _normals(self, position: Tensor, z: Tensor, up: Tensor) -> Tensor:
        """Unit normals (N, 3) of the bed, local, at positions (N, 3) [m] on it, z (N,) [m] over the water plane.

        The gradient of the signed distance, by central differences of half a cell to each side, over which the
        features are linear.
        """
        step = 0.5 * self.slab.cell
        along_x, along_y = (step * torch.eye(3)[axis] for axis in (0, 1))
        gradient = (self._above(position, z + step) - self._above(position, z - step))[:, None] * up
        gradient[:, 0] += self._above(position + along_x, z) - self._above(position - along_x, z)
        gradient[:, 1] += self._above(position + along_y, z) - self._above(position - along_y, z)
        return nn.functional.normalize(gradient, dim=1)

    def _above(self, position: Tensor, z: Tensor) -> Tensor:
        """Signed distance (N,) [m], positive above the bed."""
        zeta = z - self.slab.height_at(position[:, :2])
        raw = self.density(self._features(position, zeta))
        return zeta - self.slab.half * torch.tanh(raw)


def _middles(ends: Tensor) -> Tensor:
    return 0.5 * (ends[:, 1:] + ends[:, :-1])


# Rays are drawn for this many steps at once.
POOL_STEPS = 64
# The share of the steps that train colours alone, with the bed fixed at its proxy: it would follow colours that are
# still wrong. These groups of parameters move it.
COLOUR_FIRST = 0.3
MOVE_THE_BED = ("density", "width")
# Learning rates fall to this share of their start.
FINAL_RATE = 0.05
# The paper switches from coarse to fine where the variance of the loss over 100 steps falls under 1 % of that of the
# first 100.
SWITCH_WINDOW, SWITCH_RATIO = 100, 0.01
# Rays of a step: the more, the larger the slab, and fewer where there are not enough for this many steps.
BATCH, LARGE_BATCH, SMALL_BATCH, LARGE_SLAB = 16384, 65536, 2048, 500_000
MIN_STEPS = 3 * SWITCH_WINDOW


@dataclass(frozen=True)
class Schedule:
    """Schedule of the training: steps and learning rates."""

    rays_per_cell: float  # Rays drawn per known cell of the slab, over the whole training
    # factors, heads, density, width: Learning rates of Adam at the start; all fall to a twentieth
    factors: float = 0.02
    heads: float = 0.002
    density: float = 0.005
    width: float = 0.005


@dataclass(frozen=True)
class FieldFigures:
    """Figures reported about the training of a field."""

    # steps, rays: Steps, and the rays of all of them
    steps: int
    rays: int
    switched_at: int | None  # Step at which the fine density took over from the coarse one
    psnr_db: float  # Of the photographs, over the last steps
    width_m: float  # Of the bed: of the Laplace law of its density
    parameters: int


@half_the_threads()
def train(
    sources: Sources,
    slab: Slab,
    settings: FieldSettings,
    schedule: Schedule,
    device: Device,
    progress: Callable[[float], None],
) -> tuple[TensorField, FieldFigures]:
    """A field fitted to the photographs inside the slab, and the figures of its training.

    Raises
    ------
    ValueError
        If no pixel with a trusted height looks into the slab.
    """
    torch.manual_seed(0)
    column = None if sources.water is None else WaterColumn(sources.absorption, sources.veil)
    field = TensorField(slab, settings, device, column)
    steps, batch = _steps(schedule.rays_per_cell, int(slab.known.sum()))
    optimiser = adam(_rates(field, schedule), eps=1e-12)
    losses, switched = [], None
    for step, rays in enumerate(_batches(sources, slab, batch, steps)):
        done = step / steps
        set_rates(optimiser, _rate_at(done), held=MOVE_THE_BED if done < COLOUR_FIRST else ())
        colour, _, _ = field.render(rays, jitter=True)
        loss = ((colour - rays.rgb) ** 2).mean()
        descend(optimiser, loss)
        losses.append(float(loss.detach()))
        if switched is None and step > COLOUR_FIRST * steps and has_converged(losses, SWITCH_WINDOW, SWITCH_RATIO):
            field.density.switch_to_fine()
            switched = step
        progress((step + 1) / steps)
    return field, FieldFigures(
        steps=steps,
        rays=steps * batch,
        switched_at=switched,
        psnr_db=psnr_db(losses[-POOL_STEPS:]),
        width_m=float(field.log_width.detach().exp()),
        parameters=sum(p.numel() for p in field.parameters()),
    )


def _steps(rays_per_cell: float, known: int) -> tuple[int, int]:
    """Steps, and rays of each, for a number of known cells."""
    total = rays_per_cell * known
    batch = LARGE_BATCH if known >= LARGE_SLAB else BATCH
    batch = min(batch, max(int(np.ceil(total / MIN_STEPS)), SMALL_BATCH))
    return max(int(np.ceil(total / batch)), MIN_STEPS), batch


def _rates(field: TensorField, schedule: Schedule) -> list[Rates]:
    column = [] if field.column is None else list(field.column.parameters())
    return [
        Rates([field.factors.planes, field.factors.vectors], schedule.factors, "factors"),
        Rates(list(field.density.parameters()), schedule.density, "density"),
        Rates([*field.colour.parameters(), *column], schedule.heads, "heads"),
        Rates([field.log_width], schedule.width, "width"),
    ]


def _rate_at(done: float) -> float:
    """Factor of the learning rates at a share of the training: 1 while colours are trained alone, then it decays."""
    return FINAL_RATE ** max(0.0, (done - COLOUR_FIRST) / (1.0 - COLOUR_FIRST))


def _batches(sources: Sources, slab: Slab, batch: int, steps: int) -> Iterator[SlabRays]:
    """Rays of each step."""
    rng = np.random.default_rng(0)
    drawn = 0
    while drawn < steps:
        count = min(POOL_STEPS, steps - drawn)
        pool = draw_rays(sources, slab, count * batch, rng)
        parts = torch.from_numpy(rng.permutation(len(pool))).tensor_split(min(count, len(pool)))
        for part in parts:
            yield pool[part]
        drawn += len(parts)
