"""The skin of a body: its albedo as an image that is laid over it, or as colours of its vertices.

Both are affine functions of position on every face, so that photographs in float64 and the path tracer, which
interpolates between corners, see the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

# OpenCV's images hold at most 32767 rows.
_ROW = 1024


@dataclass(frozen=True)
class ImageSkin:
    """An image laid over a body."""

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
class VertexSkin:
    """Colours of the vertices, mixed between them."""

    colours: np.ndarray  # (V, 3): linear albedo
    # vertices, faces (V, 3) [m], local, and (F, 3): of the body
    vertices: np.ndarray
    faces: np.ndarray

    def albedo(self, points: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Linear albedo (N, 3) at points (N, 3) [m] on faces (N,)."""
        a, b, c = (self.vertices[self.faces[face, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        area = np.einsum("ij,ij->i", normal, normal)
        at_b = np.einsum("ij,ij->i", np.cross(points - a, c - a), normal) / area
        at_c = np.einsum("ij,ij->i", np.cross(b - a, points - a), normal) / area
        weights = np.stack([1.0 - at_b - at_c, at_b, at_c], axis=-1)
        return np.einsum("nk,nkc->nc", np.clip(weights, 0.0, 1.0), self.colours[self.faces[face]])


def skin_from_above(image: np.ndarray, west: float, south: float, texel_m: float, *, sharp: bool = False) -> ImageSkin:
    """An image (rows, columns, 3) laid over a body from above: its first texel at west, south [m], rows going north."""
    texel_from_point = np.array([[[1.0, 0.0, 0.0, -west], [0.0, 1.0, 0.0, -south]]]) / texel_m
    return ImageSkin(image, texel_from_point, np.zeros(1, dtype=np.int64), sharp=sharp)


def look_up(image: np.ndarray, at: np.ndarray, border: int = cv2.BORDER_REPLICATE) -> np.ndarray:
    """Values (N, channels) float64 of an image between its texels (N, 2), columns first."""
    u, v = (_in_rows(at[:, k].astype(np.float32)) for k in (0, 1))
    values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=border)
    return values.reshape(u.size, -1)[: len(at)].astype(np.float64)


def _in_rows(values: np.ndarray) -> np.ndarray:
    """Values (N,) as rows, the last one filled up."""
    return np.ascontiguousarray(np.pad(values, (0, -len(values) % _ROW), mode="edge").reshape(-1, _ROW))
