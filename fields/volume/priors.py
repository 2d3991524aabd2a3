"""Priors of pixels: a distance with its std, monocular depth, a normal.

On paths (N, 8), NaN where unknown: length [m], its spread [m], two terms and a power of monocular depth, normal (3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refract import PinholeCamera

COLUMNS = 8


@dataclass(frozen=True)
class PriorImages:
    """Priors of the pixels (height, width) of one photograph; None for a kind that it does not have.

    Raises
    ------
    ValueError
        If shapes differ, or a length comes without a spread.
    """

    # length, spread (height, width) float [m]: path length from the camera to the surface, in air and water together,
    # and its standard deviation: of the sweep, or of points of structure from motion. NaN where none.
    length: np.ndarray | None = None
    spread: np.ndarray | None = None
    # (height, width) float: monocular depth along the camera's axis, true up to a scale and a shift; NaN where none
    depth: np.ndarray | None = None
    is_inverse: bool = False  # `depth` holds the inverse of depth instead (disparity), true up to a scale and a shift
    # (height, width, 3) float: unit normals towards the camera, local frame; NaN where none
    normal: np.ndarray | None = None

    def __post_init__(self):
        if (self.length is None) != (self.spread is None):
            raise ValueError("a prior of length needs its spread, and a spread its length; got one of them")
        shapes = {np.shape(v)[:2] for v in (self.length, self.spread, self.depth, self.normal) if v is not None}
        if len(shapes) > 1:
            raise ValueError(f"expected priors of one size (height, width), got {sorted(shapes)}")

    def at(self, camera: PinholeCamera, rows: np.ndarray, columns: np.ndarray) -> Tensor:
        """Priors (N, 8) of pixels at rows and columns (N,) of the camera."""
        found = np.full((len(rows), COLUMNS), np.nan, dtype=np.float32)
        if self.length is not None and self.spread is not None:
            found[:, 0], found[:, 1] = self.length[rows, columns], self.spread[rows, columns]
        if self.depth is not None:
            ahead = camera.directions(np.stack([columns + 0.5, rows + 0.5], axis=-1)) @ camera.cam_from_local[2]
            # depth = a m + b along the axis is length = a m / ahead + b / ahead along the ray; its inverse likewise.
            per_axis = ahead if self.is_inverse else 1.0 / ahead
            found[:, 2], found[:, 3] = self.depth[rows, columns] * per_axis, per_axis
            found[:, 4] = -1.0 if self.is_inverse else 1.0
        if self.normal is not None:
            found[:, 5:] = self.normal[rows, columns]
        return torch.from_numpy(found)


@dataclass(frozen=True)
class Priors:
    """Priors of paths (N), NaN where unknown."""

    # length, spread: (N,) [m]
    length: Tensor
    spread: Tensor
    # (N, 2): ``a terms[0] + b terms[1]`` is the path length to ``power`` for the scale and shift a, b of the photograph
    terms: Tensor
    power: Tensor  # (N,): 1 for depth, -1 for inverse depth
    normal: Tensor  # (N, 3) unit, local frame

    @staticmethod
    def of(columns: Tensor) -> Priors:
        """The columns (N, 8) of paths by name.

        Raises
        ------
        ValueError
            If the paths carry no priors.
        """
        if columns.shape[1] != COLUMNS:
            raise ValueError(
                "a loss on priors has a weight, but the paths carry no priors; give Photographs its `priors`, or take "
                "the weight away"
            )
        return Priors(columns[:, 0], columns[:, 1], columns[:, 2:4], columns[:, 4], columns[:, 5:])
