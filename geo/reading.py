"""Clouds and meshes read by the suffix of their file: PLY, OBJ, LAS, LAZ, COPC, GeoTIFF, BAG; with extras glTF, E57."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from geo.e57 import read_e57
from geo.errors import EmptyCloud, UnreadableFile
from geo.files import existing_file
from geo.gltf import read_gltf
from geo.las import read_cloud
from geo.obj import read_obj
from geo.ply import read_ply
from geo.raster import read_raster
from geo.shapes import Cloud, Mesh, vertices_of
from geo.values import check_values

_READERS = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".las": read_cloud,
    ".laz": read_cloud,  # COPC too: .copc.laz
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".tif": read_raster,
    ".tiff": read_raster,
    ".bag": read_raster,
    ".e57": read_e57,
}


def read_reference(path: str | Path) -> Mesh | Cloud:
    """Read a mesh or cloud in crs coordinates, by the suffix of its name.

    PLY, OBJ and glTF give a `Mesh` where they have faces, else a `Cloud`; a GeoTIFF gives a `Mesh`, LAS, LAZ and E57 a
    `Cloud`. Coordinates are float64 throughout. Raises EmptyCloud if the file has no points; UnreadableFile if it does
    not exist, has another suffix, needs a library that is not installed, is damaged, has coordinates that are not
    finite, or faces that name vertices it does not have; if its values were rounded, or have undeclared no-data values,
    see `geo.values`.
    """
    path = existing_file(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        suffixes = ", ".join(_READERS)
        raise UnreadableFile(f'{path} has the suffix "{path.suffix}"; export it as one of {suffixes}.')
    shape = reader(path)
    points = vertices_of(shape)
    if not len(points):
        raise EmptyCloud(f"{path} has no points; expected a mesh or a cloud with at least one.")
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise UnreadableFile(
            f"{path} has {bad} of {len(points)} vertices whose coordinates are not finite; remove them and "
            "export it again."
        )
    if isinstance(shape, Mesh):
        _require_faces(shape, path)
    return replace(shape, notes=(*shape.notes, *check_values(points, shape.crs, path)))


def _require_faces(mesh: Mesh, path: Path) -> None:
    if not len(mesh.faces):
        raise UnreadableFile(f"{path} has faces of fewer than three corners only; export it with triangles.")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        face = int(np.flatnonzero(((mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))).any(axis=1))[0])
        raise UnreadableFile(
            f"{path} has a face (triangle {face}) that names a vertex beyond its {len(mesh.vertices)}; it is "
            "damaged: export it again."
        )
