"""The bed of a scene file: a plane, or a surface from a mesh or a cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import Delaunay

from geo import Cloud, LocalFrame, Mesh, crs_difference, read_reference
from survey.errors import SurveyError
from survey.simulate.scene_file import BedSettings
from survey.simulate.shapes import BedGrid
from survey.simulate.triangles import TriangleMesh

# Between the vertices of a plane [m]: it is one in any case, and light is mixed between vertices.
_PLANE_CELL_M = 0.5


def bed_from_file(settings: BedSettings, folder: Path, frame: LocalFrame) -> tuple[TriangleMesh, np.ndarray | None]:
    """The bed of a file, in local, and the colours (V, 3) uint8 of its vertices if it has any.

    Raises
    ------
    SurveyError, GeoError
        If the file cannot be used as a bed.
    """
    path = folder / settings.file
    if settings.kind == "mesh":
        mesh = read_reference(path)
        if not isinstance(mesh, Mesh):
            raise SurveyError(f'{path} has no faces; give kind = "cloud" in [bed], or a mesh')
    else:
        mesh = mesh_of_cloud(read_reference(path), settings)
    vertices = mesh.vertices
    if settings.frame == "crs":
        difference = crs_difference(mesh.crs, frame.crs) if mesh.crs is not None else None
        if difference is not None:
            raise SurveyError(f"{path} is in another crs than the scene ({difference}); transform it, or give its crs")
        vertices = frame.local_from_crs(vertices)
        if not np.isfinite(vertices).all():
            raise SurveyError(
                f"{path} has coordinates that are not on the map of {frame.crs.name}; correct crs or frame"
            )
    return TriangleMesh(vertices, mesh.faces), mesh.rgb


def mesh_of_cloud(cloud: Cloud | Mesh, settings: BedSettings) -> Mesh:
    """Triangles between points (2.5D Delaunay in plan view), smoothed along the plumb line.

    Each pass moves every vertex to the mean height of its neighbours (Laplacian smoothing with full weight; places in
    plan view stay). The triangles fill the convex hull of the points.
    """
    points = cloud.vertices if isinstance(cloud, Mesh) else cloud.points
    rgb = cloud.rgb
    if settings.spacing_m is not None:
        points, rgb = _thinned(points, rgb, settings.spacing_m)
    if len(points) < 3:
        raise SurveyError(f"{settings.file} has {len(points)} points, expected a cloud that covers the bed")
    # Near the middle, where float64 leaves the most digits for the tests of the triangulation.
    plan = points[:, :2] - points[:, :2].mean(axis=0)
    faces = Delaunay(plan).simplices.astype(np.int64)
    a, b, c = (plan[faces[:, k]] for k in range(3))
    clockwise = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    faces[clockwise] = faces[clockwise][:, ::-1]
    heights = points[:, 2].copy()
    for _ in range(settings.smoothing):
        heights = _mean_of_neighbours(faces, heights)
    return Mesh(np.concatenate([points[:, :2], heights[:, None]], axis=-1), faces, crs=cloud.crs, rgb=rgb)


def plane(area: tuple[float, float, float, float], z: float) -> BedGrid:
    """A level bed over west, south, east, north [m] at a height [m], local."""
    west, south, east, north = area
    cells = [max(int(np.ceil(size / _PLANE_CELL_M)), 1) for size in (north - south, east - west)]
    return BedGrid(np.full((cells[0] + 1, cells[1] + 1), z), west, south, _PLANE_CELL_M)


def _thinned(points: np.ndarray, rgb: np.ndarray | None, spacing: float) -> tuple[np.ndarray, np.ndarray | None]:
    """One point per square cell: the mean of those in it."""
    cells = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / spacing).astype(np.int64)
    _, cell, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cell.ravel(), v) / counts for v in values.T], axis=-1)

    low = points.min(axis=0)
    return low + mean(points - low), None if rgb is None else np.round(mean(rgb.astype(float))).astype(np.uint8)


def _mean_of_neighbours(faces: np.ndarray, values: np.ndarray) -> np.ndarray:
    start, end = faces[:, [0, 1, 2, 1, 2, 0]].ravel(), faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    links = coo_matrix((np.ones(len(start)), (start, end)), shape=(len(values), len(values))).tocsr()
    # An edge inside the mesh belongs to two triangles, and counts once all the same.
    links.data[:] = 1.0
    return links @ values / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)
