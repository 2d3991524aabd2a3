"""The survey grid: a thin slab about the proxy of the bed, in coordinates sheared by the proxy's height.

    zeta = z - h0(x, y)      z over the water plane, h0 the proxy; the slab is |zeta| <= half

A product of a plane and a vector can hardly describe a bed whose height varies over metres; in sheared coordinates it
does so almost exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor


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
