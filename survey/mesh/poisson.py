"""Screened Poisson surfaces of oriented points, by Open3D (the extra ``mesh``)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from geo.optional import library_for
from survey.mesh.delaunay import without_loose
from survey.mesh.normals import oriented_normals

# Of the cube over the cloud, against its largest extent.
_SCALE = 1.1
# Deeper octrees than this exceed the memory before they show more.
_DEEPEST = 13
# Vertices farther from every point than this, in spacings, are guesses.
TRIM = 2.0


def poisson_surface(points: np.ndarray, spacing_m: float, path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """A smooth surface near the points, which may overhang; trimmed where none of them is near.

    Parameters
    ----------
    points : (N, 3) [m]
    spacing_m : [m]
        The cells of the octree are at most as large.
    path : Path
        What an error names.

    Returns
    -------
    vertices : (V, 3) [m]
    faces : (F, 3) int
        Counter-clockwise from above.

    Raises
    ------
    UnwritableFile
        If Open3D is not installed.

    Notes
    -----
    M. Kazhdan and H. Hoppe, Screened Poisson surface reconstruction, ACM Transactions on Graphics 32 (2013).
    """
    open3d = library_for(path, "open3d", "mesh", to_write=True)
    middle = points.mean(axis=0)
    vector = open3d.utility.Vector3dVector
    cloud = open3d.geometry.PointCloud(vector(points - middle))
    cloud.normals = vector(oriented_normals(points))
    cells = _SCALE * float(np.ptp(points, axis=0).max()) / spacing_m
    depth = min(max(math.ceil(math.log2(max(cells, 2.0))), 5), _DEEPEST)
    # One thread: with several, the order of sums decides on the last digits.
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=depth, scale=_SCALE, n_threads=1
    )
    vertices, faces = np.asarray(mesh.vertices) + middle, np.asarray(mesh.triangles)
    distance, _ = cKDTree(points).query(vertices, distance_upper_bound=TRIM * spacing_m, workers=-1)
    return without_loose(vertices, faces[np.isfinite(distance)[faces].all(axis=1)])
