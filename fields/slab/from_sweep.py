"""Slab and training rays from the height maps of the sweep."""

from __future__ import annotations

import numpy as np
import torch

from fields.slab.rays import Rays, rays_of
from fields.slab.slab import Slab
from fields.sweep.maps import HeightMap, Sources, trusted
from refract import FlatWater, PinholeCamera

# A ray is used if the sweep's height lies within this share of the slab's half thickness from its middle.
INSIDE = 0.7


def slab_of(sources: Sources, gsd: float, area: tuple[float, float, float, float] | None) -> Slab:
    """The slab about the trusted heights inside an area (x0, y0, x1, y1) [m], local: cells of one GSD.

    Its half is two cells, or three times the median spread of the heights where that is more.

    Raises
    ------
    ValueError
        If no trusted height lies inside the area.
    """
    xy, heights, spreads = [], [], []
    for camera, height_map in zip(sources.cameras, sources.maps, strict=True):
        keep = trusted(height_map)[: camera.height, : camera.width]
        height = height_map.height[: camera.height, : camera.width][keep]
        points = camera.paths(camera.pixel_centres()[keep], sources.water).at_height(
            height.astype(np.float64), sources.water
        )
        inside = np.ones(len(points), dtype=bool)
        if area is not None:
            inside = (points[:, :2] > area[:2]).all(axis=1) & (points[:, :2] < area[2:]).all(axis=1)
        xy.append(points[inside, :2])
        heights.append(height[inside])
        spreads.append(height_map.spread[: camera.height, : camera.width][keep][inside])
    if not sum(len(h) for h in heights):
        raise ValueError("no confirmed height lies inside the area: there is nothing to train a field about")
    spread = float(np.median(np.concatenate(spreads)))
    return Slab.of_points(np.concatenate(xy), np.concatenate(heights), gsd, max(2.0 * gsd, 3.0 * spread))


def draw_rays(sources: Sources, slab: Slab, count: int, rng: np.random.Generator) -> Rays:
    """Rays through ``count`` pixels with a trusted height, drawn evenly over the views; those that the slab holds.

    Raises
    ------
    ValueError
        If the slab holds none.
    """
    share = sum(len(p) for p in sources.pixels)
    parts = []
    for camera, height_map, image, pixels in zip(
        sources.cameras, sources.maps, sources.images, sources.pixels, strict=True
    ):
        if len(pixels) == 0:
            continue
        drawn = pixels[rng.integers(0, len(pixels), round(count * len(pixels) / share))]
        rows, columns = np.divmod(drawn, height_map.height.shape[1])
        parts.append(slab_rays(camera, height_map, image, sources.water, slab, rows, columns)[0])
    if not sum(len(p) for p in parts):
        raise ValueError("no pixel with a confirmed height looks into the slab: there is nothing to train a field from")
    return Rays.concatenate(parts)


def slab_rays(
    camera: PinholeCamera,
    height_map: HeightMap,
    image: np.ndarray,
    water: FlatWater | None,
    slab: Slab,
    rows: np.ndarray,
    columns: np.ndarray,
) -> tuple[Rays, np.ndarray]:
    """Rays through pixels whose own height lies inside the slab, set on the proxy; and which of the pixels they are."""
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1)
    own = height_map.height[rows, columns]
    rays = rays_of(camera, water, pixels, own, image[rows, columns])
    xy = rays.at(rays.height)[:, :2]
    rays.height = rays.meet(slab)
    held = (rays.height - torch.from_numpy(own)).abs() < INSIDE * slab.half
    held &= slab.holds(xy)
    return rays[held], held.numpy()
