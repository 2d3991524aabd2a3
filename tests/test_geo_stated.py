"""What files say of their coordinates beside the numbers: unit of heights, CRS in comments, first row of a raster."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from compare_plane import keyed_las, write_las
from pyproj import CRS, Transformer
from rasterio.errors import NotGeoreferencedWarning

from geo import Mesh, read_reference
from geo.crs import height_unit_m, horizontal_crs, unit_named
from geo.errors import UnreadableFile
from geo.meshes import write_glb, write_obj
from geo.ply import write_ply
from survey.compare.inputs import InputPaths, load_inputs

pytestmark = pytest.mark.filterwarnings("ignore:.*trimesh.*")
US_FOOT = 1200.0 / 3937.0
UNITS = {
    "metre": 1.0, "m": 1.0, "foot": 0.3048, "ft": 0.3048, "US survey foot": US_FOOT, "ftUS": US_FOOT, "us-ft": US_FOOT,
    "cm": 0.01, "Centimetres": 0.01, "mm": 0.001, "dm": 0.1, "km": 1000.0, "yard": 0.9144, "fathom": 1.8288,
}  # fmt: skip
EAST, NORTH, HEIGHT = 676120.0, 5311480.0, 12.0
SITE = "+proj=tmerc +lat_0=48 +lon_0=10.3 +k=1 +x_0=1000 +y_0=2000 +ellps=GRS80 +type=crs"
FEET = "EPSG:2264+6360"


def points(count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.array([EAST, NORTH, HEIGHT]) + rng.uniform(0.0, [4.0, 4.0, 0.0], (count, 3))


def cloud_file(path: Path, crs: str = "EPSG:25832+7837", height: float = 1.0) -> Path:
    return write_las(path, points() * [1.0, 1.0, height], CRS(crs))


def raster_file(path: Path, heights: np.ndarray, *, crs="EPSG:25832", unit: str | None = None, e=-1.0, a=1.0) -> Path:
    """Cells of half a metre over the points; ``e`` 1: the first row in the south, ``a`` -1: mirrored."""
    rows, columns = heights.shape
    transform = rasterio.Affine(
        0.5 * a, 0.0, EAST - 1.0 if a > 0 else EAST - 1.0 + 0.5 * columns,
        0.0, 0.5 * e, NORTH - 1.0 if e > 0 else NORTH - 1.0 + 0.5 * rows,
    )  # fmt: skip
    form = {"driver": "GTiff", "height": rows, "width": columns, "count": 1, "dtype": "float64", "crs": crs}
    with rasterio.open(path, "w", transform=transform, **form) as out:
        out.write(heights, 1)
        if unit is not None:
            out.set_band_unit(1, unit)
    return path


@pytest.mark.parametrize(("names", "words"), [
    (("depth below chart datum",), "called 'depth below chart datum'; expected heights"),
    (("red", "green", "blue"), "is a picture, whose first band is red; expected heights"),
])  # fmt: skip
def test_bands_that_are_no_heights_are_refused(tmp_path, names, words):
    path = tmp_path / "r.tif"
    form = {"driver": "GTiff", "height": 8, "width": 8, "count": len(names), "dtype": "uint8", "crs": "EPSG:25832"}
    shape = {"photometric": "RGB"} if len(names) == 3 else {}
    with rasterio.open(path, "w", transform=rasterio.Affine(1.0, 0.0, EAST, 0.0, -1.0, NORTH), **form, **shape) as out:
        out.write(np.full((len(names), 8, 8), 3, dtype=np.uint8))
        out.set_band_description(1, names[0])
    with pytest.raises(UnreadableFile, match=words):
        read_reference(path)


@pytest.mark.parametrize(("crs", "of_cloud"), [("EPSG:25832+7837", 1.0), ("EPSG:25832+6360", US_FOOT)])
@pytest.mark.parametrize(("name", "metres"), UNITS.items())
def test_heights_of_a_raster_are_in_the_unit_of_its_band_and_become_those_of_the_cloud(
    tmp_path, name, metres, crs, of_cloud
):
    assert unit_named(name) == metres
    cloud = cloud_file(tmp_path / "c.las", crs, height=1.0 / of_cloud)
    reference = raster_file(tmp_path / "r.tif", np.full((12, 12), HEIGHT / metres), unit=name)
    inputs = load_inputs(InputPaths(cloud, reference), None)
    np.testing.assert_allclose(inputs.reference.vertices[:, 2], HEIGHT / of_cloud, rtol=1e-12)
    assert of_cloud != 1.0 or any("converted" in note for note in inputs.notes) is (metres != 1.0)


def test_a_band_in_another_unit_than_its_crs_is_refused_and_an_unknown_one_is_named(tmp_path):
    heights = np.full((4, 4), HEIGHT)
    with pytest.raises(UnreadableFile, match=r"contradicts itself: the unit of its band, foot, .*metre"):
        read_reference(raster_file(tmp_path / "a.tif", heights, crs="EPSG:25832+7837", unit="foot"))
    assert "furlong" in read_reference(raster_file(tmp_path / "b.tif", heights, unit="furlong")).notes[0]
    agreed = read_reference(raster_file(tmp_path / "c.tif", heights, crs="EPSG:25832+7837", unit="m"))
    assert agreed.height_unit_m is None


@pytest.mark.parametrize(("e", "a"), [(-1, 1), (1, 1), (-1, -1), (1, -1)])
def test_triangles_of_a_raster_face_up_whichever_row_and_column_come_first(tmp_path, e, a):
    mesh = read_reference(raster_file(tmp_path / "r.tif", np.zeros((5, 7)), e=e, a=a))
    p, q, r = mesh.vertices[mesh.faces].swapaxes(0, 1)
    assert (np.cross(q - p, r - p)[:, 2] > 0.0).all()


@pytest.mark.parametrize(("code", "metres"), [(9001, 1.0), (9002, 0.3048), (9003, US_FOOT), (1033, 0.01)])
@pytest.mark.parametrize("vertical", [0, 5703, 5103, 7837])
def test_heights_of_a_las_file_are_in_the_unit_of_its_vertical_keys(tmp_path, code, metres, vertical):
    keys = {1024: 1, 3072: 25832} | ({4096: vertical} if vertical else {}) | {4099: code}
    cloud = read_reference(keyed_las(tmp_path / "c.las", keys, points(50) * [1.0, 1.0, 1.0 / metres]))
    found = height_unit_m(cloud.crs) if vertical else cloud.height_unit_m
    assert found == pytest.approx(metres, rel=1e-12)
    if vertical:
        datum = CRS.from_epsg({5103: 5703}.get(vertical, vertical)).datum
        assert cloud.crs.sub_crs_list[1].datum.name == datum.name
        assert horizontal_crs(cloud.crs).to_epsg() == 25832


def placed_mesh(code: str) -> tuple[Mesh, CRS]:
    """A mesh of 20 m by 10 m by 3 m on the ground in a CRS, with its lower corner at a place that is in its area."""
    crs = CRS(code)
    lon, lat = (-80.0, 35.5) if code == FEET else (10.31, 48.0)
    geodetic = horizontal_crs(crs).geodetic_crs
    local = f"+proj=tmerc +lat_0={lat} +lon_0={lon} +ellps=GRS80"
    x, y = (part.ravel() for part in np.meshgrid(np.linspace(0.0, 20.0, 9), np.linspace(0.0, 10.0, 5)))
    lonlat = Transformer.from_crs(CRS(local), CRS(local).geodetic_crs, always_xy=True).transform(x, y)
    # The datum is left alone: places are what they are called.
    easting, northing = Transformer.from_crs(geodetic, horizontal_crs(crs), always_xy=True).transform(*lonlat)
    z = (100.0 + 3.0 * x / 20.0) / height_unit_m(crs)
    number = np.arange(45).reshape(5, 9)
    faces = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:]], axis=-1).reshape(-1, 3)
    rgb = np.full((45, 3), 120, np.uint8)
    return Mesh(np.column_stack([easting, northing, z]), faces, crs=crs, rgb=rgb), crs


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
@pytest.mark.parametrize(
    "code", ["EPSG:25832+7837", "EPSG:3857+7837", "EPSG:4326+7837", "EPSG:4979", FEET, "EPSG:25832+6360", "site"]
)
def test_a_mesh_that_was_written_comes_back_in_its_crs_and_at_its_place(tmp_path, suffix, code):
    trimesh = pytest.importorskip("trimesh")
    if code == "site":
        from pyproj.crs import CompoundCRS

        code = CompoundCRS("site", [CRS(SITE), CRS("EPSG:7837")]).to_wkt()
    mesh, crs = placed_mesh(code)
    path = tmp_path / f"m{suffix}"
    if suffix == ".ply":
        write_ply(path, mesh.vertices, rgb=mesh.rgb, scalars={}, crs=crs, faces=mesh.faces)
    else:
        (write_obj if suffix == ".obj" else write_glb)(path, mesh, crs)
    back = read_reference(path)
    assert back.crs == crs
    # Single precision near the origin: micrometres, and their part of a degree.
    plan = 1e-9 if horizontal_crs(crs).is_geographic else 1e-4
    np.testing.assert_allclose(back.vertices[:, :2], mesh.vertices[:, :2], rtol=0.0, atol=plan)
    np.testing.assert_allclose(back.vertices[:, 2], mesh.vertices[:, 2], rtol=0.0, atol=2e-4)
    if suffix == ".glb":
        # In metres, whatever the CRS: of a grid with its scale, turned by its convergence, 20 m by 2 degrees at most.
        np.testing.assert_allclose(trimesh.load(path).extents, [20.0, 3.0, 10.0], atol=0.7)


def test_a_crs_in_a_comment_that_is_not_understood_is_named(tmp_path):
    mesh, _ = placed_mesh("EPSG:25832+7837")
    write_ply(tmp_path / "m.ply", mesh.vertices, rgb=mesh.rgb, scalars={}, crs=CRS("EPSG:25832+7837"), faces=mesh.faces)
    content = (tmp_path / "m.ply").read_bytes().replace(b"EPSG:25832+7837", b"EPSG:25832+9999")
    (tmp_path / "m.ply").write_bytes(content)
    back = read_reference(tmp_path / "m.ply")
    assert back.crs is None
    assert "names a CRS that is not understood (EPSG:25832+9999" in back.notes[0]


def test_a_raster_without_georeference_is_refused_with_the_mend(tmp_path):
    path, form = tmp_path / "r.tif", {"driver": "GTiff", "height": 8, "width": 8, "count": 1, "dtype": "float32"}
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(path, "w", **form) as out:
        out.write(np.ones((1, 8, 8), dtype=np.float32))
    with pytest.raises(UnreadableFile, match=r"r\.tif has no georeference, .*gdal_edit -a_ullr"):
        read_reference(path)
