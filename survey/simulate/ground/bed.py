"""The bed of a scene file: a plane, or a surface from a mesh or a cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import CRS
from scipy.sparse import coo_matrix
from scipy.spatial import Delaunay

from geo import Cloud, LocalFrame, Mesh, crs_difference, read_reference
from geo.crs import height_unit_m
from geo.shapes import in_height_unit, left_out, part_of
from survey.errors import SurveyError
from survey.simulate.ground.shapes import BedGrid
from survey.simulate.ground.triangles import TriangleMesh
from survey.simulate.scene_file import BedSettings

# Between the vertices of a plane [m]: it is one in any case, and light is mixed between vertices.
_PLANE_CELL_M = 0.5


def bed_from_file(path: Path, settings: BedSettings, frame: LocalFrame) -> tuple[TriangleMesh, np.ndarray | None]:
    """The bed of a file, in local, and the colours (V, 3) uint8 of its vertices if it has any.

    Raises
    ------
    SurveyError, GeoError
        If the file cannot be used as a bed.
    """
    in_crs = settings.frame == "crs"
    shape = in_height_unit(read_reference(path), height_unit_m(frame.crs) if in_crs else 1.0)
    if isinstance(shape, Cloud):
        shape = part_of(shape, ~left_out(shape)[0])
    points, faces = (shape.vertices, shape.faces) if isinstance(shape, Mesh) else (shape.points, None)
    if settings.kind == "mesh" and faces is None:
        raise SurveyError(f'{path} has no faces; give kind = "cloud" in [bed], or a mesh')
    if in_crs:
        points = _in_local(points, shape.crs, path, frame)
    if settings.kind == "mesh" and faces is not None:
        return TriangleMesh(points, faces), shape.rgb
    rgb = shape.rgb
    if settings.spacing_m is not None:
        points, rgb = _thinned(points, rgb, settings.spacing_m)
    if len(points) < 3:
        raise SurveyError(f"{path} has {len(points)} points, expected a cloud that covers the bed")
    return mesh_of_points(points, settings.smoothing), rgb


def _in_local(points: np.ndarray, crs: CRS | None, path: Path, frame: LocalFrame) -> np.ndarray:
    difference = crs_difference(crs, frame.crs) if crs is not None else None
    if difference is not None:
        raise SurveyError(f"{path} is in another crs than the scene ({difference}); transform it, or give its crs")
    points = frame.local_from_crs(points)
    if not np.isfinite(points).all():
        raise SurveyError(
            f"{path} has coordinates that are not on the map of {frame.crs.name}; correct crs or bed.frame"
        )
    return points


def mesh_of_points(points: np.ndarray, smoothing: int) -> TriangleMesh:
    """Triangles between points (N, 3) [m], local: 2.5D Delaunay in plan view, smoothed along the plumb line.

    Each pass moves every vertex to the mean height of its neighbours (Laplacian smoothing with full weight; places in
    plan view stay). The triangles fill the convex hull of the points.
    """
    faces = Delaunay(points[:, :2]).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k], :2] for k in range(3))
    clockwise = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    faces[clockwise] = faces[clockwise][:, ::-1]
    heights = points[:, 2].copy()
    for _ in range(smoothing):
        heights = _mean_of_neighbours(faces, heights)
    return TriangleMesh(np.concatenate([points[:, :2], heights[:, None]], axis=-1), faces)


def plane(area: tuple[float, float, float, float], z: float) -> BedGrid:
    """A level bed over west, south, east, north [m] at a height [m], local."""
    west, south, east, north = area
    cells = [max(int(np.ceil(size / _PLANE_CELL_M)), 1) for size in (north - south, east - west)]
    return BedGrid(np.full((cells[0] + 1, cells[1] + 1), z), west, south, _PLANE_CELL_M)


def _thinned(points: np.ndarray, rgb: np.ndarray | None, spacing: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Thinned points: the mean of those in each square cell."""
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
