"""The photographs that a volume is trained from, the paths drawn through them, and priors of their pixels.

Priors are monocular depth and a normal. On paths (N, 6), NaN where unknown: two terms and a power of depth, normal (3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import minimum_filter
from torch import Tensor

from fields.volume.layer import Layer
from fields.volume.paths import Box, Paths, Rays, paths_of
from refract import PinholeCamera, WaterSurface

COLUMNS = 6
COARSE = 128  # Pixels along the longer side of a picture that tell whether a box may be in it


@dataclass(frozen=True)
class PriorImages:
    """Priors of the pixels (height, width) of one photograph; None for a kind that it does not have.

    Raises ValueError if shapes differ.
    """

    # (height, width) float: monocular depth along the camera's axis, true up to a scale and a shift; NaN where none
    depth: np.ndarray | None = None
    is_inverse: bool = False  # `depth` holds the inverse of depth instead (disparity), true up to a scale and a shift
    # (height, width, 3) float: unit normals towards the camera, local frame; NaN where none
    normal: np.ndarray | None = None

    def __post_init__(self):
        shapes = {np.shape(v)[:2] for v in (self.depth, self.normal) if v is not None}
        if len(shapes) > 1:
            raise ValueError(f"expected priors of one size (height, width), got {sorted(shapes)}")

    def at(self, camera: PinholeCamera, rows: np.ndarray, columns: np.ndarray) -> Tensor:
        """Priors (N, 6) of pixels at rows and columns (N,) of the camera."""
        found = np.full((len(rows), COLUMNS), np.nan, dtype=np.float32)
        if self.depth is not None:
            cosine = camera.directions(np.stack([columns + 0.5, rows + 0.5], axis=-1)) @ camera.cam_from_local[2]
            # depth = a m + b along the axis is length = a m / ahead + b / ahead along the ray; its inverse likewise.
            per_axis = cosine if self.is_inverse else 1.0 / cosine
            found[:, 0], found[:, 1] = self.depth[rows, columns] * per_axis, per_axis
            found[:, 2] = -1.0 if self.is_inverse else 1.0
        if self.normal is not None:
            found[:, 3:] = self.normal[rows, columns]
        return torch.from_numpy(found)


def prior_columns(paths: Paths) -> tuple[Tensor, Tensor, Tensor]:
    """Priors of paths (N), NaN where unknown: terms (N, 2), power (N,), and unit normals (N, 3), local frame.

    ``a terms[0] + b terms[1]`` is the path length to ``power``, 1 for depth, -1 for inverse depth, for the scale and
    shift a, b of the photograph. Raises ValueError if the paths carry no priors.
    """
    if paths.priors.shape[1] != COLUMNS:
        raise ValueError(
            "a loss on priors has a weight, but the paths carry no priors; give Photographs its `priors`, or take "
            "the weight away"
        )
    return paths.priors[:, :2], paths.priors[:, 2], paths.priors[:, 3:]


def pixels_over(camera: PinholeCamera, box: Box, water: WaterSurface | None) -> np.ndarray:
    """Flat indices (n,) of the pixels of a camera whose path would leave a box through its floor.

    Such a path meets everything it shows inside. Others leave through a side, and may show objects beyond.
    """
    grid = camera.pixel_centres().reshape(-1, 2)
    paths = paths_of(camera, water, grid, np.zeros((len(grid), 3)), box)
    end = paths.at(paths.far[:, None])[:, 0, 2].numpy()
    # A thousandth of the box is more than float32 rounds off.
    on_floor = np.abs(end - box.low[2]) < 1e-3 * box.size[2]
    return np.flatnonzero(on_floor & (paths.far > paths.near).numpy())


def even_pixels(camera: PinholeCamera, step: float) -> np.ndarray:
    """Positions (N, 2) [px] of an even grid over the picture of a camera, ``step`` [px] apart."""
    columns, rows = (np.arange(0.5 * step, side, step) for side in (camera.width, camera.height))
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def may_show(camera: PinholeCamera, box: Box, water: WaterSurface | None) -> bool:
    """Whether a coarse grid of pixels of a camera meets a box: a quick test before `pixels_over`."""
    grid = even_pixels(camera, max(max(camera.width, camera.height) / COARSE, 1.0))
    paths = paths_of(camera, water, grid, np.zeros((len(grid), 3)), box)
    return bool((paths.far > paths.near).any())


@dataclass
class Photographs:
    """Photographs with cameras and water: the training data of a volume."""

    cameras: list[PinholeCamera]
    images: list[np.ndarray]  # list of (height, width, 3) uint8
    pixels: list[np.ndarray]  # list of (n,) int: flat indices of the pixels of each photograph that show the scene
    water: WaterSurface | None = None
    priors: list[PriorImages] | None = None  # or None: priors of the pixels of each photograph
    # list of (n,) float32 [m], optional: path lengths at which the paths of these pixels meet the bed of a `Layer`
    starts: list[np.ndarray] | None = None
    names: tuple[str, ...] = ()  # of the photographs, where they are asked for

    @property
    def left_half(self) -> Photographs:
        """The photographs with the pixels of their left halves alone."""
        halves = zip(self.cameras, self.pixels, strict=True)
        return replace(self, pixels=[own[own % camera.width < camera.width // 2] for camera, own in halves])

    def draw(self, count: int, box: Box, rng: np.random.Generator, patch: int = 1) -> Paths:
        """Paths (count patch^2) through patches of pixels drawn evenly from all photographs, in random order.

        The pixels of a patch, ``patch`` wide and high, follow each other row by row; all of them show the scene. Raises
        ValueError if no photograph has room for a patch.
        """
        corners = [self._corners(view, patch) for view in range(len(self.cameras))]
        sizes = np.array([len(c) for c in corners])
        if not sizes.sum():
            raise ValueError(f"no photograph shows the scene in {patch} x {patch} px; draw smaller patches")
        shares = rng.multinomial(count, sizes / sizes.sum())
        parts, priors, starts = [], [], []
        for view in np.flatnonzero(shares):
            camera, number = self.cameras[view], rng.integers(0, sizes[view], shares[view])
            drawn = corners[view][number]
            rows, columns = np.divmod((drawn[:, None] + _square(patch, camera.width)).ravel(), camera.width)
            pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1)
            parts.append(Rays.of(camera, pixels, self.images[view][rows, columns], int(view)))
            if self.starts is not None:
                starts.append(self.starts[view][number])
            if self.priors is not None:
                priors.append(self.priors[view].at(camera, rows, columns))
        order = (rng.permutation(count)[:, None] * patch**2 + np.arange(patch**2)).ravel()
        rays = Rays.concatenate(parts)[order]
        if isinstance(box, Layer) and self.starts is not None and patch == 1:
            paths = box.about(rays.paths(self.water, None), torch.from_numpy(np.concatenate(starts)[order]))
        else:
            paths = rays.paths(self.water, box)
        if self.priors is not None:
            paths.priors = torch.cat(priors)[torch.from_numpy(order)]
        return paths

    def _corners(self, view: int, patch: int) -> np.ndarray:
        """Flat indices of the upper left pixels of all patches whose every pixel shows the scene."""
        if patch == 1:
            return self.pixels[view]
        shows = np.zeros((self.cameras[view].height, self.cameras[view].width), dtype=np.uint8)
        shows.flat[self.pixels[view]] = 1
        # With this origin the window of a pixel begins at it.
        return np.flatnonzero(minimum_filter(shows, patch, mode="constant", origin=-(patch // 2)))


def _square(patch: int, width: int) -> np.ndarray:
    """Flat indices (patch^2) of a patch's pixels after its first one, in a picture of ``width`` px."""
    return (np.arange(patch)[:, None] * width + np.arange(patch)).ravel()
