"""Points and triangles in crs coordinates, as files hold them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pyproj import CRS


@dataclass(frozen=True)
class Cloud:
    """Points of a file.

    Attributes
    ----------
    points : (N, 3) float64, in crs
        Easting or longitude, northing or latitude, height.
    rgb : (N, 3) uint8 or None
    crs : pyproj.CRS or None
        None if the file does not state it, or states one that is not understood; `notes` says which.
    classification : (N,) uint8 or None
        Classes of LAS.
    extra : dict of (N,) or (N, k) arrays
        Further values by name; NaN where the file declares "no data".
    notes : tuple of str
        Sentences for the user about missing parts of the file.
    """

    points: np.ndarray
    rgb: np.ndarray | None = None
    crs: CRS | None = None
    classification: np.ndarray | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Mesh:
    """Triangles of a file.

    Attributes
    ----------
    vertices : (V, 3) float64, in crs
    faces : (F, 3) int64
        Vertex numbers in the winding of the file; polygons are cut into fans.
    crs : pyproj.CRS or None
        None where the format states none: PLY, OBJ, glTF.
    rgb : (V, 3) uint8 or None
        Of the vertices.
    notes : tuple of str
        Sentences for the reader about what the file lacks.
    """

    vertices: np.ndarray
    faces: np.ndarray
    crs: CRS | None = None
    rgb: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def triangulated(counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) int64 of polygons, each cut into a fan around its first corner, in their order.

    Parameters
    ----------
    counts : (P,) int
        Corners of each polygon; those with fewer than three have no area and give no triangle.
    corners : (sum of counts,) int
        Vertex numbers, polygon after polygon.
    """
    counts = np.asarray(counts, dtype=np.int64)
    corners = np.asarray(corners, dtype=np.int64)
    starts = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), fans)
    within = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    first = starts[polygon]
    return corners[np.stack([first, first + within + 1, first + within + 2], axis=-1)]
