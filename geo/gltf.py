"""glTF and GLB meshes (the extra ``gltf``): read as one mesh, turned so that z is up; written near their origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import crs_code
from geo.errors import UnreadableFile
from geo.files import existing_file, write_whole
from geo.optional import library_for
from geo.shapes import Cloud, Mesh

# glTF 2.0, section 3.3: y is up and z points forward. East, north, up are x, -z, y.
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def read_gltf(path: str | Path) -> Mesh | Cloud:
    """Read a glTF or GLB file: a mesh if it has triangles, else a cloud. The format knows no CRS.

    Its coordinates are float32, which rounds those of a map (5e6 m) to half a metre: only meshes with an origin near
    by are of use.

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
        said = (str(error).splitlines() or [type(error).__name__])[0][:100]
        raise UnreadableFile(f"{path} cannot be read as glTF ({said}); export it again.") from error
    points = np.concatenate([np.empty((0, 3)), *vertices]) @ _Z_UP.T
    if not meshes:
        return Cloud(points)
    before = np.cumsum([0, *(len(part) for part in vertices)])
    faces = [np.asarray(part.faces, dtype=np.int64) + first for part, first in zip(meshes, before, strict=False)]
    return Mesh(points, np.concatenate(faces), rgb=_rgb(meshes))


def _rgb(meshes: list) -> np.ndarray | None:
    """Colours (V, 3) uint8 of all vertices, also of images; white where a part has none, None if all have none."""
    colours = []
    for part in meshes:
        look = part.visual
        has_image = look.kind == "texture" and getattr(look.material, "baseColorTexture", None) is not None
        known = look.to_color() if has_image else look if look.kind == "vertex" else None
        colours.append(None if known is None else np.asarray(known.vertex_colors)[:, :3].astype(np.uint8))
    if all(rgb is None for rgb in colours):
        return None
    white = (np.full((len(part.vertices), 3), 255, dtype=np.uint8) for part in meshes)
    return np.concatenate([other if rgb is None else rgb for rgb, other in zip(colours, white, strict=True)])


def write_glb(path: str | Path, mesh: Mesh, crs: CRS) -> None:
    """Write a mesh in crs as GLB, whole or not at all: y up, from an origin in its middle.

    The format stores single precision, which steps by half a metre at a northing of 5e6 m. The origin, whole units of
    crs, and the CRS stand in the ``extras`` of the scene.

    Raises
    ------
    UnwritableFile
        If the file cannot be written, or trimesh is not installed.
    """
    trimesh = library_for(path, "trimesh", "gltf", to_write=True)
    origin = np.floor(0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)))
    body = trimesh.Trimesh((mesh.vertices - origin) @ _Z_UP, mesh.faces, vertex_colors=mesh.rgb, process=False)
    said = {"made_by": "bathynerf", "crs": crs_code(crs) or crs.to_wkt(), "origin": origin.tolist()}
    content = trimesh.Scene(body, metadata=said).export(file_type="glb", include_normals=False)
    with write_whole(path) as stream:
        stream.write(content)
