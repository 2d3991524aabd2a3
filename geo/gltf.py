"""glTF and GLB meshes (the extra ``gltf``): read as one mesh, turned so that z is up; written near their origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import crs_code, has_height, height_unit_m, horizontal_unit
from geo.errors import UnreadableFile
from geo.files import existing_file, library_for, write_whole
from geo.frames import LocalFrame
from geo.projection import is_to_scale
from geo.shapes import Cloud, Mesh
from geo.stated import crs_named

# glTF 2.0, section 3.3: y is up and z points forward. East, north, up are x, -z, y.
_GRID, _TOPOCENTRIC = "grid", "topocentric"
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def read_gltf(path: str | Path) -> Mesh | Cloud:
    """Read a glTF or GLB file: a mesh if it has triangles, else a cloud.

    The format has no CRS. `write_glb` stores it with the origin in the ``extras`` of the scene; such files are returned
    in coordinates of that CRS.

    Raises
    ------
    UnreadableFile
        If it does not exist, is damaged, or trimesh is not installed.
    """
    path = existing_file(path)
    trimesh = library_for(path, "trimesh", "gltf")
    # trimesh raises errors of many kinds for damaged files (KeyError, struct.error, JSONDecodeError, ...).
    try:
        scene = trimesh.load_scene(path, process=False)
        parts = scene.dump()
        meshes = [part for part in parts if hasattr(part, "faces")]
        vertices = [np.asarray(part.vertices, dtype=np.float64) for part in meshes or parts]
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:100]
        raise UnreadableFile(f"{path} cannot be read as glTF ({reason}); export it again.") from error
    points = np.concatenate([np.empty((0, 3)), *vertices]) @ _Z_UP.T
    points, crs, notes = _placed(points, scene.metadata, path)
    if not meshes:
        return Cloud(points, crs=crs, notes=notes)
    before = np.cumsum([0, *(len(part) for part in vertices)])
    faces = [np.asarray(part.faces, dtype=np.int64) + first for part, first in zip(meshes, before, strict=False)]
    return Mesh(points, np.concatenate(faces), rgb=_rgb(meshes), crs=crs, notes=notes)


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


def _rgb(meshes: list) -> np.ndarray | None:
    """Colours (V, 3) uint8 of all vertices, also of images; white where a part has none, None if all have none."""
    colours = []
    for part in meshes:
        visual = part.visual
        has_image = visual.kind == "texture" and getattr(visual.material, "baseColorTexture", None) is not None
        known = visual.to_color() if has_image else visual if visual.kind == "vertex" else None
        colours.append(None if known is None else np.asarray(known.vertex_colors)[:, :3].astype(np.uint8))
    if all(rgb is None for rgb in colours):
        return None
    white = (np.full((len(part.vertices), 3), 255, dtype=np.uint8) for part in meshes)
    return np.concatenate([other if rgb is None else rgb for rgb, other in zip(colours, white, strict=True)])


def write_glb(path: str | Path, mesh: Mesh, crs: CRS) -> None:
    """Write a mesh in crs as GLB, whole or not at all: metres, y up, from an origin in its middle.

    The format is in metres and in single precision, whose step at a northing of 5e6 m is half a metre. Axes are those
    of the grid (``"axes": "grid"``), or, where grid units are not lengths on the ground (degrees, Web Mercator), east,
    north and up at the origin (``"topocentric"``). The ``extras`` of the scene hold the axes, the CRS and the origin in
    whole units of it (degrees to nine digits).

    Raises
    ------
    UnwritableFile
        If the file cannot be written, or trimesh is not installed.
    """
    trimesh = library_for(path, "trimesh", "gltf", to_write=True)
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    if is_to_scale(crs, middle):
        origin, axes = np.floor(middle), _GRID
        vertices = (mesh.vertices - origin) * _grid_units(crs)
    else:
        origin, axes = np.round(middle, 9), _TOPOCENTRIC
        vertices = LocalFrame(crs, (origin[0], origin[1], origin[2])).local_from_crs(mesh.vertices)
    body = trimesh.Trimesh(vertices @ _Z_UP, mesh.faces, vertex_colors=mesh.rgb, process=False)
    extras = {"made_by": "bathynerf", "crs": crs_code(crs) or crs.to_wkt(), "origin": origin.tolist(), "axes": axes}
    content = trimesh.Scene(body, metadata=extras).export(file_type="glb", include_normals=False)
    with write_whole(path) as stream:
        stream.write(content)
