"""A thin layer about a known bed, in sheared coordinates, in which a field is trained in place of a box.

    zeta = z - h0(x, y),  |zeta| <= half      h0: height of the bed, a raster

A product of a plane and a vector can hardly describe a bed whose height varies over metres; in sheared coordinates it
does so almost exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import binary_closing, distance_transform_edt, maximum_filter
from torch import Tensor

from fields.volume.paths import Box, Paths

# Unknown cells with known ones on two sides, each this near, count as known: the field knows them from its coarser
# scales, and they would be black specks in a view.
GAP_CELLS = 4
STRIDE = 8  # Cells that a path passes at once where all of the bed below lies lower
LEAST_FALL = 1e-3  # Descent per metre of path, at least: flatter ones leave the survey before they reach the bed
MEETING_STEPS = 4  # Steps from a point near the bed to where the path meets it
REFINEMENTS = 3  # Steps of the false position inside the cell in which a path meets the bed: to a thousandth of it


@dataclass(frozen=True)
class Layer(Box):
    """A layer of constant thickness about a raster of heights; its corners are those of a box about all of it."""

    height: np.ndarray  # (rows, columns) float32 [m], local z of the bed at cell centres; rows go up in y
    known: np.ndarray  # (rows, columns) bool: cells in which the bed was found; others have the height of the nearest
    half: float  # [m]: half the thickness

    @staticmethod
    def of_points(points: np.ndarray, cell: float, half: float) -> Layer:
        """The layer about points (N, 3) [m] of a bed: their median height per cell of a side [m]."""
        low = points[:, :2].min(axis=0) - cell
        columns, rows = np.ceil((points[:, :2].max(axis=0) + cell - low) / cell).astype(int)
        index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
        key = index[:, 1] * columns + index[:, 0]
        order = np.lexsort((points[:, 2], key))
        key, z = key[order], points[order, 2]
        begin = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
        end = np.r_[begin[1:], len(key)]
        height = np.full(rows * columns, np.nan, dtype=np.float32)
        height[key[begin]] = 0.5 * (z[(begin + end - 1) // 2] + z[(begin + end) // 2])
        height = height.reshape(rows, columns)
        known = np.isfinite(height)
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
        high = low + cell * np.array([columns, rows])
        corners = np.append(low, height.min() - half), np.append(high, height.max() + half)
        # Known cells, and gaps between them up to twice `GAP_CELLS` wide.
        across = np.arange(-GAP_CELLS, GAP_CELLS + 1)
        disc = np.add.outer(across**2, across**2) <= GAP_CELLS**2
        known |= binary_closing(np.pad(known, GAP_CELLS), disc)[(slice(GAP_CELLS, -GAP_CELLS),) * 2]
        return Layer(*corners, height, known, half)

    @property
    def size(self) -> np.ndarray:
        """Extent (3,) [m] of the layer along x, y and zeta."""
        return np.append(self.high[:2] - self.low[:2], 2.0 * self.half)

    @property
    def cell(self) -> float:
        """Side of a cell of the raster [m]."""
        return float(self.size[0]) / self.height.shape[1]

    def unit(self, x: Tensor) -> Tensor:
        """Coordinates (..., 3) in [0, 1] along x, y and zeta, of positions (..., 3) [m]."""
        return self.unit_at(x, self.above(x))

    def unit_at(self, x: Tensor, zeta: Tensor) -> Tensor:
        """The same of positions (..., 3) [m] at zeta (...) [m]."""
        return torch.cat([self._plan(x), (zeta / (2.0 * self.half) + 0.5)[..., None]], dim=-1)

    def above(self, x: Tensor) -> Tensor:
        """zeta (...) [m] of positions (..., 3) [m]; heights are bilinear between cell centres."""
        u = self._plan(x).reshape(1, -1, 1, 2) * 2.0 - 1.0
        height = torch.nn.functional.grid_sample(
            self._raster.to(x.device), u, mode="bilinear", padding_mode="border", align_corners=False
        )
        return x[..., 2] - height.view(x.shape[:-1])

    def holds(self, x: Tensor) -> Tensor:
        """Whether positions (N, 3) [m] lie over or under a known cell, (N,) bool."""
        u = self._plan(x)
        inside = ((u >= 0.0) & (u < 1.0)).all(dim=1)
        return inside & _at_cell(torch.from_numpy(self.known).to(x.device), u)

    def clipped(self, paths: Paths) -> Paths:
        """The paths between the faces of the layer about where each first comes down to a known cell of the bed."""
        return self.about(paths, self._meeting(paths))

    def about(self, paths: Paths, s: Tensor) -> Paths:
        """The paths between the faces of the layer about path lengths s (N,) [m] at which they meet the bed."""
        meets = (s < paths.far) & self.holds(paths.at(s[:, None])[:, 0])
        reach = self.half / self.fall(paths, s)
        return replace(paths, near=torch.where(meets, s - reach, 0.0), far=torch.where(meets, s + reach, 0.0))

    @staticmethod
    def fall(paths: Paths, s: Tensor) -> Tensor:
        """Descent (N,) per metre of path at path lengths s (N,) [m]."""
        return (-paths.direction(s[:, None])[:, 0, 2]).clamp(min=LEAST_FALL)

    def meeting_near(self, x: Tensor, direction: Tensor) -> Tensor:
        """Lengths (N,) [m] from positions (N, 3) near the bed along directions (N, 3) to where these meet the raster.

        The steps converge where the bed is less steep than the direction; the first is whole, the others are halved.
        """
        length = torch.zeros(len(x), dtype=x.dtype, device=x.device)
        for share in (1.0, *(0.5,) * (MEETING_STEPS - 1)):
            zeta = self.above(x + length[:, None] * direction)
            length = length + share * zeta / (-direction[:, 2]).clamp(min=LEAST_FALL)
        return length

    def _meeting(self, paths: Paths) -> Tensor:
        """Path lengths (N,) [m] at which paths first come down to the raster; at least `far` where they do not.

        Steps pass one cell, so that the first of several meetings is found unless a bump is narrower than a cell; many
        at once where nothing reaches up to the path.
        """
        level = torch.maximum(paths.air[:, :2].norm(dim=1), paths.wet[:, :2].norm(dim=1))
        count = max(int(torch.ceil(((paths.far - paths.near) * level).max() / self.cell)), 1) if len(paths) else 1
        step = (paths.far - paths.near) / count
        s, is_clear = paths.near.clone(), torch.ones(len(paths), dtype=torch.bool, device=paths.near.device)
        for number in range(STRIDE, count, STRIDE):
            there = paths.near + number * step
            x = paths.at(there[:, None])[:, 0]
            is_clear &= x[:, 2] > _at_cell(self._ceiling.to(x.device), self._plan(x))
            s = torch.where(is_clear, there, s)
        pending = torch.arange(len(paths), device=s.device)
        moving: tuple[Tensor, ...] = (paths.origin, paths.air, paths.wet, paths.crossing)
        while len(pending):
            there = s[pending] + step[pending]
            is_above = self.above(_along(moving, there)) > 0.0
            s[pending[is_above]] = there[is_above]
            goes_on = is_above & (there < paths.far[pending])
            pending, moving = pending[goes_on], tuple(v[goes_on] for v in moving)
        return self._refined(paths, s, s + step)

    def _refined(self, paths: Paths, before: Tensor, after: Tensor) -> Tensor:
        """Where paths pass the raster between two path lengths (N,) [m], by the false position."""
        ends = paths.at(torch.stack([before, after], dim=1))
        over, under = self.above(ends).unbind(dim=1)
        s = before
        for _ in range(REFINEMENTS):
            s = before + (after - before) * (over / (over - under).clamp(min=1e-9)).clamp(0.0, 1.0)
            zeta = self.above(paths.at(s[:, None])[:, 0])
            is_over = zeta > 0.0
            before, over = torch.where(is_over, s, before), torch.where(is_over, zeta, over)
            after, under = torch.where(is_over, after, s), torch.where(is_over, under, zeta)
        return s

    def _plan(self, x: Tensor) -> Tensor:
        low, size = (torch.as_tensor(v[:2], dtype=x.dtype, device=x.device) for v in (self.low, self.size))
        return (x[..., :2] - low) / size

    @cached_property
    def _raster(self) -> Tensor:
        return torch.from_numpy(self.height)[None, None]

    @cached_property
    def _ceiling(self) -> Tensor:
        """(rows, columns) [m]: greatest height within a stride of a cell's middle; a cell more, for interpolation."""
        return torch.from_numpy(maximum_filter(self.height, size=2 * (STRIDE + 1) + 1, mode="nearest"))


def _along(parts: tuple[Tensor, ...], s: Tensor) -> Tensor:
    """Positions (N, 3) at path lengths s (N,): `Paths.at`, of the four parts of paths that it needs."""
    origin, air, wet, crossing = parts
    dry = torch.minimum(s, crossing)
    return origin + dry[:, None] * air + (s - dry)[:, None] * wet


def _at_cell(raster: Tensor, u: Tensor) -> Tensor:
    """Values (N,) of a raster (rows, columns) in the cells of coordinates u (N, 2), the nearest one outside of it."""
    rows, columns = raster.shape
    index = (u * torch.tensor([columns, rows], device=u.device)).floor().long()
    return raster.view(-1)[index[:, 1].clamp(0, rows - 1) * columns + index[:, 0].clamp(0, columns - 1)]
