"""Clouds and meshes are read again before they take their place: each format as it is, and with one fault."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from geo.errors import UnwritableFile
from geo.gltf import write_glb
from geo.obj import write_obj
from geo.ply import write_ply
from geo.reading import write_verified
from geo.shapes import Mesh

CODES = {"EPSG:25832+5783": (5e5, 5.2e6), "EPSG:2264+6360": (1.5e6, 6e5), "EPSG:4326+5773": (9.0, 48.0)}
FORMATS = (".ply", ".obj", ".glb")


def mesh_of(code: str) -> Mesh:
    middle = CODES[code]
    side = 1e-4 if code.startswith("EPSG:4326") else 10.0
    x, y = np.meshgrid(np.linspace(0.0, side, 12), np.linspace(0.0, side, 12))
    vertices = np.column_stack([middle[0] + x.ravel(), middle[1] + y.ravel(), 580.0 + np.sin(7.0 * x / side).ravel()])
    first = (np.arange(11)[:, None] * 12 + np.arange(11)).ravel()
    corners = (first, first + 1, first + 12), (first + 1, first + 13, first + 12)
    faces = np.concatenate([np.column_stack(three) for three in corners])
    return Mesh(vertices, faces, crs=CRS(code), rgb=np.full(vertices.shape, 99, np.uint8))


def write_plain(path: Path, mesh: Mesh, crs: CRS) -> None:
    if path.suffix == ".ply":
        write_ply(path, mesh.vertices, rgb=mesh.rgb, scalars={}, crs=crs, faces=mesh.faces)
    else:
        {".obj": write_obj, ".glb": write_glb}[path.suffix](path, mesh, crs)


def written(path: Path, mesh: Mesh, *, spoil=lambda copy: None, crs: CRS | None = None) -> None:
    own = mesh.crs if crs is None else crs

    def write(copy: Path) -> None:
        write_plain(copy, mesh, own)
        spoil(copy)

    write_verified(path, write, mesh.vertices, len(mesh.faces), mesh.crs)


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("suffix", FORMATS)
def test_what_was_written_well_takes_its_place(tmp_path, suffix, code):
    written(tmp_path / f"a{suffix}", mesh_of(code))
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


def cut(copy: Path) -> None:
    copy.write_bytes(copy.read_bytes()[: copy.stat().st_size // 2])


@pytest.mark.parametrize("suffix", FORMATS)
def test_what_reads_otherwise_leaves_nothing(tmp_path, suffix):
    mesh, path = mesh_of("EPSG:25832+5783"), tmp_path / f"a{suffix}"
    with pytest.raises(UnwritableFile, match=rf"cannot write .*/a\{suffix}: read again, it "):
        written(path, mesh, spoil=cut)
    with pytest.raises(UnwritableFile, match="read again, its CRS is "):
        written(path, mesh, crs=CRS("EPSG:25833+5783"))
    moved = Mesh(np.add(mesh.vertices, [0.0, 0.0, 0.01]), mesh.faces, crs=mesh.crs, rgb=mesh.rgb)
    with pytest.raises(UnwritableFile, match="its points differ"):
        write_verified(path, lambda copy: write_plain(copy, moved, mesh.crs), mesh.vertices, len(mesh.faces), mesh.crs)
    assert list(tmp_path.iterdir()) == []
