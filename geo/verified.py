"""Verification of written clouds and meshes by their own readers, before they take their place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pyproj import CRS

from geo.compatibility import crs_difference
from geo.crs import is_geographic
from geo.errors import UnreadableFile, UnwritableFile
from geo.files import write_whole_at
from geo.read_back import unreadable
from geo.reading import reader_of
from geo.shapes import Mesh, vertices_of

# What formats in text or single precision round coordinates to, beside a share of the extent; of degrees a millimetre.
_STEP, _STEP_DEG, _SHARE = 1e-3, 1e-8, 3e-7


def write_verified(
    path: str | Path, write: Callable[[Path], None], points: np.ndarray, num_faces: int | None, crs: CRS
) -> None:
    """Write a shape, whole or not at all, and only as it reads again.

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
        If it cannot be written, or reads otherwise than it was written.
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
        _require(copy, path, points, num_faces, crs)
        copy.replace(part)


def _require(copy: Path, path: Path, points: np.ndarray, num_faces: int | None, crs: CRS) -> None:
    try:
        shape = reader_of(path)(copy)
    except UnreadableFile as error:
        raise unreadable(path, f"it is damaged ({str(error).replace(str(copy), path.name)[:120]})") from error
    found = vertices_of(shape)
    if found.shape != points.shape:
        raise unreadable(path, f"it has {len(found)} points in place of {len(points)}")
    faces = len(shape.faces) if isinstance(shape, Mesh) else None
    if faces != num_faces:
        raise unreadable(path, f"it has {faces or 'no'} triangles in place of {num_faces or 'none'}")
    difference = None if shape.crs is None else crs_difference(shape.crs, crs)
    if shape.crs is None or difference is not None:
        raise unreadable(path, f"its CRS is {difference or 'missing'}")
    step = np.full(3, _STEP_DEG if is_geographic(crs) else _STEP) + _SHARE * np.ptp(points, axis=0)
    step[2] = _STEP + _SHARE * float(np.ptp(points[:, 2]))
    if not (np.abs(found - points) <= step).all():
        raise unreadable(path, "its points are others than those that were written")
