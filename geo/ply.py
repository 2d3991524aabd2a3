"""Clouds and meshes written as PLY with double coordinates; see `geo.ply_reading`.

CloudCompare opens properties whose name begins with ``scalar_`` as scalar fields, and shows them without the prefix.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import crs_code
from geo.files import write_whole

SCALAR = "scalar_"
# Before the code of the CRS, and before each piece of its WKT.
CRS_COMMENT, WKT_COMMENT = "comment crs ", "comment crs_wkt "
_COLOURS = ("red", "green", "blue")
_WORDS = {"<f8": "double", "u1": "uchar", "<f4": "float"}
# Readers built on rply, CloudCompare among them, refuse longer lines in a header.
_LONGEST_COMMENT = 200


def write_ply(
    path: str | Path,
    points_crs: np.ndarray,
    *,
    rgb: np.ndarray,
    scalars: dict[str, np.ndarray],
    crs: CRS | None = None,
    faces: np.ndarray | None = None,
) -> None:
    """Write a cloud or a mesh as binary little-endian PLY, whole or not at all.

    Parameters
    ----------
    points_crs : (N, 3) float64, in crs
        Stored as double x, y, z.
    rgb : (N, 3) uint8
    scalars : dict of (N,)
        Further properties, stored as float with ``scalar_`` before their names; names without spaces, with their unit,
        e.g. ``"depth_m"``.
    crs : pyproj.CRS, optional
        Named in a comment, ``crs EPSG:25832+5778``; where it has no code, as WKT in several (``crs_wkt``).
    faces : (F, 3) int, optional
        Triangles.

    Raises
    ------
    UnwritableFile
        If the file cannot be written.
    ValueError
        If shapes differ or a name cannot be one.
    """
    points = np.asarray(points_crs, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or np.shape(rgb) != points.shape:
        raise ValueError(f"expected points and colours (N, 3), got {points.shape} and {np.shape(rgb)}")
    fields = [(axis, "<f8") for axis in "xyz"] + [(colour, "u1") for colour in _COLOURS]
    for name, values in scalars.items():
        if not name.isidentifier() or name in dict(fields):
            raise ValueError(f"{name!r} cannot name a property; expected one word that is not in use")
        if np.shape(values) != points.shape[:1]:
            raise ValueError(f"{name} has shape {np.shape(values)}, expected {points.shape[:1]}")
        fields.append((SCALAR + name, "<f4"))
    table = np.empty(len(points), dtype=fields)
    for values, names in ((points.T, "xyz"), (np.asarray(rgb, dtype=np.uint8).T, _COLOURS)):
        for column, name in zip(values, names, strict=True):
            table[name] = column
    for name, values in scalars.items():
        table[SCALAR + name] = values
    lines = ["ply", "format binary_little_endian 1.0", "comment bathynerf", *_crs_comments(crs)]
    lines += [f"element vertex {len(points)}", *(f"property {_WORDS[kind]} {name}" for name, kind in fields)]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with write_whole(path) as stream:
        stream.write("\n".join([*lines, "end_header", ""]).encode())
        stream.write(table.view(np.uint8).data)
        if faces is not None:
            triangles = np.empty(len(faces), dtype=[("corners", "u1"), ("vertices", "<i4", 3)])
            triangles["corners"], triangles["vertices"] = 3, faces
            stream.write(triangles.view(np.uint8).data)


def _crs_comments(crs: CRS | None) -> list[str]:
    if crs is None:
        return []
    code = crs_code(crs)
    if code is not None:
        return [CRS_COMMENT + code]
    wkt = crs.to_wkt()
    return [WKT_COMMENT + wkt[first : first + _LONGEST_COMMENT] for first in range(0, len(wkt), _LONGEST_COMMENT)]
