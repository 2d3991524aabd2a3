"""Training of the tensor field inside the bound that the sweep left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from fields.device import Device
from fields.slab.grid import Slab
from fields.slab.rays import Rays, rays_of
from fields.slab.tensor_field import FieldSettings, TensorField
from fields.sweep.bed import trusted
from fields.sweep.sources import Sources
from fields.sweep.sweep import DepthMap
from fields.threads import half_the_threads
from fields.water_column import WaterColumn
from refract import FlatWater, PinholeCamera

# A ray belongs to the slab's bed where the sweep's own height lies this deep inside the slab, in halves of it.
INSIDE = 0.7
# Rays are drawn for this many steps at once.
POOL_STEPS = 64
# The share of the steps that colours alone learn, with the bed held at its proxy; later it would follow wrong colours.
COLOUR_FIRST = 0.3
# The paper switches from coarse to fine where the variance of the loss over 100 steps falls under 1 % of that of the
# first 100.
SWITCH_WINDOW, SWITCH_RATIO = 100, 0.01
# Rays of a step: the more, the larger the slab, and fewer where there are not enough for this many steps.
BATCH, LARGE_BATCH, SMALL_BATCH, LARGE_SLAB = 16384, 65536, 2048, 500_000
MIN_STEPS = 3 * SWITCH_WINDOW


@dataclass(frozen=True)
class Schedule:
    """How long and how fast.

    Attributes
    ----------
    rays_per_cell : float
        Rays drawn per known cell of the slab, over the whole training.
    factors, heads, density, width : float
        Learning rates of Adam at the start; all fall to a twentieth.
    """

    rays_per_cell: float
    factors: float = 0.02
    heads: float = 0.002
    density: float = 0.005
    width: float = 0.005


def slab_of(sources: Sources, gsd: float, area: tuple[float, float, float, float] | None) -> Slab:
    """The slab about the trusted heights inside an area (x0, y0, x1, y1) [m], local: cells of one GSD.

    Its half is two cells, or three times the median spread of the heights where that is more.

    Raises
    ------
    ValueError
        If no trusted height lies inside the area.
    """
    xy, heights, spreads = [], [], []
    for camera, depth_map in zip(sources.cameras, sources.maps, strict=True):
        keep = trusted(depth_map)[: camera.height, : camera.width]
        height = depth_map.height[: camera.height, : camera.width][keep]
        points = camera.paths(camera.pixel_centres()[keep], sources.water).at_height(
            height.astype(np.float64), sources.water
        )
        inside = np.ones(len(points), dtype=bool)
        if area is not None:
            inside = (points[:, :2] > area[:2]).all(axis=1) & (points[:, :2] < area[2:]).all(axis=1)
        xy.append(points[inside, :2])
        heights.append(height[inside])
        spreads.append(depth_map.spread[: camera.height, : camera.width][keep][inside])
    if not sum(len(h) for h in heights):
        raise ValueError("no confirmed height lies inside the area: there is nothing to train a field about")
    spread = float(np.median(np.concatenate(spreads)))
    return Slab.of_points(np.concatenate(xy), np.concatenate(heights), gsd, max(2.0 * gsd, 3.0 * spread))


@half_the_threads()
def train(
    sources: Sources,
    slab: Slab,
    settings: FieldSettings,
    schedule: Schedule,
    device: Device,
    progress: Callable[[float], None],
) -> tuple[TensorField, dict]:
    """A field fitted to the photographs inside the slab.

    Returns
    -------
    field : TensorField
    figures : dict
        Steps, rays, the step of the switch from coarse to fine density, PSNR [dB] over the last pool, and the width
        of the bed [m].

    Raises
    ------
    ValueError
        If no pixel with a trusted height looks into the slab.
    """
    torch.manual_seed(0)
    column = None if sources.water is None else WaterColumn(sources.absorption, sources.veil)
    field = TensorField(slab, settings, device, column)
    steps, batch = _steps(schedule.rays_per_cell, int(slab.known.sum()))
    groups = [
        {"params": [field.factors.planes, field.factors.vectors], "top": schedule.factors},
        {"params": list(field.density.parameters()), "top": schedule.density},
        {"params": _colour_parameters(field), "top": schedule.heads},
        {"params": [field.log_width], "top": schedule.width},
    ]
    optimiser = torch.optim.Adam([{**g, "lr": g["top"]} for g in groups], betas=(0.9, 0.99), eps=1e-12, fused=True)
    losses, switched = [], None
    for step, rays in enumerate(_batches(sources, slab, batch, steps)):
        _set_rates(optimiser, step / steps)
        colour, _, _ = field.render(rays, jitter=True)
        loss = ((colour - rays.rgb) ** 2).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
        if switched is None and step > COLOUR_FIRST * steps and _has_settled(losses):
            field.density.switch_to_fine()
            switched = step
        progress((step + 1) / steps)
    mse = float(np.mean(losses[-POOL_STEPS:]))
    figures = {
        "steps": steps,
        "rays": steps * batch,
        "switched_at": switched,
        "psnr_db": -10.0 * np.log10(mse),
        "width_m": float(field.log_width.detach().exp()),
        "parameters": sum(p.numel() for p in field.parameters()),
    }
    return field, figures


def _steps(rays_per_cell: float, known: int) -> tuple[int, int]:
    """Steps, and rays of each, for a number of known cells."""
    total = rays_per_cell * known
    batch = LARGE_BATCH if known >= LARGE_SLAB else BATCH
    batch = min(batch, max(int(np.ceil(total / MIN_STEPS)), SMALL_BATCH))
    return max(int(np.ceil(total / batch)), MIN_STEPS), batch


def _colour_parameters(field: TensorField) -> list:
    column = [] if field.column is None else list(field.column.parameters())
    return [*field.colour.parameters(), *column]


def _set_rates(optimiser, done: float) -> None:
    """Learning rates at a share of the training: full for the first part, then falling to a twentieth."""
    fall = 0.05 ** max(0.0, (done - COLOUR_FIRST) / (1.0 - COLOUR_FIRST))
    for index, group in enumerate(optimiser.param_groups):
        moves_bed = index in (1, 3)
        group["lr"] = 0.0 if moves_bed and done < COLOUR_FIRST else group["top"] * fall


def _has_settled(losses: list[float]) -> bool:
    if len(losses) < 2 * SWITCH_WINDOW:
        return False
    return np.var(losses[-SWITCH_WINDOW:]) < SWITCH_RATIO * np.var(losses[:SWITCH_WINDOW])


def _batches(sources: Sources, slab: Slab, batch: int, steps: int) -> Iterator[Rays]:
    rng = np.random.default_rng(0)
    given = 0
    while given < steps:
        count = min(POOL_STEPS, steps - given)
        pool = draw_rays(sources, slab, count * batch, rng)
        parts = torch.from_numpy(rng.permutation(len(pool))).tensor_split(min(count, len(pool)))
        for part in parts:
            yield pool[part]
        given += len(parts)


def draw_rays(sources: Sources, slab: Slab, count: int, rng: np.random.Generator) -> Rays:
    """Rays through ``count`` pixels with a trusted height, drawn evenly over the views; those that the slab holds.

    Raises
    ------
    ValueError
        If the slab holds none.
    """
    share = sum(len(p) for p in sources.pixels)
    parts = []
    for camera, depth_map, image, pixels in zip(
        sources.cameras, sources.maps, sources.images, sources.pixels, strict=True
    ):
        if len(pixels) == 0:
            continue
        drawn = pixels[rng.integers(0, len(pixels), round(count * len(pixels) / share))]
        rows, columns = np.divmod(drawn, depth_map.height.shape[1])
        parts.append(slab_rays(camera, depth_map, image, sources.water, slab, rows, columns)[0])
    if not sum(len(p) for p in parts):
        raise ValueError("no pixel with a confirmed height looks into the slab: there is nothing to train a field from")
    return Rays.concatenate(parts)


def slab_rays(
    camera: PinholeCamera,
    depth_map: DepthMap,
    image: np.ndarray,
    water: FlatWater | None,
    slab: Slab,
    rows: np.ndarray,
    columns: np.ndarray,
) -> tuple[Rays, np.ndarray]:
    """Rays through pixels whose own height lies inside the slab, set on the proxy; and which of the pixels they are."""
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1)
    own = depth_map.height[rows, columns]
    rays = rays_of(camera, water, pixels, own, image[rows, columns])
    xy = rays.at(rays.height)[:, :2]
    rays.height = rays.meet(slab)
    held = (rays.height - torch.from_numpy(own)).abs() < INSIDE * slab.half
    held &= slab.holds(xy)
    return rays[held], held.numpy()
