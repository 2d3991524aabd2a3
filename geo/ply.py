"""PLY files read and written: clouds and meshes, ASCII or binary of either byte order, double coordinates.

Source: the PLY format of the Stanford 3D scanning repository. Every element becomes a table of columns; ASCII
is read as if it were binary with doubles throughout.

No library reads or writes it here. plyfile, the usual one, is under the GNU General Public License (3 or later), which
would bind anyone who redistributes this package under the Apache License, and reads lists row by row. trimesh 5.2.0
writes in single precision, and rounds those of ASCII files that say "float" so: at a northing of 5,311,475 m
a mesh comes back 0.25 m off. It drops comments, and with them the CRS, and refuses binary files with polygons of
several sizes. Of 250,000 vertices with 500,000 triangles in ASCII it takes 2.3 s of processor time, this module 1.3 s.

CloudCompare opens properties whose name begins with ``scalar_`` as scalar fields, and shows them without the prefix.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS

from geo.crs import crs_code, crs_named
from geo.errors import UnreadableFile
from geo.files import existing_file, write_whole
from geo.shapes import Cloud, Mesh, as_classes, portions, triangulated

SCALAR = "scalar_"
# Before the code of the CRS, and before each piece of its WKT.
CRS_COMMENT, WKT_COMMENT = "comment crs ", "comment crs_wkt "
_WORDS = {"<f8": "double", "u1": "uchar", "<f4": "float"}
# Readers built on rply, CloudCompare among them, refuse longer lines in a header.
_LONGEST_COMMENT = 200
_TYPES = {
    "char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h", "ushort": "H",
    "uint16": "H", "int": "i", "int32": "i", "uint": "I", "uint32": "I", "float": "f", "float32": "f",
    "double": "d", "float64": "d",
}  # fmt: skip
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_COLOURS = ("red", "green", "blue")
_WITHHELD = ("withheld", "withheld_flag", "withheldflag")
# A coordinate of 5,194,743 in single precision steps by 0.5 m; at 5 mm it begins to spoil a comparison.
_COARSEST_STEP = 0.005
# Rows that are written at a time.
_PORTION = 500_000


def write_ply(
    path: str | Path,
    points_crs: np.ndarray,
    *,
    rgb: np.ndarray | None = None,
    scalars: dict[str, np.ndarray] | None = None,
    crs: CRS | None = None,
    faces: np.ndarray | None = None,
) -> None:
    """Write a cloud or a mesh as binary little-endian PLY, whole or not at all.

    Parameters
    ----------
    points_crs : (N, 3) float64, in crs
        Stored as double x, y, z.
    rgb : (N, 3) uint8, optional
    scalars : dict of (N,), optional
        Further properties, stored as float with ``scalar_`` before their names; names without spaces, with their unit,
        e.g. ``"depth_m"``.
    crs : pyproj.CRS, optional
        Named in a comment, ``crs EPSG:25832+5778``; where it has no code, as WKT in several (``crs_wkt``).
    faces : (F, 3) int, optional
        Triangles.
    """
    points = np.asarray(points_crs, dtype=np.float64)
    columns: dict[Sequence[str], np.ndarray] = {"xyz": points}
    if rgb is not None:
        columns[_COLOURS] = np.asarray(rgb, dtype=np.uint8)
    for values in columns.values():
        if values.shape != (len(points), 3):
            raise ValueError(f"expected points and colours (N, 3), got {points.shape} and {values.shape}")
    scalars = scalars or {}
    fields = [(name, "<f8" if names == "xyz" else "u1") for names in columns for name in names]
    for name, values in scalars.items():
        if not name.isidentifier() or name in dict(fields):
            raise ValueError(f"{name!r} cannot name a property; expected one word that is not in use")
        if np.shape(values) != points.shape[:1]:
            raise ValueError(f"{name} has shape {np.shape(values)}, expected {points.shape[:1]}")
        fields.append((SCALAR + name, "<f4"))
    lines = ["ply", "format binary_little_endian 1.0", "comment bathynerf", *_crs_comments(crs)]
    lines += [f"element vertex {len(points)}", *(f"property {_WORDS[kind]} {name}" for name, kind in fields)]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with write_whole(path) as stream:
        stream.write("\n".join([*lines, "end_header", ""]).encode())
        for rows in portions(len(points), _PORTION):
            table = np.empty(len(points[rows]), dtype=fields)
            for names, column in columns.items():
                for name, values in zip(names, column[rows].T, strict=True):
                    table[name] = values
            for name, values in scalars.items():
                table[SCALAR + name] = values[rows]
            stream.write(table.view(np.uint8).data)
        if faces is None:
            return
        for rows in portions(len(faces), _PORTION):
            triangles = np.empty(len(faces[rows]), dtype=[("corners", "u1"), ("vertices", "<i4", 3)])
            triangles["corners"], triangles["vertices"] = 3, faces[rows]
            stream.write(triangles.view(np.uint8).data)


def _crs_comments(crs: CRS | None) -> list[str]:
    if crs is None:
        return []
    code = crs_code(crs)
    if code is not None:
        return [CRS_COMMENT + code]
    wkt = crs.to_wkt()
    return [WKT_COMMENT + wkt[first : first + _LONGEST_COMMENT] for first in range(0, len(wkt), _LONGEST_COMMENT)]


class _Damaged(Exception):
    """Fault of a file, to be completed with its name."""


class _Property(NamedTuple):
    """A column: ``kind`` of its values and, for lists, ``count_kind`` of their lengths, as in `struct`."""

    name: str
    kind: str
    count_kind: str | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


class _Lists(NamedTuple):
    """A column of lists, one after the other."""

    counts: np.ndarray
    values: np.ndarray


def read_ply(path: str | Path) -> Mesh | Cloud:
    """Read a PLY file: a mesh if it has faces (polygons are cut into triangles), else a cloud.

    The CRS is that of the comments that `geo.ply.write_ply` leaves; the format has no place for one.
    """
    path = existing_file(path)
    data = path.read_bytes()
    try:
        is_ascii, order, elements, start, crs_text = _header(data)
        tables: dict[str, dict] = {}
        body = memoryview(data)[start:]
        if is_ascii:
            body, elements = _binary_of_ascii(body, elements)
        for element in elements:
            tables[element.name], used = _table(body, element, order)
            body = body[used:]
        shape = _shape(tables)
    except _Damaged as error:
        raise UnreadableFile(f"{path} cannot be read as PLY: {error}.") from error
    if not crs_text:
        return shape
    crs, notes = crs_named(crs_text, path)
    return replace(shape, crs=crs, notes=notes)


def _header(data: bytes) -> tuple[bool, str, list[_Element], int, str]:
    """Header: is it ASCII, the byte order, the elements, where the body starts, and the CRS of comments, or ""."""
    end = re.search(rb"^end_header[^\n]*\n", data, re.MULTILINE)
    if not data.startswith(b"ply") or end is None:
        raise _Damaged('it does not begin with "ply" and a header up to "end_header"')
    form: str | None = None
    elements: list[_Element] = []
    code, wkt = "", ""
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        try:
            match words:
                case ["comment", "crs", *_]:
                    code = line.removeprefix(CRS_COMMENT)
                case ["comment", "crs_wkt", *_]:
                    wkt += line.removeprefix(WKT_COMMENT)
                # As others have it.
                case ["comment" | "obj_info", name] if name.upper().startswith("EPSG:"):
                    code = code or name
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", form, _] if form in _ORDERS:
                    pass
                case ["element", name, count] if int(count) >= 0:
                    elements.append(_Element(name, int(count), []))
                case ["property", "list", count_kind, kind, name]:
                    elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[count_kind]))
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, _TYPES[kind]))
                case _:
                    raise ValueError(line)
        except (ValueError, KeyError, IndexError) as error:
            raise _Damaged(f'the line "{line[:60]}" of its header is not understood') from error
    if form is None:
        raise _Damaged("its header names no format")
    return form == "ascii", _ORDERS[form], elements, end.end(), code or wkt


def _binary_of_ascii(body: memoryview, elements: list[_Element]) -> tuple[memoryview, list[_Element]]:
    """Body and elements as if all numbers had been stored as little-endian doubles."""
    try:
        numbers = np.array(bytes(body).split(), dtype=bytes).astype("<f8")
    except ValueError as error:
        raise _Damaged(f"its body has a word that is not a number ({str(error)[:60]})") from error
    doubles = [
        _Element(e.name, e.count, [_Property(p.name, "d", "d" if p.count_kind else None) for p in e.properties])
        for e in elements
    ]
    return memoryview(numbers.tobytes()), doubles


def _table(body: memoryview, element: _Element, order: str) -> tuple[dict[str, np.ndarray | _Lists], int]:
    """The columns of an element by name, and the bytes it takes."""
    shortest = sum(struct.calcsize(order + (p.count_kind or p.kind)) for p in element.properties)
    if shortest * element.count > len(body):
        raise _Damaged(f"it ends before the last of its {element.count} elements of kind {element.name}")
    if element.count == 0:
        lists = _Lists(np.zeros(0, np.int64), np.zeros(0))
        return {p.name: lists if p.count_kind else np.zeros(0) for p in element.properties}, 0
    return _even_table(body, element, order) or _uneven_table(body, element, order)


def _even_table(body: memoryview, element: _Element, order: str) -> tuple[dict[str, np.ndarray | _Lists], int] | None:
    """Result of `_table` if all lists of a column are as long as its first one; else None."""
    _, lengths, _ = _row(body, 0, element, order)
    fields: list[tuple] = []
    for index, (p, length) in enumerate(zip(element.properties, lengths, strict=True)):
        if p.count_kind:
            fields.append((f"count {index}", order + p.count_kind))
        fields.append((f"value {index}", order + p.kind, (length,) if p.count_kind else ()))
    dtype = np.dtype(fields)
    if dtype.itemsize * element.count > len(body):
        return None
    rows = np.frombuffer(body, dtype, element.count)
    columns: dict[str, np.ndarray | _Lists] = {}
    for index, (p, length) in enumerate(zip(element.properties, lengths, strict=True)):
        values = rows[f"value {index}"]
        columns[p.name] = values
        if p.count_kind:
            if (rows[f"count {index}"] != length).any():
                return None
            columns[p.name] = _Lists(np.full(element.count, length), values.reshape(-1))
    return columns, dtype.itemsize * element.count


def _uneven_table(body: memoryview, element: _Element, order: str) -> tuple[dict[str, np.ndarray | _Lists], int]:
    """Result of `_table`, read row by row."""
    columns: list[list[float]] = [[] for _ in element.properties]
    counts: list[list[int]] = [[] for _ in element.properties]
    offset = 0
    for _ in range(element.count):
        values, lengths, offset = _row(body, offset, element, order)
        for column, lengths_so_far, value, length in zip(columns, counts, values, lengths, strict=True):
            column.extend(value)
            lengths_so_far.append(length)
    return {
        p.name: _Lists(np.array(length), np.array(column)) if p.count_kind else np.array(column)
        for p, column, length in zip(element.properties, columns, counts, strict=True)
    }, offset


def _row(body: memoryview, offset: int, element: _Element, order: str):
    """Values and their numbers, property by property, of the row at an offset, and the offset of the next."""
    values, lengths = [], []
    try:
        for p in element.properties:
            length = 1
            if p.count_kind:
                length = int(struct.unpack_from(order + p.count_kind, body, offset)[0])
                offset += struct.calcsize(order + p.count_kind)
            form = f"{order}{length}{p.kind}"
            values.append(struct.unpack_from(form, body, offset))
            lengths.append(length)
            offset += struct.calcsize(form)
    except (struct.error, ValueError, OverflowError) as error:
        raise _Damaged(f"it ends, or breaks, within its elements of kind {element.name}") from error
    return values, lengths, offset


def _shape(tables: dict[str, dict]) -> Mesh | Cloud:
    vertex = tables.get("vertex", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise _Damaged("it has no vertices with x, y and z")
    if tables.get("tristrips"):
        raise _Damaged("it stores triangle strips; export it with a list of faces")
    points = np.stack([vertex[axis] for axis in "xyz"], axis=-1)
    if points.dtype == np.float32:
        _require_fine_steps(points)
    points = points.astype(np.float64)
    face = tables.get("face", {})
    corners = face.get("vertex_indices", face.get("vertex_index"))
    if isinstance(corners, _Lists) and len(corners.counts):
        return Mesh(points, triangulated(corners.counts, corners.values), rgb=_rgb(vertex))
    scalars = _scalars(vertex)
    # As CloudCompare and PDAL keep the classes and flags of LAS.
    by_name = {name.lower().replace(" ", "_"): values for name, values in scalars.items()}
    withheld = next((by_name[name] for name in _WITHHELD if name in by_name), None)
    return Cloud(
        points,
        rgb=_rgb(vertex),
        extra=scalars,
        classification=as_classes(by_name.get("classification")),
        withheld=None if withheld is None or not np.isin(withheld, (0, 1)).all() else withheld.astype(bool),
    )


def _require_fine_steps(points: np.ndarray) -> None:
    largest = np.abs(points[np.isfinite(points)]).max(initial=0.0)
    step = float(np.spacing(largest))
    if step > _COARSEST_STEP:
        raise _Damaged(
            f"it stores coordinates up to {largest:.10g} in single precision, with a resolution of {step:.3g}; "
            "export it with double precision"
        )


def _rgb(vertex: dict[str, np.ndarray]) -> np.ndarray | None:
    if not set(_COLOURS) <= vertex.keys() or any(vertex[name].dtype.kind not in "uf" for name in _COLOURS):
        return None
    rgb = np.stack([vertex[name] for name in _COLOURS], axis=-1)
    return rgb.astype(np.uint8) if ((rgb >= 0) & (rgb <= 255)).all() else None


def _scalars(vertex: dict[str, np.ndarray | _Lists]) -> dict[str, np.ndarray]:
    known = {"x", "y", "z", *_COLOURS}
    return {
        name.removeprefix(SCALAR): np.array(values)
        for name, values in vertex.items()
        if name not in known and isinstance(values, np.ndarray)
    }
