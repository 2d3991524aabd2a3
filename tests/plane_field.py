"""Fields over the analytic plane of `plane_survey`: photographs in colour, height maps that are right or displaced."""

from __future__ import annotations

import numpy as np
import torch
from plane_survey import PlaneBed, texture

from fields.device import Device
from fields.image_store import GAMMA
from fields.slab.rays import Slab, SlabRays, rays_of
from fields.slab.tensor_field import FieldSettings, TensorField
from fields.sweep.maps import HeightMap, Sources
from fields.water_column import WaterColumn
from refract import PinholeCamera

ABSORPTION = np.array([0.3, 0.07, 0.05])  # 1/m


def plane_sources(
    bed: PlaneBed, cameras: list[PinholeCamera], *, shift: float = 0.0, noise: float = 0.0, seed: int = 0
) -> Sources:
    """Colour photographs of a bed through absorbing water, with maps of its true heights plus a shift and noise [m]."""
    rng = np.random.default_rng(seed)
    maps, images = [], []
    for view, camera in enumerate(cameras):
        path = camera.paths(camera.pixel_centres(), bed.water)
        height = bed.true_height(camera)
        points = path.at_height(height, bed.water)
        paint = np.stack([texture(points[..., 0], points[..., 1], seed=s) for s in (3, 4, 5)], axis=-1)
        light = np.clip(0.35 + 0.25 * paint / 128.0, 0.02, 1.0)
        if bed.water is not None:
            falls = -(path.water_direction @ np.array(bed.water.up))
            light = light * np.exp(-(np.clip(-height, 0.0, None) / falls)[..., None] * ABSORPTION)
        images.append(np.clip(np.round(255.0 * light ** (1.0 / GAMMA)), 0, 255).astype(np.uint8))
        ones = np.ones(height.shape, dtype=np.float32)
        found = (height + shift + noise * rng.standard_normal(height.shape)).astype(np.float32)
        maps.append(HeightMap(view, found, ones, np.full(height.shape, 3, dtype=np.uint8), 0.005 * ones))
    return Sources(cameras, maps, images, bed.water)


def level_slab(height: float, *, half: float = 0.1, slope_x: float = 0.0) -> Slab:
    """A slab about the proxy height + slope_x x over the water plane, [m]: 80 x 80 cells of 0.1 m about the origin."""
    x = 0.1 * (np.arange(80) - 39.5)
    proxy = np.tile((height + slope_x * x).astype(np.float32), (80, 1))
    return Slab(np.array([-4.0, -4.0]), 0.1, proxy, np.ones(proxy.shape, dtype=bool), half)


def rays_at(bed: PlaneBed, camera: PinholeCamera, height, *, step: int = 7) -> SlabRays:
    """Rays through every ``step``-th pixel of a camera, standing at a height [m], grey."""
    pixels = camera.pixel_centres()[::step, ::step].reshape(-1, 2)
    heights = np.zeros(len(pixels), dtype=np.float32) + np.asarray(height, dtype=np.float32)
    return rays_of(camera, bed.water, pixels, heights, np.full((len(pixels), 3), 128, dtype=np.uint8))


def field_over(
    slab: Slab, device: Device, *, seed: int = 0, water: bool = True, given: dict | None = None, **settings
) -> TensorField:
    """An untrained field, the same for the same seed; ``given`` is what is known of the water."""
    torch.manual_seed(seed)
    return TensorField(slab, FieldSettings(**settings), device, WaterColumn(**(given or {})) if water else None)
