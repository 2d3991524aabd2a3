"""Meshes written as Wavefront OBJ, in decimals that keep a tenth of a millimetre at any easting."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import crs_code, is_geographic
from geo.files import write_whole
from geo.shapes import Mesh

MARK = b"# bathynerf\n"
CRS_COMMENT = b"# crs "
_DECIMALS_M, _DECIMALS_DEG = 4, 10
_CHUNK = 100_000


def write_obj(path: str | Path, mesh: Mesh, crs: CRS) -> None:
    """Write a mesh in crs, whole or not at all.

    Colours stand behind the coordinates of each vertex, 0 to 1, as MeshLab, Blender and CloudCompare read them. The CRS
    is in a comment; the format has no place for it.

    Raises
    ------
    UnwritableFile
        If the file cannot be written.
    """
    horizontal = _DECIMALS_DEG if is_geographic(crs) else _DECIMALS_M
    vertex = f"v %.{horizontal}f %.{horizontal}f %.{_DECIMALS_M}f"
    table = mesh.vertices
    if mesh.rgb is not None:
        vertex += " %.4f %.4f %.4f"
        table = np.column_stack([table, mesh.rgb / 255.0])
    with write_whole(path) as stream:
        stream.write(MARK + CRS_COMMENT + f"{crs_code(crs) or crs.to_wkt()}\n".encode())
        for rows, form in ((table, vertex), (mesh.faces + 1, "f %d %d %d")):
            for first in range(0, len(rows), _CHUNK):
                part = rows[first : first + _CHUNK]
                stream.write(("\n".join([form] * len(part)) % tuple(part.ravel()) + "\n").encode())
