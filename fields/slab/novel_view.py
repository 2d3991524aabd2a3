"""Views of a trained field, through the water or without it, and its heights at the pixels that become points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import binary_closing, maximum_filter
from torch import Tensor

from fields.device import half_the_threads
from fields.image_based import NovelView
from fields.slab.rays import Slab, SlabRays, rays_of, slab_rays
from fields.slab.tensor_field import TensorField
from fields.sweep.maps import HeightMap
from refract import FlatWater, PinholeCamera

CHUNK = 65536
# A ray that falls less than this per metre leaves the survey before it reaches the bed.
MIN_FALL = 1e-3
# Bisections of the last step of one cell: to a thousandth of a cell.
HALVINGS = 10
# Steps skipped at once where all of the bed below lies lower.
STRIDE = 8
# Unknown cells with known ones on two sides, each this near, are shown.
GAP_CELLS = 4


@half_the_threads()
def render_view(field: TensorField, camera: PinholeCamera, water: FlatWater | None, *, dry: bool = False) -> NovelView:
    """The field as a camera sees it, in the water of its survey or, `dry`, with the water taken away.

    Without water rays are straight, and nothing is absorbed, scattered or reflected.
    """
    pixels = camera.pixel_centres().reshape(-1, 2)
    # An index of one keeps the plane that heights count from.
    optics = replace(water, n_water=1.0) if dry and water is not None else water
    path = camera.paths(pixels, optics)
    normal = np.array(water.up if water is not None else (0.0, 0.0, 1.0))
    falling = np.flatnonzero(path.air_direction @ normal < -MIN_FALL)
    shape = (camera.height, camera.width)
    rgb = np.zeros((len(pixels), 3), dtype=np.uint8)
    height, distance = (np.full(len(pixels), np.nan, dtype=np.float32) for _ in range(2))
    normals = np.full((len(pixels), 3), np.nan, dtype=np.float32)
    surface = SlabSurface.of_slab(field.slab)
    for first in range(0, len(falling), CHUNK):
        part = falling[first : first + CHUNK]
        none = np.zeros(len(part), dtype=np.float32)
        rays = rays_of(camera, optics, pixels[part], none, np.zeros((len(part), 3)))
        rays, on_surface = rays_on(surface, rays)
        if len(rays) == 0:
            continue
        part = part[on_surface]
        colour, found, upright = field.render_surface(rays, torch.as_tensor(normal, dtype=torch.float32), dry=dry)
        rgb[part] = np.round(255.0 * colour.clamp(max=1.0).numpy()).astype(np.uint8)
        height[part], normals[part] = found.numpy(), upright.numpy()
        distance[part] = _distance(rays, found, camera.centres(pixels[part]))
    return NovelView(rgb.reshape(*shape, 3), height.reshape(shape), distance.reshape(shape), normals.reshape(*shape, 3))


def _distance(rays: SlabRays, height: Tensor, centre: np.ndarray) -> np.ndarray:
    """Length of the paths down to heights, [m]: in water from the foot, in air from the camera's centre."""
    wet = (-height).clamp(min=0.0) * rays.wet.norm(dim=1)
    crossing = rays.at(height.clamp(min=0.0)) - torch.as_tensor(centre, dtype=torch.float32)
    return (wet + crossing.norm(dim=1)).numpy()


@dataclass(frozen=True)
class SlabSurface:
    """The proxy of a slab, made ready for rays to come down on."""

    slab: Slab  # Its gaps are known
    # (rows, columns) float32 [m]: greatest height of the proxy within a stride of a cell's middle, along each axis
    ceiling: np.ndarray

    @staticmethod
    def of_slab(slab: Slab) -> SlabSurface:
        """The surface of a slab, without gaps up to twice `GAP_CELLS` wide.

        The field knows gaps from its coarser scales, and they would be black specks in a view.
        """
        across = np.arange(-GAP_CELLS, GAP_CELLS + 1)
        disc = np.add.outer(across**2, across**2) <= GAP_CELLS**2
        known = slab.known | binary_closing(np.pad(slab.known, GAP_CELLS), disc)[(slice(GAP_CELLS, -GAP_CELLS),) * 2]
        # One cell more: heights between cells take from both.
        ceiling = maximum_filter(slab.proxy, size=2 * (STRIDE + 1) + 1, mode="nearest")
        return SlabSurface(replace(slab, known=known), ceiling)

    def clear_of(self, position: Tensor) -> Tensor:
        """Height (N,) [m] over which no proxy is met within a stride of positions (N, 2) [m]."""
        index = torch.floor((position - torch.as_tensor(self.slab.low, dtype=torch.float32)) / self.slab.cell).long()
        rows, columns = self.ceiling.shape
        flat = index[:, 1].clamp(0, rows - 1) * columns + index[:, 0].clamp(0, columns - 1)
        return torch.from_numpy(self.ceiling).view(-1)[flat]


def rays_on(surface: SlabSurface, rays: SlabRays) -> tuple[SlabRays, np.ndarray]:
    """The rays that come down on a known cell of the slab, at the height where they first do; and which they are.

    Each is followed down from above the highest cell in steps that pass one cell, so that it finds the first of several
    meetings unless a bump is narrower than a cell; many steps at once where nothing reaches up to it.
    """
    slab = surface.slab
    top = float(slab.proxy[slab.known].max()) + slab.half
    bottom = float(slab.proxy[slab.known].min()) - slab.half
    steepest = float(torch.maximum(rays.air.abs(), rays.wet.abs())[:, :2].max())
    count = int(np.ceil((top - bottom) / (slab.cell / max(steepest, 1.0))))
    step = (top - bottom) / count
    above = _strides(surface, rays, top, step, count)
    pending = torch.arange(len(rays))
    marching = rays
    while len(pending) > 0:
        z = above[pending] - step
        under = z <= slab.height_at(marching.at(z)[:, :2])
        above[pending[~under]] = z[~under]
        active = ~under & (z > bottom)
        pending, marching = pending[active], marching[active]
    for halving in range(1, HALVINGS + 1):
        z = above - step * 0.5**halving
        above = torch.where(z > slab.height_at(rays.at(z)[:, :2]), z, above)
    found = (above > bottom) & slab.holds(rays.at(above)[:, :2])
    rays = rays[found]
    rays.height = above[found]
    return rays, found.numpy().nonzero()[0]


def _strides(surface: SlabSurface, rays: SlabRays, top: float, step: float, count: int) -> Tensor:
    """Heights (N,) [m] down to which rays pass nothing, in strides of many steps from the top."""
    above = torch.full((len(rays),), top)
    clear = torch.ones(len(rays), dtype=torch.bool)
    for index in range(STRIDE, count, STRIDE):
        z = torch.full((len(rays),), top - index * step)
        clear &= z > surface.clear_of(rays.at(z)[:, :2])
        above = torch.where(clear, z, above)
    return above


@half_the_threads()
def refine(
    field: TensorField,
    camera: PinholeCamera,
    height_map: HeightMap,
    image: np.ndarray,
    water: FlatWater | None,
    keep: np.ndarray,
) -> tuple[np.ndarray, int]:
    """Heights of a map with those of the kept pixels taken from the field: the median of the weights along each ray.

    A pixel whose own height lies outside the slab (another surface passes there) or that the field would move out of
    it keeps the sweep's height.

    Returns
    -------
    height : (height, width) float32 [m] over the water plane
    moved : int
        Number of pixels that took the field's height.
    """
    height = height_map.height.copy()
    rows, columns = np.nonzero(keep)
    moved = 0
    for first in range(0, len(rows), CHUNK):
        r, c = rows[first : first + CHUNK], columns[first : first + CHUNK]
        rays, held = slab_rays(camera, height_map, image, water, field.slab, (r, c))
        if len(rays) == 0:
            continue
        heights, _ = field.heights(rays)
        found = heights.numpy()
        inside = np.abs(found - height[r[held], c[held]]) < field.slab.half
        height[r[held][inside], c[held][inside]] = found[inside]
        moved += int(inside.sum())
    return height, moved
