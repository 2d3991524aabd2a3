"""Meshes as Wavefront OBJ, and as glTF and GLB (read by the extra ``gltf``), turned so that z is up.

trimesh 5.2.0 reads OBJ in two thirds of the time, but counts negative vertex numbers from the end of the file instead
of the face, takes vertex 0 for the last vertex, and drops the CRS.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from geo.crs import crs_code, crs_named, has_height, height_unit_m, horizontal_unit, is_geographic
from geo.errors import UnreadableFile, UnwritableFile, first_line
from geo.files import existing_file, library_for, write_whole
from geo.frames import LocalFrame
from geo.projection import is_to_scale
from geo.shapes import Cloud, Mesh, portions, triangulated

MARK = b"# bathynerf\n"
CRS_COMMENT = b"# crs "
_DECIMALS_M, _DECIMALS_DEG = 4, 10
# Rows that are written at a time.
_PORTION = 100_000


def read_obj(path: str | Path) -> Mesh | Cloud:
    """Read an OBJ file: a mesh if it has faces (polygons are cut into triangles), else a cloud.

    Faces count vertices from the first (1, 2, ...) or back from the last one so far (-1, -2, ...); texture and normal
    numbers (``7/3/2``) are ignored.
    """
    path = existing_file(path)
    text = path.read_bytes().replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    vertex_lines, face_lines, vertices_before, crs_comment = [], [], [], b""
    for line in text.splitlines():
        if line.startswith(CRS_COMMENT):
            crs_comment = line.removeprefix(CRS_COMMENT)
        words = line.split(b"#", 1)[0].split()
        if not words:
            continue
        if words[0] == b"v":
            vertex_lines.append(words[1:4])
        elif words[0] == b"f":
            face_lines.append(words[1:])
            vertices_before.append(len(vertex_lines))
    try:
        vertices = np.array(vertex_lines, dtype=bytes).astype(np.float64).reshape(-1, 3)
    except ValueError as error:
        raise UnreadableFile(
            f"{path} has a vertex line that is not three numbers ({str(error)[:80]}); export it again."
        ) from error
    crs, notes = crs_named(crs_comment.decode("utf-8", "replace"), path) if crs_comment else (None, ())
    if not face_lines:
        return Cloud(vertices, crs=crs, notes=notes)
    return Mesh(vertices, _faces(face_lines, vertices_before, path), crs=crs, notes=notes)


def _faces(lines: list[list[bytes]], vertices_before: list[int], path: Path) -> np.ndarray:
    counts = np.array([len(words) for words in lines])
    try:
        numbers = np.array([word.split(b"/", 1)[0] for words in lines for word in words], dtype=bytes).astype(np.int64)
    except (ValueError, OverflowError) as error:
        raise UnreadableFile(
            f"{path} has a face line that is not whole numbers ({str(error)[:80]}); export it again."
        ) from error
    before = np.repeat(vertices_before, counts)
    # Vertex 0, which OBJ does not have, becomes -1 and is refused with the others out of range.
    corners = np.where(numbers < 0, before + numbers, numbers - 1)
    return triangulated(counts, corners)


def write_obj(path: str | Path, mesh: Mesh, crs: CRS) -> None:
    """Write a mesh in crs, which stands in a comment, whole or not at all.

    Colours stand behind the coordinates of each vertex, 0 to 1, as MeshLab, Blender and CloudCompare read them.
    """
    horizontal = _DECIMALS_DEG if is_geographic(crs) else _DECIMALS_M
    vertex = f"v %.{horizontal}f %.{horizontal}f %.{_DECIMALS_M}f" + ("" if mesh.rgb is None else " %.4f %.4f %.4f")
    with write_whole(path) as stream:
        stream.write(MARK + CRS_COMMENT + f"{crs_code(crs) or crs.to_wkt()}\n".encode())
        for rows in portions(len(mesh.vertices), _PORTION):
            colour = () if mesh.rgb is None else (mesh.rgb[rows] / 255.0,)
            np.savetxt(stream, np.column_stack([mesh.vertices[rows], *colour]), fmt=vertex)
        for rows in portions(len(mesh.faces), _PORTION):
            np.savetxt(stream, mesh.faces[rows] + 1, fmt="f %d %d %d")


# glTF 2.0, section 3.3: y is up and z points forward. East, north, up are x, -z, y.
_GRID, _TOPOCENTRIC = "grid", "topocentric"
# Component types and targets of buffers, glTF 2.0, section 3.6.
_TYPES = {"<f4": 5126, "<u4": 5125, "<u2": 5123}
_TARGETS = {"POSITION": 34962, "COLOR_0": 34962, "indices": 34963}
# Linear light, 0 to 65535, of each value of sRGB (IEC 61966-2-1), as colours of vertices have to be.
_SRGB = np.arange(256) / 255.0
_LINEAR = np.round(65535 * np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)).astype("<u2")
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def read_gltf(path: str | Path) -> Mesh | Cloud:
    """Read a glTF or GLB file: a mesh if it has triangles, else a cloud; in the CRS that `write_glb` stored, if any."""
    path = existing_file(path)
    trimesh = library_for(path, "trimesh", "gltf")
    # trimesh raises errors of many kinds for damaged files (KeyError, struct.error, JSONDecodeError, ...).
    try:
        scene = trimesh.load_scene(path, process=False)
        parts = scene.dump()
        meshes = [part for part in parts if hasattr(part, "faces")]
        vertices = [np.asarray(part.vertices, dtype=np.float64) for part in meshes or parts]
    except Exception as error:
        raise UnreadableFile(f"{path} cannot be read as glTF ({first_line(error)}); export it again.") from error
    points = np.concatenate([np.empty((0, 3)), *vertices]) @ _Z_UP.T
    points, crs, notes = _placed(points, scene.metadata, path)
    if not meshes:
        return Cloud(points, crs=crs, notes=notes)
    before = np.cumsum([0, *(len(part) for part in vertices)])
    faces = [np.asarray(part.faces, dtype=np.int64) + first for part, first in zip(meshes, before, strict=False)]
    # The copies that `dump` makes lack the colours of vertices that have a material.
    visuals = [scene.geometry[part.metadata["name"]].visual for part in meshes]
    rgb = _rgb(visuals, [len(part) for part in vertices])
    return Mesh(points, np.concatenate(faces), rgb=rgb, crs=crs, notes=notes)


def _placed(points: np.ndarray, extras: dict, path: Path) -> tuple[np.ndarray, CRS | None, tuple[str, ...]]:
    """Points in the CRS that `write_glb` stored in the extras, and notes; points unchanged where there is none."""
    origin = extras.get("origin")
    if extras.get("made_by") != "bathynerf" or not isinstance(extras.get("crs"), str) or not isinstance(origin, list):
        return points, None, ()
    crs, notes = crs_named(extras["crs"], path)
    if crs is None or len(origin) != 3:
        return points, None, notes
    if extras.get("axes") == _TOPOCENTRIC:
        return LocalFrame(crs, (origin[0], origin[1], origin[2])).crs_from_local(points), crs, notes
    return points / _grid_units(crs) + np.array(origin, dtype=np.float64), crs, notes


def _grid_units(crs: CRS) -> np.ndarray:
    """Metres of one unit of each axis (3,) of a projected CRS."""
    across = horizontal_unit(crs)
    return np.array([across, across, height_unit_m(crs) if has_height(crs) else 1.0])


def _rgb(visuals: list, counts: list[int]) -> np.ndarray | None:
    """Colours (V, 3) uint8 of all vertices in sRGB; white where a part has none, None if all have none."""
    colours = [_rgb_of(visual) for visual in visuals]
    white = [np.full((count, 3), 255, dtype=np.uint8) for count in counts]
    parts = [other if rgb is None else rgb for rgb, other in zip(colours, white, strict=True)]
    return None if all(rgb is None for rgb in colours) else np.concatenate(parts)


def _rgb_of(visual: Any) -> np.ndarray | None:
    """Colours (V, 3) uint8 of a part in sRGB: those of images are, those of vertices are linear light."""
    if visual.kind == "texture" and getattr(visual.material, "baseColorTexture", None) is not None:
        return np.asarray(visual.to_color().vertex_colors)[:, :3].astype(np.uint8)
    # Beside a material trimesh leaves them as they are stored, alone in 8 bits.
    stored = visual.vertex_attributes.get("color") if visual.kind == "texture" else None
    stored = visual.vertex_colors if visual.kind == "vertex" else stored
    if stored is None:
        return None
    values = np.asarray(stored)[:, :3]
    full = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1.0
    linear = np.round(values / full * 65535.0).clip(0, 65535)
    # The value whose linear light is the nearest.
    return np.searchsorted(0.5 * (_LINEAR[1:].astype(float) + _LINEAR[:-1]), linear).astype(np.uint8)


def write_glb(path: str | Path, mesh: Mesh, crs: CRS) -> None:
    """Write a mesh in crs as GLB, whole or not at all: metres, y up, in single precision from an origin in its middle.

    Axes are those of the grid (``"axes": "grid"``), or, where grid units are not lengths on the ground (degrees, Web
    Mercator), east, north and up at the origin (``"topocentric"``). The ``extras`` of the scene hold the axes, the CRS
    and the origin. Colours are linear, in 16 bits; the material scatters light as paper does, on both sides.
    """
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    if is_to_scale(crs, middle):
        origin, axes = np.floor(middle), _GRID
        vertices = (mesh.vertices - origin) * _grid_units(crs)
    else:
        origin, axes = np.round(middle, 9), _TOPOCENTRIC
        vertices = LocalFrame(crs, (origin[0], origin[1], origin[2])).local_from_crs(mesh.vertices)
    extras = {"made_by": "bathynerf", "crs": crs_code(crs) or crs.to_wkt(), "origin": origin.tolist(), "axes": axes}
    arrays = [("POSITION", (vertices @ _Z_UP).astype("<f4"), "VEC3"), ("indices", mesh.faces.astype("<u4"), "SCALAR")]
    if mesh.rgb is not None:
        # Four components, since each element of an array begins at a multiple of four bytes.
        opaque = np.full((len(mesh.rgb), 1), 65535, dtype="<u2")
        arrays.append(("COLOR_0", np.hstack([_LINEAR[mesh.rgb], opaque]), "VEC4"))
    content = json.dumps(_scene(arrays, extras), separators=(",", ":")).encode()
    content += b" " * (-len(content) % 4)
    size = sum(array.nbytes for _, array, _ in arrays)
    length = 12 + 8 + len(content) + 8 + size
    if length >= 2**32:
        raise UnwritableFile(
            f"cannot write {path}: GLB holds 4 GB, and this mesh takes {length / 1e9:.1f} GB; give a larger "
            "--resolution, or write PLY."
        )
    with write_whole(path) as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, length) + struct.pack("<I4s", len(content), b"JSON") + content)
        stream.write(struct.pack("<I4s", size, b"BIN\0"))
        for _, array, _ in arrays:
            stream.write(np.ascontiguousarray(array).data)


def _scene(arrays: list[tuple[str, np.ndarray, str]], extras: dict) -> dict:
    """The scene of one mesh whose arrays, by the names of glTF, follow each other in the binary part."""
    views: list[dict] = []
    accessors: list[dict] = []
    first = 0
    for name, array, kind in arrays:
        views.append({"buffer": 0, "byteOffset": first, "byteLength": array.nbytes, "target": _TARGETS[name]})
        first += array.nbytes
        count = array.size if kind == "SCALAR" else len(array)
        form = {"bufferView": len(accessors), "componentType": _TYPES[array.dtype.str], "count": count, "type": kind}
        if name == "POSITION":
            form |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        elif name == "COLOR_0":
            form["normalized"] = True
        accessors.append(form)
    numbers = {name: number for number, (name, _, _) in enumerate(arrays)}
    primitive = {"indices": numbers.pop("indices"), "attributes": numbers, "material": 0}
    material = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
    return {
        "asset": {"version": "2.0", "generator": "bathynerf"},
        "scene": 0,
        "scenes": [{"nodes": [0], "extras": extras}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": first}],
    }
