"""PLY files read and written: clouds and meshes, ASCII or binary of either byte order, double coordinates.

Source: the PLY format of the Stanford 3D scanning repository. Every element becomes a table of columns; ASCII
is read as if it were binary with doubles throughout.

By hand: plyfile is under the GNU General Public License, trimesh 5.2.0 rounds to single precision (0.25 m at a northing
of 5,311,475 m) and drops the CRS. CloudCompare opens properties whose name begins with ``scalar_`` as scalar fields,
without the prefix.
"""

import re
import struct
from dataclasses import replace
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
    colours = None if rgb is None else np.asarray(rgb, dtype=np.uint8)
    for values in (points, points if colours is None else colours):
        if values.shape != (len(points), 3):
            raise ValueError(f"expected points and colours (N, 3), got {points.shape} and {values.shape}")
    columns = dict(zip("xyz", points.T, strict=True))
    columns |= {} if colours is None else dict(zip(_COLOURS, colours.T, strict=True))
    fields = [(name, "<f8" if name in "xyz" else "u1") for name in columns]
    for name, values in (scalars or {}).items():
        if not name.isidentifier() or name in columns:
            raise ValueError(f"{name!r} cannot name a property; expected one word that is not in use")
        if np.shape(values) != points.shape[:1]:
            raise ValueError(f"{name} has shape {np.shape(values)}, expected {points.shape[:1]}")
        columns[SCALAR + name] = values
        fields.append((SCALAR + name, "<f4"))
    lines = ["ply", "format binary_little_endian 1.0", "comment bathynerf", *_crs_comments(crs)]
    lines += [f"element vertex {len(points)}", *(f"property {_WORDS[kind]} {name}" for name, kind in fields)]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with write_whole(path) as stream:
        stream.write("\n".join([*lines, "end_header", ""]).encode())
        for rows in portions(len(points), _PORTION):
            table = np.empty(len(points[rows]), dtype=fields)
            for name, values in columns.items():
                table[name] = values[rows]
            stream.write(table.view(np.uint8).data)
        faces = np.empty((0, 3)) if faces is None else faces
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
    count_kind: str = ""


class _Element(NamedTuple):
    name: str
    num: int
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
        form, elements, start, crs_text = _header(data)
        body = memoryview(data)[start:]
        if form == "ascii":
            body, elements = _binary_of_ascii(body, elements)
        tables: dict[str, dict] = {}
        for element in elements:
            tables[element.name], used = _table(body, element, _ORDERS[form])
            body = body[used:]
        shape = _shape(tables)
    except _Damaged as error:
        raise UnreadableFile(f"{path} cannot be read as PLY: {error}.") from error
    if not crs_text:
        return shape
    crs, notes = crs_named(crs_text, path)
    return replace(shape, crs=crs, notes=notes)


def _header(data: bytes) -> tuple[str, list[_Element], int, str]:
    """Format, elements, where the body starts, and the CRS of comments, or ""."""
    end = re.search(rb"^end_header[^\n]*\n", data, re.MULTILINE)
    if not data.startswith(b"ply") or end is None:
        raise _Damaged('it does not begin with "ply" and a header up to "end_header"')
    form, code, wkt = "", "", ""
    elements: list[_Element] = []
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
    if not form:
        raise _Damaged("its header names no format")
    return form, elements, end.end(), code or wkt


def _binary_of_ascii(body: memoryview, elements: list[_Element]) -> tuple[memoryview, list[_Element]]:
    """Body and elements as if all numbers had been stored as little-endian doubles."""
    try:
        numbers = np.array(bytes(body).split(), dtype=bytes).astype("<f8")
    except ValueError as error:
        raise _Damaged(f"its body has a word that is not a number ({str(error)[:60]})") from error
    doubles = [
        e._replace(properties=[_Property(p.name, "d", p.count_kind and "d") for p in e.properties]) for e in elements
    ]
    return memoryview(numbers.tobytes()), doubles


def _table(body: memoryview, element: _Element, order: str) -> tuple[dict[str, np.ndarray | _Lists], int]:
    """The columns of an element by name, and the bytes it takes."""
    kind, count, properties = element
    if sum(struct.calcsize(order + (p.count_kind or p.kind)) for p in properties) * count > len(body):
        raise _Damaged(f"it ends before the last of its {count} elements of kind {kind}")
    try:
        first = _row(body, 0, properties, order)[0] if count else [(0.0,)] * len(properties)
        fields: list[tuple] = []
        # By number, as a name may stand twice; the last one counts.
        for number, (p, values) in enumerate(zip(properties, first, strict=True)):
            fields += [(f"count {number}", order + p.count_kind)] if p.count_kind else []
            fields.append((f"{number}", order + p.kind, (len(values),) if p.count_kind else ()))
        dtype = np.dtype(fields)
        lists = {number: len(first[number]) for number, p in enumerate(properties) if p.count_kind}
        if dtype.itemsize * count <= len(body):
            rows = np.frombuffer(body, dtype, count)
            if all((rows[f"count {number}"] == length).all() for number, length in lists.items()):
                return {
                    p.name: _Lists(np.full(count, lists[number]), rows[f"{number}"].ravel())
                    if p.count_kind
                    else rows[f"{number}"]
                    for number, p in enumerate(properties)
                }, dtype.itemsize * count
        # Lists of several lengths.
        columns: list[list[float]] = [[] for _ in properties]
        counts: list[list[int]] = [[] for _ in properties]
        offset = 0
        for _ in range(count):
            row, offset = _row(body, offset, properties, order)
            for column, lengths, value in zip(columns, counts, row, strict=True):
                column.extend(value)
                lengths.append(len(value))
    except (struct.error, ValueError, OverflowError) as error:
        raise _Damaged(f"it ends, or breaks, within its elements of kind {kind}") from error
    table: dict[str, np.ndarray | _Lists] = {}
    for p, column, lengths in zip(properties, columns, counts, strict=True):
        flat = np.array(column, dtype=order + p.kind)
        table[p.name] = _Lists(np.array(lengths), flat) if p.count_kind else flat
    return table, offset


def _row(body: memoryview, offset: int, properties: list[_Property], order: str) -> tuple[list[tuple], int]:
    """Values of each property in the row at an offset, and the offset of the next."""
    values = []
    for p in properties:
        length = 1
        if p.count_kind:
            length = int(struct.unpack_from(order + p.count_kind, body, offset)[0])
            offset += struct.calcsize(order + p.count_kind)
        form = f"{order}{length}{p.kind}"
        values.append(struct.unpack_from(form, body, offset))
        offset += struct.calcsize(form)
    return values, offset


def _shape(tables: dict[str, dict]) -> Mesh | Cloud:
    vertex = tables.get("vertex", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise _Damaged("it has no vertices with x, y and z")
    if tables.get("tristrips"):
        raise _Damaged("it stores triangle strips; export it with a list of faces")
    points = np.stack([vertex[axis] for axis in "xyz"], axis=-1)
    if points.dtype.itemsize == 4:
        largest = np.abs(points[np.isfinite(points)]).max(initial=0.0)
        step = float(np.spacing(largest))
        if step > _COARSEST_STEP:
            raise _Damaged(
                f"it stores coordinates up to {largest:.10g} in single precision, with a resolution of {step:.3g}; "
                "export it with double precision"
            )
    points = points.astype(np.float64)
    rgb = None
    if set(_COLOURS) <= vertex.keys() and all(vertex[name].dtype.kind in "uf" for name in _COLOURS):
        stored = np.stack([vertex[name] for name in _COLOURS], axis=-1)
        rgb = stored.astype(np.uint8) if ((stored >= 0) & (stored <= 255)).all() else None
    face = tables.get("face", {})
    corners = face.get("vertex_indices", face.get("vertex_index"))
    if isinstance(corners, _Lists) and len(corners.counts):
        return Mesh(points, triangulated(corners.counts, corners.values), rgb=rgb)
    scalars = {
        name.removeprefix(SCALAR): np.array(values)
        for name, values in vertex.items()
        if name not in {"x", "y", "z", *_COLOURS} and isinstance(values, np.ndarray)
    }
    # As CloudCompare and PDAL keep the classes and flags of LAS.
    by_name = {name.lower().replace(" ", "_"): values for name, values in scalars.items()}
    withheld = next((by_name[name] for name in _WITHHELD if name in by_name), None)
    return Cloud(
        points,
        rgb=rgb,
        extra=scalars,
        classification=as_classes(by_name.get("classification")),
        withheld=None if withheld is None or not np.isin(withheld, (0, 1)).all() else withheld.astype(bool),
    )
