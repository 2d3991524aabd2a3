"""Values that were rounded on their way, and marks of no data, whatever file they are in."""

from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from geo import read_reference
from geo.errors import UnreadableFile
from geo.ply import write_ply
from geo.reading import check_values, is_no_data_value
from survey.compare.inputs import InputPaths, load_inputs

pytestmark = pytest.mark.filterwarnings("ignore:.*trimesh.*")
# UTM, a zone number before the easting, a northing in the south, and Web Mercator.
PLACES = {"utm": (676115.3, 5311480.7), "gk": (4468001.2, 5311480.7), "south": (323456.1, 9123456.8)}
DEGREES = (11.3612345, 47.9312345)


def ground(place, spacing, count=400, unit=1.0):
    """Points (N, 3) at random, of a spacing [m], on a slope with relief; units of plan in metres."""
    rng = np.random.default_rng(5)
    size = spacing * count**0.5
    plan = rng.uniform(0.0, size, (count, 2))
    height = 581.0 + 0.1 * plan[:, 0] + 0.3 * np.sin(plan[:, 1]) + rng.normal(0.0, 0.01, count)
    return np.column_stack([plan / unit + np.array(place), height])


def narrowed(points, how):
    """Points whose values went through single precision, or a number of digits."""
    if how == "float32":
        return points.astype(np.float32).astype(np.float64)
    return np.array([[float(f"{value:.{how}g}") for value in row] for row in points])


def as_ply(path: Path, points):
    write_ply(path, points, rgb=np.zeros(points.shape, np.uint8), scalars={})


def as_ascii_ply(path: Path, points):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {a}" for a in "xyz")]
    path.write_text("\n".join([*lines, "end_header", *(" ".join(map(repr, row)) for row in points.tolist())]) + "\n")


def as_obj(path: Path, points):
    path.write_text("".join("v {!r} {!r} {!r}\n".format(*row) for row in points.tolist()))


def as_las(path: Path, points, scales=(0.0001,) * 3, crs: str | None = None):
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = scales, np.floor(points.mean(axis=0))
    if crs is not None:
        header.global_encoding.wkt = True
        header.vlrs.append(WktCoordinateSystemVlr(CRS(crs).to_wkt("WKT1_GDAL")))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(path)


def as_tif(path: Path, points):
    """Rows of 20 points, as cells."""
    transform = rasterio.Affine(0.05, 0, 676115.0, 0, -0.05, 5311480.0)
    heights = points[:, 2].reshape(-1, 20)
    form = {"driver": "GTiff", "count": 1, "dtype": "float64", "crs": "EPSG:25832", "transform": transform}
    with rasterio.open(path, "w", height=len(heights), width=20, **form) as out:
        out.write(heights, 1)


def as_glb(path: Path, points):
    """Doubles: an accessor in single precision about a node's place, as programs with a shift write."""
    trimesh = pytest.importorskip("trimesh")
    origin = np.floor(points.mean(axis=0))
    y_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    cloud = trimesh.points.PointCloud((points - origin) @ y_up.T)
    scene = trimesh.Scene()
    scene.add_geometry(cloud, transform=trimesh.transformations.translation_matrix(y_up @ origin))
    scene.export(path)


WRITERS = {".ply": as_ply, "-ascii.ply": as_ascii_ply, ".obj": as_obj, ".las": as_las, ".laz": as_las, ".glb": as_glb}


@pytest.mark.parametrize("how", ["float32", 6])
@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("place", PLACES)
def test_values_that_went_through_few_digits_are_refused_in_every_file(tmp_path, place, suffix, how):
    path = tmp_path / f"r{suffix}"
    WRITERS[suffix](path, narrowed(ground(PLACES[place], 0.2), how))
    with pytest.raises(UnreadableFile, match=r"single precision|6 digits|were rounded"):
        read_reference(path)


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("place", PLACES)
def test_values_that_were_not_rounded_are_read_without_a_word(tmp_path, place, suffix):
    path = tmp_path / f"r{suffix}"
    WRITERS[suffix](path, ground(PLACES[place], 0.2))
    assert not [note for note in read_reference(path).notes if "multiples" in note]


@pytest.mark.parametrize(("how", "spacing"), [
    *((how, spacing) for how in ("float32", 5, 6, 7) for spacing in (0.02, 0.2, 1.0)), (8, 0.02), (8, 0.2),
])  # fmt: skip
@pytest.mark.parametrize("place", PLACES)
def test_steps_are_found_at_every_spacing_that_they_spoil(place, how, spacing):
    points = narrowed(ground(PLACES[place], spacing, count=2000), how)
    with pytest.raises(UnreadableFile, match=rf"single precision|{how} digits|were rounded"):
        check_values(points, None, Path("r.obj"))


@pytest.mark.parametrize("how", ["float32", 5, 6, 7])
def test_degrees_that_were_rounded_are_refused_where_the_crs_says_that_they_are_degrees(how):
    points = narrowed(ground(DEGREES, 0.05, count=2000, unit=90_000.0), how)
    with pytest.raises(UnreadableFile, match=rf"single precision|{how} digits|were rounded"):
        check_values(points, CRS("EPSG:4979"), Path("r.ply"))


def test_degrees_of_a_file_without_a_crs_are_judged_beside_a_cloud_in_degrees(tmp_path):
    points = ground(DEGREES, 0.05, unit=90_000.0)
    as_las(tmp_path / "c.las", points, (1e-9, 1e-9, 0.001), "EPSG:4326+5773")
    as_ply(tmp_path / "r.ply", narrowed(points, "float32"))
    with pytest.raises(UnreadableFile, match=r"r\.ply are multiples of .*(single precision|were rounded)"):
        load_inputs(InputPaths(tmp_path / "c.las", tmp_path / "r.ply"), None)


@pytest.mark.parametrize("corner", [0.0, 0.25, 0.5, 0.05])
@pytest.mark.parametrize("cell", [0.02, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0])
@pytest.mark.parametrize("place", [*PLACES, "near"])
def test_cells_of_a_raster_are_no_rounding(place, cell, corner):
    x, y = np.meshgrid(np.arange(20) * cell, np.arange(30) * cell)
    at = np.floor(np.array(PLACES.get(place, (0.0, 0.0)))) + corner * cell
    rng = np.random.default_rng(1)
    points = np.column_stack([x.ravel() + at[0], y.ravel() + at[1], rng.normal(580.0, 1.0, x.size)])
    assert check_values(points, None, Path("r.tif")) == ()


@pytest.mark.parametrize("scale", [0.001, 0.01])
@pytest.mark.parametrize("spacing", [0.05, 0.5, 5.0])
def test_the_steps_of_las_are_no_rounding(scale, spacing):
    points = ground(PLACES["utm"], spacing, count=3000)
    assert check_values(np.round(points / scale) * scale, None, Path("r.las")) == ()


def test_boxes_and_single_precision_near_the_origin_are_no_rounding():
    box = np.array([[x, y, z] for x in (0.0, 10.0) for y in (0.0, 20.0) for z in (-3.0, 0.0)])
    assert check_values(np.repeat(box, 3, axis=0), None, Path("box.obj")) == ()
    assert check_values(narrowed(ground((3.0, 4.0), 0.1), "float32"), None, Path("r.glb")) == ()


def test_heights_in_whole_metres_are_named():
    points = ground(PLACES["utm"], 5.0, count=2000)
    points[:, 2] = np.round(points[:, 2])
    (note,) = check_values(points, None, Path("srtm.tif"))
    assert note == "the heights of srtm.tif are multiples of 1: smaller differences are not known from it"
    # A level bed has two or three of them.
    points[:, 2] = np.where(points[:, 0] > np.median(points[:, 0]), 581.0, 582.0)
    assert "multiples of 1" in check_values(points, None, Path("flat.tif"))[0]


@pytest.mark.parametrize(
    "mark", [-9999.0, 9999.0, -99999.0, -999.0, -32768.0, -32767.0, 1e6, -3.4028234663852886e38, 0.0]
)
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".las", ".tif"])
def test_marks_of_no_data_are_refused_in_every_file(tmp_path, suffix, mark):
    points = ground(PLACES["utm"], 0.2)
    path = tmp_path / f"r{suffix}"
    if suffix == ".las" and abs(mark) > 1e5:
        pytest.skip("LAS does not hold it")
    points[10:20, 2] = mark
    (as_tif if suffix == ".tif" else WRITERS[suffix])(path, points)
    with pytest.raises(UnreadableFile, match=r"are exactly .*no-data value that the file does not declare"):
        read_reference(path)


def test_resampled_edges_hide_no_mark():
    points = ground(PLACES["utm"], 0.2, count=2000)
    points[:40, 2], points[40:45, 2] = -9999.0, [-4700.0, -9000.0, -200.0, 300.0, -7777.0]
    with pytest.raises(UnreadableFile, match="exactly -9999"):
        check_values(points, None, Path("r.tif"))


@pytest.mark.parametrize("level", [0.0, 40.0, -30.0])
def test_ground_about_the_datum_is_no_mark_and_a_plate_at_zero_is_named(level):
    points = ground(PLACES["utm"], 0.2, count=2000)
    points[:, 2] += level - 581.0
    assert check_values(points, None, Path("r.tif")) == ()
    points[:, 2] += 5.0 * np.sign(level + 0.1)
    points[:60, 2] = 0.0
    (note,) = check_values(points, None, Path("r.tif"))
    assert "are exactly 0" in note
    assert "if that is a no-data value" in note


@pytest.mark.parametrize("factor", [1.0, 0.3048, 1200.0 / 3937.0])
@pytest.mark.parametrize("shift", [0.0, 47.123])
@pytest.mark.parametrize("mark", [-9999.0, -32768.0, 3.4028234663852886e38])
def test_a_mark_that_went_through_a_unit_or_a_datum_is_one(factor, shift, mark):
    points = ground(PLACES["utm"], 0.5)
    points[:20, 2] = mark * factor + shift
    with pytest.raises(UnreadableFile, match="a no-data value that the file does not declare"):
        check_values(points, None, Path("d.tif"))


@pytest.mark.parametrize("below", [5.0, 60.0, 300.0])
def test_a_level_lake_below_the_ground_is_no_mark(below):
    points = ground(PLACES["utm"], 0.5)
    points[:100, 2] = points[:, 2].min() - below
    assert check_values(points, None, Path("d.tif")) == ()


@pytest.mark.parametrize("height", [-9999.0, -99999.0, -999.0, -32768.0, -32767.0, 32767.0, 65535.0, 1e6, -1e6])
def test_one_height_is_a_mark_only_where_no_place_has_it(height):
    assert is_no_data_value(height)
    assert not is_no_data_value(height + 0.5)
    assert not any(is_no_data_value(each) for each in (0.0, 9999.0, -10.0, 8848.86, -430.0))


def test_heights_as_large_as_numbers_go_are_no_fault_of_the_reader():
    points = ground(PLACES["utm"], 0.2)
    points[0, 2], points[1, 2], points[2, 0] = 1.7e308, -1.7e308, 1e300
    with pytest.raises(UnreadableFile, match="a no-data value that the file does not declare"):
        check_values(points, None, Path("x.ply"))
