"""The bed as a surface of coloured triangles: PLY, OBJ, GLB.

Delaunay triangles between the most certain points of cells in plan (2.5D), none of them over a hole of the cloud.
Optionally closed with walls and a bottom, for 3D printing and volumes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import igl
import numpy as np

from geo.gltf import write_glb
from geo.obj import write_obj
from geo.ply import write_ply
from geo.shapes import Mesh
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.export.plan_triangles import most_certain, triangles
from survey.export.product import ExportOptions

# Longer sides of triangles, in plan and in spacings, bridge a hole of the cloud.
LONGEST = 6.0


def write_mesh(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The surface, in the format of the suffix."""
    key = ("mesh", options.crs, options.resolution_m, options.watertight)
    mesh = run.once(key, lambda: _mesh(run, options))
    crs = mesh.crs
    if crs is None or mesh.rgb is None:
        raise RuntimeError("the surface of a run has a CRS and colours")
    match path.suffix.lower():
        case ".ply":
            write_ply(path, mesh.vertices, rgb=mesh.rgb, crs=crs, faces=mesh.faces)
        case ".obj":
            write_obj(path, mesh, crs)
        case _:
            write_glb(path, mesh, crs)


def _mesh(run: LoadedRun, options: ExportOptions) -> Mesh:
    """The surface in crs; it is made in the local frame, whose axes are equal."""
    bed, frame = run.certain_bed.bed, run.flight.frame
    mesh = bed_surface(
        bed.xyz,
        bed.rgb,
        bed.std,
        spacing_m=options.resolution_m or run.bed_header.gsd_m,
        watertight=options.watertight,
    )
    vertices, crs = frame.crs_from_local(mesh.vertices), frame.crs
    if options.crs is not None:
        reprojection = run.transformation_to(options.crs)
        vertices, crs = reprojection(vertices), reprojection.crs
    return replace(mesh, vertices=vertices, crs=crs)


def check_mesh(_path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """Raise SurveyError for a run without its frame, in which the surface is made."""
    _ = run.flight


def bed_surface(
    points: np.ndarray, rgb: np.ndarray, std: np.ndarray, *, spacing_m: float, watertight: bool = False
) -> Mesh:
    """Triangles of the bed through points (N, 3) [m], z up, with their colours; faces counter-clockwise from above.

    One height at each place in plan: for beds without overhangs. Of each cell, whose side is the spacing [m] (the
    ground sampling distance, or more), the point with the smallest std (N,) [m] of its height stays. A mean over the
    cell would be smoother, and wrong at every step of the bed, where it takes points of both sides. No face has a side
    of more than `LONGEST` spacings in plan. `watertight` closes the surface with walls and a bottom, see `solid_of`,
    whose vertices have the colours of the surface above.
    """
    chosen, south = most_certain(points, std, spacing_m), float(points[:, 1].min())
    faces = triangles(points[chosen, :2], south, LONGEST * spacing_m, spacing_m)
    if not len(faces):
        raise SurveyError(
            f"{len(points):,} points make no surface at --resolution {spacing_m:g}: in cells of that side they give no "
            f"triangle with sides up to {LONGEST:g} of it; give a length near the spacing of the points"
        )
    # Without the vertices that no face has.
    used = np.zeros(len(chosen), dtype=bool)
    used[faces] = True
    chosen, faces = chosen[used], (np.cumsum(used, dtype=np.int32) - 1)[faces]
    vertices, colours = points[chosen], rgb[chosen]
    if watertight:
        vertices, faces, above = solid_of(vertices, faces, spacing_m)
        colours = colours[above]
    return Mesh(vertices, faces, rgb=colours)


def solid_of(vertices: np.ndarray, faces: np.ndarray, thickness_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A closed solid under a surface: walls down from every rim to a bottom some thickness below the lowest vertex.

    At most two of the faces (F, 3) share an edge, with opposite directions. Returns vertices (2 V', 3) [m], those of
    the surface first, doubled where two parts of it met in one vertex only; faces (F', 3), two at each edge, with
    opposite directions; and the number (2 V',) of the vertex of the surface that each stands for. Holes become shafts.
    """
    # Parts that met in one vertex only have one each from here on.
    faces, kept = igl.split_nonmanifold(faces.astype(np.int64))
    top = vertices[kept]
    bottom = top.copy()
    bottom[:, 2] = vertices[:, 2].min() - thickness_m
    number = len(top)
    a, b = igl.boundary_facets(faces)[0].T
    walls = np.concatenate([np.stack([b, a, a + number], 1), np.stack([b, a + number, b + number], 1)])
    return np.concatenate([top, bottom]), np.concatenate([faces, faces[:, ::-1] + number, walls]), np.tile(kept, 2)
