"""The bed as a surface of coloured triangles, trimmed where no point supports it: PLY, OBJ, GLB.

By Delaunay triangles between the most certain points of cells in plan: one height at each place. Optionally closed with
walls and a bottom, for 3D printing and volumes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
from scipy.spatial import Delaunay, QhullError

from fields.sweep.bed import BedPoints
from geo.meshes import write_glb, write_obj
from geo.ply import write_ply
from geo.shapes import Mesh
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions
from survey.machine import free_memory_bytes

# Longer sides of triangles, in plan and in spacings, bridge a hole of the cloud.
LONGEST = 6.0
# Of memory for Delaunay triangles; measured.
_BYTES_OF_VERTEX = 500.0


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
    spacing_m = options.resolution_m or run.bed_header.gsd_m
    mesh = bed_surface(bed, spacing_m=spacing_m, watertight=options.watertight)
    vertices = run.in_crs(frame.crs_from_local(mesh.vertices), options.crs)
    return replace(mesh, vertices=vertices, crs=run.crs_for(options.crs))


def check_mesh(_path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """Raise SurveyError for a run without the frame in which a mesh is made."""
    _ = run.flight


def bed_surface(bed: BedPoints, *, spacing_m: float, watertight: bool = False) -> Mesh:
    """Triangles of the bed through its points, z up, faces counter-clockwise from above.

    Detail of `spacing_m` [m] is kept: the ground sampling distance, or more. `watertight` closes the surface with walls
    and a bottom, see `solid_of`. A vertex has the colour of its point, on the bottom that of the surface above.
    """
    chosen, faces = delaunay_surface(bed.xyz, bed.std, spacing_m)
    vertices, colours = bed.xyz[chosen], bed.rgb[chosen]
    if not len(faces):
        raise SurveyError(
            f"{len(bed):,} points make no surface at --resolution {spacing_m:g}: in cells of that side they give no "
            f"triangle with sides up to {LONGEST:g} of it; give a length near the spacing of the points"
        )
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


def delaunay_surface(points: np.ndarray, std: np.ndarray, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Delaunay surface with one height at each place in plan: for beds without overhangs.

    Of each cell, whose side is the spacing, the point (N, 3) [m] with the smallest std (N,) [m] stays; NaN counts as
    infinite. A mean over the cell would be smoother, and wrong at every step of the bed, where it takes points of both
    sides. Returns the numbers (V,) of the points that are vertices, and faces (F, 3) without sides of more than
    `LONGEST` spacings in plan.
    """
    column, row = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / spacing_m).astype(np.int64).T
    cell = row * (int(column.max()) + 1) + column
    order = np.lexsort((np.where(np.isfinite(std), std, np.inf), cell))
    chosen = order[np.unique(cell[order], return_index=True)[1]]
    needed, free = _BYTES_OF_VERTEX * len(chosen), free_memory_bytes()
    if needed > free:
        raise SurveyError(
            f"a mesh of {len(chosen)} vertices takes {needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are "
            "free; give a larger --resolution"
        )
    xy = points[chosen, :2].astype(np.float64)
    try:
        # Qhull loses digits where coordinates are large.
        faces = Delaunay(xy - xy.mean(axis=0)).simplices
    except (QhullError, ValueError):  # fewer than three points, or all on one line
        faces = np.zeros((0, 3), dtype=np.int32)
    sides = np.linalg.norm(xy[faces] - xy[np.roll(faces, 1, axis=1)], axis=2)
    faces = faces[sides.max(axis=1, initial=0.0) < LONGEST * spacing_m]
    used = np.zeros(len(chosen), dtype=bool)
    used[faces] = True
    return chosen[used], (np.cumsum(used, dtype=np.int32) - 1)[faces]
