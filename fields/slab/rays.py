"""The survey grid, a thin slab about the proxy of the bed in sheared coordinates, and its training rays.

    zeta = z - h0(x, y)      z over the water plane, h0 the proxy; the slab is |zeta| <= half

A product of a plane and a vector can hardly describe a bed whose height varies over metres; in sheared coordinates it
does so almost exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from fields.sweep.maps import HeightMap, Sources, trusted
from refract import FlatWater, PinholeCamera, fresnel_coefficients

# A ray meets the proxy where these many steps along it converge, from the height that the sweep or the bound gives.
MEETING_STEPS = 4
# A ray is used if the sweep's height lies within this share of the slab's half thickness from its middle.
INSIDE = 0.7


@dataclass
class Slab:
    """A raster of proxy heights with its box."""

    low: np.ndarray  # (2,) [m], local x and y of the raster's corner
    cell: float  # [m]
    # (rows, columns) float32 [m]: height of the bed over the water plane at cell centres; rows go up in y
    proxy: np.ndarray
    known: np.ndarray  # (rows, columns) bool: cells that the sweep found; the others were filled from the nearest
    half: float  # [m]: half the thickness

    @staticmethod
    def of_points(xy: np.ndarray, height: np.ndarray, cell: float, half: float) -> Slab:
        """Median height per cell of points (N, 2), (N,); holes take the height of the nearest cell."""
        low = xy.min(axis=0) - cell
        columns, rows = np.ceil((xy.max(axis=0) + cell - low) / cell).astype(int)
        index = np.floor((xy - low) / cell).astype(np.int64)
        key = index[:, 1] * columns + index[:, 0]
        order = np.lexsort((height, key))
        key, height = key[order], height[order]
        begin = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
        end = np.r_[begin[1:], len(key)]
        proxy = np.full(rows * columns, np.nan, dtype=np.float32)
        proxy[key[begin]] = 0.5 * (height[(begin + end - 1) // 2] + height[(begin + end) // 2])
        proxy = proxy.reshape(rows, columns)
        known = np.isfinite(proxy)
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        return Slab(low, cell, proxy[tuple(nearest)], known, half)

    @property
    def size(self) -> np.ndarray:
        """Extent of the box along x, y and zeta [m]."""
        rows, columns = self.proxy.shape
        return np.array([columns * self.cell, rows * self.cell, 2.0 * self.half])

    def box_coordinates(self, xy: Tensor, zeta: Tensor) -> Tensor:
        """u (..., 3) in [0, 1] of the box from local x, y (..., 2) [m] and zeta (...) [m]."""
        low = torch.as_tensor(self.low, dtype=torch.float32)
        size = torch.as_tensor(self.size, dtype=torch.float32)
        return torch.cat([(xy - low) / size[:2], (zeta[..., None] + self.half) / size[2]], dim=-1)

    def height_at(self, xy: Tensor) -> Tensor:
        """Proxy height (N,) [m] at local x, y (N, 2), bilinear between cell centres."""
        u = self.box_coordinates(xy, torch.zeros(len(xy)))[:, :2] * 2.0 - 1.0
        image = torch.from_numpy(self.proxy)[None, None]
        return torch.nn.functional.grid_sample(
            image, u[None, :, None], mode="bilinear", padding_mode="border", align_corners=False
        )[0, 0, :, 0]

    def holds(self, xy: Tensor) -> Tensor:
        """Whether local x, y (N, 2) [m] lie in a known cell, (N,) bool."""
        index = torch.floor((xy - torch.as_tensor(self.low, dtype=torch.float32)) / self.cell).long()
        rows, columns = self.proxy.shape
        inside = (index >= 0).all(dim=1) & (index[:, 0] < columns) & (index[:, 1] < rows)
        flat = (index[:, 1] * columns + index[:, 0]).clamp(0, rows * columns - 1)
        return inside & torch.from_numpy(self.known).view(-1)[flat]


@dataclass
class SlabRays:
    """Rays (N) through the slab, torch float32, local frame.

    A path is at ``foot + (z - tide) * slope`` at height z over the water plane, with one slope above and one below the
    water of its photograph.
    """

    # foot, air, wet: (N, 3) [m], [m per m], [m per m]
    foot: Tensor
    air: Tensor
    wet: Tensor
    height: Tensor  # (N,) [m]: where the ray meets the proxy
    rgb: Tensor  # (N, 3): Photograph, 0 to 1, as stored (not linear)
    reflectance: Tensor  # (N,): fresnel reflectance at the water; 0 for a dry survey
    tide: Tensor  # (N,) [m]: how high the water of the photograph is over the plane, along its normal

    def __len__(self) -> int:
        return len(self.height)

    def __getitem__(self, index) -> SlabRays:
        return SlabRays(*(getattr(self, field.name)[index] for field in fields(SlabRays)))

    @staticmethod
    def concatenate(parts: list[SlabRays]) -> SlabRays:
        """Rays of several views in one."""
        return SlabRays(*(torch.cat([getattr(p, field.name) for p in parts]) for field in fields(SlabRays)))

    def slope(self, z: Tensor) -> Tensor:
        """Change of position per metre of height (..., 3), for heights z (N, ...) [m]."""
        shape = (len(self),) + (1,) * (z.dim() - 1) + (3,)
        return torch.where((self._own(z) < 0.0)[..., None], self.wet.view(shape), self.air.view(shape))

    def at(self, z: Tensor) -> Tensor:
        """Positions (N, ..., 3) [m] at heights z (N, ...) [m] over the water plane."""
        shape = (len(self),) + (1,) * (z.dim() - 1) + (3,)
        return self.foot.view(shape) + self._own(z)[..., None] * self.slope(z)

    def _own(self, z: Tensor) -> Tensor:
        """Heights z (N, ...) [m] over the water of the photographs."""
        return z - self.tide.view((len(self),) + (1,) * (z.dim() - 1))

    def meet(self, slab: Slab) -> Tensor:
        """Heights (N,) [m] at which the rays meet the proxy, by fixed-point steps from `height`.

        The steps contract where the proxy is less steep than the ray.
        """
        z = slab.height_at(self.at(self.height)[:, :2])
        for _ in range(MEETING_STEPS - 1):
            z = 0.5 * (z + slab.height_at(self.at(z)[:, :2]))
        return z


def rays_of(
    camera: PinholeCamera, water: FlatWater | None, pixels: np.ndarray, height: np.ndarray, rgb: np.ndarray
) -> SlabRays:
    """Rays through pixel positions (N, 2) [px], starting at heights (N,) [m], with colours (N, 3) uint8."""
    path = camera.paths(pixels, water)
    normal = np.array(water.up if water else (0.0, 0.0, 1.0))
    plane = np.array(water.point if water else (0.0, 0.0, 0.0))
    plane[2] += camera.tide
    along_normal = path.air_direction @ normal
    centre = camera.centres(pixels)
    foot = centre - path.air_direction * (((centre - plane) @ normal) / along_normal)[:, None]
    air = path.air_direction / along_normal[:, None]
    along_normal_wet = path.water_direction @ normal
    wet = path.water_direction / along_normal_wet[:, None]
    reflectance = np.zeros(len(pixels))
    if water is not None:
        reflectance = fresnel_coefficients(-along_normal, n_from=1.0, n_to=water.n_water).reflectance
    tide = np.full(len(pixels), camera.tide * normal[2])
    columns = (foot, air, wet, height, rgb / 255.0, reflectance, tide)
    return SlabRays(*(torch.as_tensor(np.ascontiguousarray(c), dtype=torch.float32) for c in columns))


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
        raise ValueError("no confirmed height lies inside the area: a field has nothing to train on")
    spread = float(np.median(np.concatenate(spreads)))
    return Slab.of_points(np.concatenate(xy), np.concatenate(heights), gsd, max(2.0 * gsd, 3.0 * spread))


def draw_rays(sources: Sources, slab: Slab, count: int, rng: np.random.Generator) -> SlabRays:
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
        parts.append(slab_rays(camera, height_map, image, sources.water, slab, (rows, columns))[0])
    if not sum(len(p) for p in parts):
        raise ValueError("no pixel with a confirmed height looks into the slab: a field has nothing to train on")
    return SlabRays.concatenate(parts)


def slab_rays(
    camera: PinholeCamera,
    height_map: HeightMap,
    image: np.ndarray,
    water: FlatWater | None,
    slab: Slab,
    places: tuple[np.ndarray, np.ndarray],
) -> tuple[SlabRays, np.ndarray]:
    """Rays through pixels whose own height lies inside the slab, set on the proxy; and which of the pixels they are.

    ``places`` are rows and columns of the pixels.
    """
    rows, columns = places
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1)
    own = height_map.height[rows, columns]
    rays = rays_of(camera, water, pixels, own, image[rows, columns])
    xy = rays.at(rays.height)[:, :2]
    rays.height = rays.meet(slab)
    held = (rays.height - torch.from_numpy(own)).abs() < INSIDE * slab.half
    held &= slab.holds(xy)
    return rays[held], held.numpy()
