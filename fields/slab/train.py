"""Training of the tensor field inside the bound that the sweep left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from fields.device import Device, half_the_threads
from fields.slab.rays import Slab, SlabRays, draw_rays
from fields.slab.tensor_field import FieldSettings, TensorField
from fields.sweep.maps import Sources
from fields.training import Rates, adam, descend, has_converged, psnr_db, set_rates
from fields.water_column import WaterColumn

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
