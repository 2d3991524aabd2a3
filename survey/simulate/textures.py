"""Textures of bed and bodies, which are their albedo, and the light that falls on the bed in dry air.

Both are affine functions of position on every face, so that photographs in float64 and the path tracer, which
interpolates between corners, see the same.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import igl
import numpy as np
from scipy.ndimage import gaussian_filter

from survey.simulate.conditions import Light
from survey.simulate.shapes import BedGrid, Solid, height_of

# Texels along a side of the periodic tile.
TILE = 512

# Linear albedo, red, green, blue.
ROCK = (0.36, 0.35, 0.33)
_SAND, _GRAVEL, _WEED = (0.66, 0.57, 0.42), (0.40, 0.38, 0.34), (0.20, 0.25, 0.10)
# Spacing [m] and standard deviation of the logarithm of brightness: grains to patches.
_SPECKLES = ((0.01, 0.16), (0.02, 0.16), (0.04, 0.14), (0.08, 0.11), (0.16, 0.09), (0.4, 0.07))
# OpenCV's images hold at most 32767 rows.
_ROW = 1024


def sand(
    shape: tuple[int, int], texel_m: float, rng: np.random.Generator, stone: np.ndarray | None = None
) -> np.ndarray:
    """Linear albedo (rows, columns, 3) float32 of sand, gravel and weed; grains finer than a texel [m] are left out.

    `stone` (rows, columns) is the brightness of stones that lie there, 0 where there is none.
    """

    def speckle(spacing_m: float) -> np.ndarray:
        return noise(rng, shape, max(spacing_m / texel_m, 1.0))

    bright = sum(weight * speckle(spacing) for spacing, weight in _SPECKLES if spacing >= texel_m)
    patches = speckle(0.9) + 0.5 * speckle(0.25)
    gravel = _soft_step(speckle(1.4) + 0.4 * speckle(0.06), 0.4)
    weed = 0.85 * _soft_step(patches + 0.35 * speckle(0.04), 0.9)
    stone = np.zeros(shape, dtype=np.float32) if stone is None else stone
    colour = np.empty((*shape, 3), dtype=np.float32)
    bright = np.exp(bright)
    on_stone = np.minimum(stone, 1.0)
    for k in range(3):
        ground = _SAND[k] + gravel * (_GRAVEL[k] - _SAND[k])
        ground += weed * (_WEED[k] - ground)
        ground += on_stone * (stone * ROCK[k] - ground)
        colour[..., k] = bright * ground
    return colour


def in_texels(values: np.ndarray, cell_m: float, texel_m: float) -> np.ndarray:
    """Values (ny, nx) at the vertices of a drawn bed, between them at texels: (rows, columns) float32."""
    shape = tuple(math.ceil((count - 1) * cell_m / texel_m) + 1 for count in values.shape)
    scale = texel_m / cell_m
    to_cells = np.array([[scale, 0.0, 0.0], [0.0, scale, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(
        values.astype(np.float32), to_cells, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
    )


def light_of_bed(bed: BedGrid, solids: Sequence[Solid], light: Light) -> np.ndarray:
    """Light (ny, nx) on the bed: sky and sun by the normal, less in hollows and beside bodies."""
    covered = bed.heights.copy()
    for solid in solids:
        _cover(covered, bed, solid)
    smooth = gaussian_filter(bed.heights, 0.7)
    dy, dx = np.gradient(smooth, bed.cell)
    normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1)
    lit = light.irradiance(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
    for reach_m, strength in ((0.05, 6.0), (0.25, 1.6)):
        hollow = gaussian_filter(covered, reach_m / bed.cell, truncate=3.0) - bed.heights
        lit *= 1.0 / (1.0 + strength * np.maximum(hollow, 0.0) / (4.0 * reach_m))
    return lit


def _cover(covered: np.ndarray, bed: BedGrid, solid: Solid) -> None:
    """Raise `covered`, in place, to the top of a body."""
    ny, nx = covered.shape
    low = np.floor((solid.centre[:2] - solid.radius - (bed.west, bed.south)) / bed.cell).astype(int)
    high = np.ceil((solid.centre[:2] + solid.radius - (bed.west, bed.south)) / bed.cell).astype(int) + 1
    (i0, j0), (i1, j1) = np.maximum(low, 0), np.minimum(high, (nx, ny))
    x, y = np.meshgrid(bed.west + bed.cell * np.arange(i0, i1), bed.south + bed.cell * np.arange(j0, j1))
    top = height_of(solid, x, y, solid.centre[2] + 2.0 * solid.radius)
    covered[j0:j1, i0:i1] = np.fmax(covered[j0:j1, i0:i1], top)


def _soft_step(value: np.ndarray, at: float) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-6.0 * (value - at)))


def noise(rng: np.random.Generator, shape: tuple[int, int], spacing: float) -> np.ndarray:
    """Smooth noise (rows, columns) float32 of about unit variance; `spacing` of its knots in cells."""
    knots = [math.ceil(n / spacing) + 4 for n in shape]
    lattice = rng.standard_normal(knots, dtype=np.float32)
    to_knots = np.array([[1.0 / spacing, 0.0, 1.5], [0.0, 1.0 / spacing, 1.5]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(lattice, to_knots, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)


def periodic(rng: np.random.Generator, spacing: int) -> np.ndarray:
    """Smooth noise (512, 512) float32 that can be tiled."""
    lattice = rng.standard_normal((TILE // spacing, TILE // spacing), dtype=np.float32)
    wrapped = np.pad(lattice, 2, mode="wrap")
    return cv2.resize(wrapped, None, fx=spacing, fy=spacing, interpolation=cv2.INTER_CUBIC)[
        2 * spacing : -2 * spacing, 2 * spacing : -2 * spacing
    ]


@dataclass(frozen=True)
class ImageTexture:
    """Texture of a body by an image and a map to its texels for each face."""

    image: np.ndarray  # (rows, columns, 3) float32: linear albedo; texels are points at whole numbers
    texel_from_point: np.ndarray  # (K, 2, 4): texel (u, v) = matrix @ (x, y, z, 1) [m], local
    map_of_face: np.ndarray  # (F,): which of the K matrices holds on each face; not read where there is only one
    repeats: bool = False  # Whether the image is tiled; otherwise its border texels are repeated
    sharp: bool = False  # The nearest texel instead of a mixture of four

    def albedo(self, points: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Linear albedo (N, 3) at points (N, 3) [m] on faces (N,)."""
        at = self.texels(points, face)
        if self.repeats:
            at = at % self.image.shape[1::-1]
        if self.sharp:
            column, row = (np.clip(np.rint(at[:, k]).astype(int), 0, self.image.shape[1 - k] - 1) for k in (0, 1))
            return self.image[row, column].astype(np.float64)
        border = cv2.BORDER_WRAP if self.repeats else cv2.BORDER_REPLICATE
        return look_up(self.image, at, border)

    def texels(self, points: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Texel coordinates (N, 2) of points (N, 3) [m] on faces (N,)."""
        if len(self.texel_from_point) == 1:
            matrix = self.texel_from_point[0]
            return points @ matrix[:, :3].T + matrix[:, 3]
        matrix = self.texel_from_point[self.map_of_face[face]]
        return np.einsum("nij,nj->ni", matrix[:, :, :3], points) + matrix[:, :, 3]


@dataclass(frozen=True)
class VertexTexture:
    """Texture of a body by colours of its vertices, linear between them."""

    colours: np.ndarray  # (V, 3): linear albedo
    # vertices, faces (V, 3) [m], local, and (F, 3): of the body
    vertices: np.ndarray
    faces: np.ndarray

    def albedo(self, points: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Linear albedo (N, 3) at points (N, 3) [m] on faces (N,)."""
        a, b, c = (self.vertices[self.faces[face, k]] for k in range(3))
        weights = igl.barycentric_coordinates(np.ascontiguousarray(points), a, b, c)
        return np.einsum("nk,nkc->nc", np.clip(weights, 0.0, 1.0), self.colours[self.faces[face]])


def draped_texture(
    image: np.ndarray, west: float, south: float, texel_m: float, *, sharp: bool = False
) -> ImageTexture:
    """An image (rows, columns, 3) draped from above: its first texel at west, south [m], rows going north."""
    texel_from_point = np.array([[[1.0, 0.0, 0.0, -west], [0.0, 1.0, 0.0, -south]]]) / texel_m
    return ImageTexture(image, texel_from_point, np.zeros(1, dtype=np.int64), sharp=sharp)


def look_up(image: np.ndarray, at: np.ndarray, border: int = cv2.BORDER_REPLICATE) -> np.ndarray:
    """Values (N, channels) float64 of an image between its texels (N, 2), columns first."""
    u, v = (_in_rows(at[:, k].astype(np.float32)) for k in (0, 1))
    values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=border)
    return values.reshape(u.size, -1)[: len(at)].astype(np.float64)


def _in_rows(values: np.ndarray) -> np.ndarray:
    """Values (N,) as rows, the last one filled up."""
    return np.ascontiguousarray(np.pad(values, (0, -len(values) % _ROW), mode="edge").reshape(-1, _ROW))
