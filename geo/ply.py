"""Clouds written as PLY with double coordinates, which CloudCompare, MeshLab and Open3D read; see `geo.ply_reading`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geo.files import write_whole

_COLOURS = ("red", "green", "blue")


def write_ply(path: str | Path, points_crs: np.ndarray, *, rgb: np.ndarray, scalars: dict[str, np.ndarray]) -> None:
    """Write a cloud as binary little-endian PLY, whole or not at all.

    Parameters
    ----------
    points_crs : (N, 3) float64, in crs
        Stored as double x, y, z.
    rgb : (N, 3) uint8
    scalars : dict of (N,)
        Further properties, stored as float; names without spaces, with their unit, e.g. ``"depth_m"``.

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
        fields.append((name, "<f4"))
    table = np.empty(len(points), dtype=fields)
    for values, names in ((points.T, "xyz"), (np.asarray(rgb, dtype=np.uint8).T, _COLOURS)):
        for column, name in zip(values, names, strict=True):
            table[name] = column
    for name, values in scalars.items():
        table[name] = values
    words = {"<f8": "double", "u1": "uchar", "<f4": "float"}
    properties = "".join(f"property {words[kind]} {name}\n" for name, kind in fields)
    head = "ply\nformat binary_little_endian 1.0\ncomment bathynerf\n"
    header = f"{head}element vertex {len(points)}\n{properties}end_header\n"
    with write_whole(path) as stream:
        stream.write(header.encode())
        stream.write(table.view(np.uint8).data)
