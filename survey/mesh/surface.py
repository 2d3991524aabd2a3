"""A surface of the bed, in triangles with colours, trimmed where no point supports it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from geo.shapes import Mesh
from survey.errors import SurveyError
from survey.mesh.delaunay import delaunay_surface
from survey.mesh.poisson import poisson_surface
from survey.mesh.solid import solid_of

METHODS = ("delaunay", "poisson")


def bed_surface(
    points: np.ndarray,
    rgb: np.ndarray,
    std: np.ndarray,
    *,
    spacing_m: float,
    method: str,
    watertight: bool = False,
    path: str | Path,
) -> Mesh:
    """Triangles of the bed.

    Parameters
    ----------
    points : (N, 3) [m], Cartesian, z up
    rgb : (N, 3) uint8
    std : (N,) [m]
        Of their heights.
    spacing_m : [m]
        Size of the detail that is kept: the ground sampling distance, or more.
    method : "delaunay" or "poisson"
        See `delaunay_surface`, which has one height at each place, and `poisson_surface`, which overhangs.
    watertight : bool
        Close the surface with walls and a bottom, see `solid_of`.
    path : Path
        What an error names: the file that the mesh is for.

    Returns
    -------
    Mesh
        In the frame of the points, faces counter-clockwise from above. A vertex has the colour of the point next to it.

    Raises
    ------
    SurveyError
        If the method is unknown, or too few points lie together for a triangle.
    UnwritableFile
        If Open3D, which makes Poisson surfaces, is not installed.
    """
    if method not in METHODS:
        raise SurveyError(f"--mesh-method is {method}, expected one of {', '.join(METHODS)}")
    if method == "delaunay":
        vertices, faces = delaunay_surface(points, std, spacing_m)
    else:
        vertices, faces = poisson_surface(points, spacing_m, path)
    if not len(faces):
        raise SurveyError(
            f"{len(points):,} points make no surface at --resolution {spacing_m:g}: none of them lie as "
            "close together as that asks, yet apart; give a length near the spacing of the points"
        )
    if watertight:
        vertices, faces = solid_of(vertices, faces, spacing_m)
    _, nearest = cKDTree(points).query(vertices, workers=-1)
    return Mesh(vertices, faces, rgb=rgb[nearest])
