"""The bed as triangles: PLY, OBJ, GLB."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from geo.files import library_for
from geo.gltf import write_glb
from geo.obj import write_obj
from geo.ply import write_ply
from geo.shapes import Mesh
from survey.export.bed_surface import bed_surface
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions


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
        bed.xyz,
        bed.rgb,
        bed.std,
        spacing_m=options.resolution_m or run.bed_header.gsd_m,
        method=options.mesh_method,
        watertight=options.watertight,
        path=path,
    )
    vertices, crs = frame.crs_from_local(mesh.vertices), frame.crs
    if options.crs is not None:
        reprojection = run.transformation_to(options.crs)
        vertices, crs = reprojection(vertices), reprojection.crs
    return replace(mesh, vertices=vertices, crs=crs)


def check_mesh(path: Path, run: LoadedRun, options: ExportOptions) -> None:
    """Raise SurveyError or GeoError for a missing library, or a run without its frame."""
    if options.mesh_method == "poisson":
        library_for(path, "open3d", "mesh", to_write=True)
    # The frame in which it is made.
    _ = run.flight
