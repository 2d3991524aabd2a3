"""Clouds and meshes read by the suffix of their file: PLY, OBJ, LAS, LAZ, COPC; with extras glTF, GeoTIFF, E57.

Also verifies written clouds and meshes by reading them again, before they replace an older file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pyproj import CRS

from geo.compatibility import crs_difference
from geo.crs import is_geographic
from geo.e57 import read_e57
from geo.errors import EmptyCloud, UnreadableFile, UnwritableFile
from geo.files import existing_file, write_whole_at
from geo.gltf import read_gltf
from geo.las import read_cloud
from geo.obj import read_obj
from geo.ply import read_ply
from geo.raster import read_raster
from geo.read_back import read_back_error
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
    ".e57": read_e57,
}
# To what text formats and single precision round coordinates: metres, degrees, and a share of the extent.
_STEP, _STEP_DEG, _SHARE = 1e-3, 1e-8, 3e-7


def read_reference(path: str | Path) -> Mesh | Cloud:
    """Read a mesh or cloud in crs coordinates, by the suffix of its name.

    PLY, OBJ and glTF give a `Mesh` where they have faces, else a `Cloud`; a GeoTIFF gives a `Mesh`, LAS, LAZ and
    E57 a `Cloud`. Coordinates are float64 throughout.

    Raises
    ------
    EmptyCloud
        If the file has no points.
    UnreadableFile
        If it does not exist, has another suffix, needs a library that is not installed, is damaged, has
        coordinates that are not finite, or faces that name vertices it does not have; if its values were rounded, or
        have undeclared no-data values, see `geo.values`.
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


def reader_of(path: Path) -> Callable[[Path], Mesh | Cloud]:
    """Reader for a known suffix, whatever values the files hold."""
    return _READERS[path.suffix.lower()]


def _require_faces(mesh: Mesh, path: Path) -> None:
    if not len(mesh.faces):
        raise UnreadableFile(f"{path} has faces of fewer than three corners only; export it with triangles.")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        face = int(np.flatnonzero(((mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))).any(axis=1))[0])
        raise UnreadableFile(
            f"{path} has a face (triangle {face}) that names a vertex beyond its {len(mesh.vertices)}; it is "
            "damaged: export it again."
        )


def write_verified(
    path: str | Path, write: Callable[[Path], None], points: np.ndarray, num_faces: int | None, crs: CRS
) -> None:
    """Write a shape, whole or not at all, and verify it by reading it again.

    Parameters
    ----------
    path : Path
        Its suffix tells the format.
    write : callable
        Writes to a path of that suffix.
    points : (N, 3), in crs
    num_faces : int or None
        None for a cloud.

    Raises
    ------
    UnwritableFile
        If it cannot be written, or what is read again differs from what was written.
    """
    path = Path(path)
    if path.exists() and not path.is_file() and not path.is_dir():
        # A device or a pipe cannot be read back.
        write(path)
        return
    with (
        write_whole_at(path) as part,
        TemporaryDirectory(prefix=".", suffix=".part", dir=part.parent) as work,
    ):
        copy = Path(work) / f"copy{path.suffix}"
        try:
            write(copy)
        except UnwritableFile as error:
            raise UnwritableFile(str(error).replace(str(copy), str(path))) from error
        _require_same_shape(copy, path, points, num_faces, crs)
        copy.replace(part)


def _require_same_shape(copy: Path, path: Path, points: np.ndarray, num_faces: int | None, crs: CRS) -> None:
    try:
        shape = reader_of(path)(copy)
    except UnreadableFile as error:
        raise read_back_error(path, f"it is damaged ({str(error).replace(str(copy), path.name)[:120]})") from error
    found = vertices_of(shape)
    if found.shape != points.shape:
        raise read_back_error(path, f"it has {len(found)} points in place of {len(points)}")
    faces = len(shape.faces) if isinstance(shape, Mesh) else None
    if faces != num_faces:
        raise read_back_error(path, f"it has {faces or 'no'} triangles in place of {num_faces or 'none'}")
    difference = None if shape.crs is None else crs_difference(shape.crs, crs)
    if shape.crs is None or difference is not None:
        raise read_back_error(path, f"its CRS is {difference or 'missing'}")
    step = np.full(3, _STEP_DEG if is_geographic(crs) else _STEP) + _SHARE * np.ptp(points, axis=0)
    step[2] = _STEP + _SHARE * float(np.ptp(points[:, 2]))
    if not (np.abs(found - points) <= step).all():
        raise read_back_error(path, "its points differ from those that were written")
