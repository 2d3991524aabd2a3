"""References in formats that extras read: glTF, GeoTIFF, E57, each written by its own library."""

import json

import numpy as np
import pytest
import rasterio
from pyproj import CRS

from geo import Cloud, Mesh, read_reference
from geo.crs import parse_crs
from geo.errors import UnreadableFile
from geo.meshes import write_glb

# What the libraries themselves warn about on import or writing is not ours.
pytestmark = pytest.mark.filterwarnings("ignore")
ORIGIN = np.array([589012.0, 5194736.0, 2105.0])


@pytest.mark.parametrize(("name", "module"), [("r.glb", "trimesh"), ("r.tif", "rasterio"), ("r.e57", "pye57")])
def test_a_damaged_file_is_named(tmp_path, name, module):
    pytest.importorskip(module)
    (tmp_path / name).write_bytes(b"no such thing" * 100)
    with pytest.raises(UnreadableFile, match=rf"{name} cannot be read as "):
        read_reference(tmp_path / name)


@pytest.mark.parametrize("name", ["r.glb", "r.gltf"])
def test_gltf_comes_with_z_up_and_its_nodes_where_they_are(tmp_path, name):
    """A floor in the plane of x and z of the file, and the same 2 m higher (along its y)."""
    trimesh = pytest.importorskip("trimesh")
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [4, 0, -3], [0, 0, -3]])
    floor = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    scene = trimesh.Scene()
    scene.add_geometry(floor)
    scene.add_geometry(floor, transform=trimesh.transformations.translation_matrix([0.0, 2.0, 0.0]))
    scene.export(tmp_path / name)
    mesh = read_reference(tmp_path / name)
    assert isinstance(mesh, Mesh)
    assert len(mesh.faces) == 4
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [4.0, 3.0, 2.0])
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()


def test_a_raster_is_the_surface_through_the_middles_of_its_cells_and_has_holes(tmp_path):
    rows, columns = np.mgrid[0:4, 0:5]
    heights = (100.0 + columns + 10.0 * rows).astype(np.float32)
    heights[0, 0] = -9999.0
    path = tmp_path / "r.tif"
    transform = rasterio.Affine(0.5, 0.0, ORIGIN[0], 0.0, -0.5, ORIGIN[1])
    with rasterio.open(
        path, "w", driver="GTiff", height=4, width=5, count=1, dtype="float32", nodata=-9999.0, transform=transform,
        crs="EPSG:25832",
    ) as out:  # fmt: skip
        out.write(heights, 1)
    mesh = read_reference(path)
    # Twelve squares of cells, less the one triangle at the empty corner.
    assert (len(mesh.faces), len(mesh.vertices)) == (23, 19)
    assert mesh.crs == CRS("EPSG:25832")
    east, north, height = mesh.vertices.T
    np.testing.assert_allclose(
        height, 100.0 + (east - ORIGIN[0]) / 0.5 - 0.5 + 10.0 * ((ORIGIN[1] - north) / 0.5 - 0.5)
    )
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()


def test_a_raster_without_data_is_refused(tmp_path):
    path, transform = tmp_path / "r.tif", rasterio.Affine(1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
    form = {"driver": "GTiff", "height": 3, "width": 3, "count": 1, "dtype": "float32", "nodata": 0.0}
    with rasterio.open(path, "w", transform=transform, **form) as out:
        out.write(np.zeros((3, 3), np.float32), 1)
    with pytest.raises(UnreadableFile, match="no four neighbouring cells with data"):
        read_reference(path)


def test_all_scans_of_an_e57_are_read_in_double_precision(tmp_path, rng):
    pye57 = pytest.importorskip("pye57")
    points = ORIGIN + rng.uniform(0.0, 5.0, (40, 3))
    path = tmp_path / "r.e57"
    with pye57.E57(str(path), mode="w") as out:
        for part, move in ((points[:25], np.zeros(3)), (points[25:] - ORIGIN, ORIGIN)):
            data = {f"cartesian{axis}": part[:, i].copy() for i, axis in enumerate("XYZ")}
            out.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=move)
    cloud = read_reference(path)
    assert isinstance(cloud, Cloud)
    # float64 steps by 1e-9 m at a northing of 5e6 m.
    np.testing.assert_allclose(cloud.points, points, atol=2e-9)


def test_a_glb_has_colours_in_linear_light_and_a_material_of_both_sides(tmp_path):
    """Every value of sRGB comes back, and 0.5 of it is 0.214 of the light (IEC 61966-2-1)."""
    pytest.importorskip("trimesh")
    grey = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    corners = ORIGIN + np.column_stack([np.arange(256.0), np.arange(256.0) % 7, np.arange(256.0) % 5])
    faces = np.arange(255).reshape(-1, 3)
    write_glb(tmp_path / "a.glb", Mesh(corners, faces, rgb=grey), parse_crs("EPSG:25832+5783"))
    np.testing.assert_array_equal(read_reference(tmp_path / "a.glb").rgb, grey)
    data = (tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    scene, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    (material,) = scene["materials"]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0.0
    assert material["doubleSided"]
    accessor = scene["accessors"][scene["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = scene["bufferViews"][accessor["bufferView"]]
    stored = np.frombuffer(binary, "<u2", 4 * 256, view["byteOffset"]).reshape(-1, 4)
    assert stored[128, 0] / 65535 == pytest.approx(((128 / 255 + 0.055) / 1.055) ** 2.4, abs=1e-5)
