"""The bed as a surface of coloured triangles, trimmed where no point supports it: PLY, OBJ, GLB.

By Delaunay triangles between the most certain points of cells in plan (2.5D), or as a screened Poisson surface by
Open3D (the extra ``mesh``) of points with normals from planes through their neighbours. Optionally closed with walls
and a bottom, for 3D printing and volumes.
"""

import math
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import Delaunay, QhullError, cKDTree

from fields.sweep.bed import BedPoints
from geo.files import library_for
from geo.meshes import write_glb, write_obj
from geo.ply import write_ply
from geo.shapes import Mesh
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions
from survey.machine import free_memory_bytes

_NEIGHBOURS = 12
_CHUNK = 50_000
# Orientation spreads by one point per round: enough for walls a hundred points high.
_ROUNDS = 100
# Size of the Poisson cube relative to the largest extent of the cloud.
_SCALE = 1.1
# Deeper octrees exceed the memory without showing more.
_DEEPEST = 13
# Vertices farther from every point than this, in spacings, are guesses.
TRIM = 2.0
# Longer sides of triangles, in plan and in spacings, bridge a hole of the cloud.
LONGEST = 6.0
# Of memory for Delaunay triangles; measured.
_BYTES_OF_VERTEX = 500.0


def write_mesh(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """The surface, in the format of the suffix."""
    key = ("mesh", options.crs, options.resolution_m, options.mesh_method, options.watertight)
    mesh = run.once(key, lambda: _mesh(path, run, options))
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


def _mesh(path: Path, run: LoadedRun, options: ExportOptions) -> Mesh:
    """The surface in crs; it is made in the local frame, whose axes are equal."""
    bed, frame = run.certain_bed.bed, run.flight.frame
    mesh = bed_surface(
        bed,
        spacing_m=options.resolution_m or run.bed_header.gsd_m,
        method=options.mesh_method,
        watertight=options.watertight,
        path=path,
    )
    vertices = run.in_crs(frame.crs_from_local(mesh.vertices), options.crs)
    return replace(mesh, vertices=vertices, crs=run.crs_for(options.crs))


def check_mesh(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError or GeoError for a missing library, or a run without its frame."""
    if options.mesh_method == "poisson":
        library_for(path, "open3d", "mesh", to_write=True)
    # The frame in which it is made.
    _ = run.flight


def bed_surface(bed: BedPoints, *, spacing_m: float, method: str, watertight: bool = False, path: str | Path) -> Mesh:
    """Triangles of the bed through its points, z up, faces counter-clockwise from above.

    Detail of `spacing_m` [m] is kept: the ground sampling distance, or more. The method is "delaunay" (see
    `delaunay_surface`, one height at each place) or "poisson" (see `poisson_surface`, which overhangs); `watertight`
    closes the surface with walls and a bottom, see `solid_of`. Errors name the path. A vertex has the colour of the
    point next to it, on the bottom that of the surface above.
    """
    if method == "delaunay":
        chosen, faces = delaunay_surface(bed.xyz, bed.std, spacing_m)
        vertices, colours = bed.xyz[chosen], bed.rgb[chosen]
    else:
        vertices, faces = poisson_surface(bed.xyz, spacing_m, path)
        colours = bed.rgb[cKDTree(bed.xyz).query(vertices, workers=-1)[1]]
    if not len(faces):
        raise SurveyError(
            f"{len(bed):,} points make no surface at --resolution {spacing_m:g}: in cells of that side they give no "
            f"triangle with sides up to {LONGEST:g} of it; give a length near the spacing of the points"
        )
    if watertight:
        vertices, faces, above = solid_of(vertices, faces, spacing_m)
        colours = colours[above]
    return Mesh(vertices, faces, rgb=colours)


def oriented_normals(points: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of points (N, 3) [m], z up, N at least 13.

    Cameras look down through the water, so normals point up. On walls that does not decide, and neighbours vote: in
    rounds, each point takes the orientation of those around it, weighted by how level and how parallel they are.
    """
    tree = cKDTree(points)
    count = min(_NEIGHBOURS + 1, len(points))
    near = np.empty((len(points), count - 1), dtype=np.int32)
    normals = np.empty((len(points), 3))
    for first in range(0, len(points), _CHUNK):
        part = slice(first, first + _CHUNK)
        found = tree.query(points[part], k=count, workers=-1)[1]
        near[part] = found[:, 1:]
        local = points[found] - points[found].mean(axis=1, keepdims=True)
        normals[part] = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
    normals[normals[:, 2] < 0.0] *= -1.0
    # Weights of points in each other's vote: signed squares of the cosine between their normals.
    point, other = np.repeat(np.arange(len(near), dtype=np.int32), near.shape[1]), near.ravel()
    cosine = np.einsum("ij,ij->i", normals[point], normals[other])
    weights = cosine * np.abs(cosine) / near.shape[1]
    voters = csr_array((weights, (point, other)), shape=(len(near), len(near)))
    voters = 0.5 * (voters + voters.T)
    vote = own = normals[:, 2] ** 2
    for _ in range(_ROUNDS):
        vote = np.clip(own + voters @ vote, -1.0, 1.0)
    normals[vote < 0.0] *= -1.0
    return normals


def poisson_surface(points: np.ndarray, spacing_m: float, path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """A smooth surface near points (N, 3) [m], which may overhang; trimmed where none of them is near.

    Cells of the octree are at most as large as the spacing. Returns vertices (V, 3) [m] and faces (F, 3),
    counter-clockwise from above; errors name the path. After M. Kazhdan and H. Hoppe, Screened Poisson surface
    reconstruction, ACM Transactions on Graphics 32 (2013).
    """
    open3d = library_for(path, "open3d", "mesh", to_write=True)
    middle = points.mean(axis=0)
    vector = open3d.utility.Vector3dVector
    cloud = open3d.geometry.PointCloud(vector(points - middle))
    cloud.normals = vector(oriented_normals(points))
    cells = _SCALE * float(np.ptp(points, axis=0).max()) / spacing_m
    depth = min(max(math.ceil(math.log2(max(cells, 2.0))), 5), _DEEPEST)
    # One thread: with several, the last digits would depend on the order of sums.
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=depth, scale=_SCALE, n_threads=1
    )
    vertices, faces = np.asarray(mesh.vertices) + middle, np.asarray(mesh.triangles)
    distance, _ = cKDTree(points).query(vertices, distance_upper_bound=TRIM * spacing_m, workers=-1)
    return without_unused_vertices(vertices, faces[np.isfinite(distance)[faces].all(axis=1)])


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
    return without_unused_vertices(chosen, faces[sides.max(axis=1, initial=0.0) < LONGEST * spacing_m])


def without_unused_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without vertices that no face has."""
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used, dtype=np.int32) - 1)[faces]
