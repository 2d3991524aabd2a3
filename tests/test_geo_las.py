"""LAS and LAZ: the bytes of the header, what other readers see, and what damaged or foreign files lead to."""

import datetime
import struct

import laspy
import numpy as np
import pytest
from compare_plane import keyed_las, write_las
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS
from small_disk import file_size_limit

from geo.crs import parse_crs
from geo.errors import GeoError, UnreadableFile, UnwritableFile
from geo.las import read_cloud, write_cloud

ORIGIN = np.array([589012.0, 5194736.0, 2105.0])
HALF_STEP_M = 0.0005 + 2e-9  # half of the scale, and the spacing of float64 at 5.2e6
HALF_STEP_DEG = 0.5e-8 + 3e-14


def values_for(number: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    depth = rng.uniform(-1.0, 4.0, number)
    return {
        "rgb": rng.integers(0, 256, (number, 3), dtype=np.uint8),
        "depth_m": depth,
        "std_m": rng.uniform(0.001, 0.1, number),
        "std_common_m": rng.uniform(0.001, 0.1, number),
        "num_views": rng.integers(2, 400, number),
        "incidence_deg": rng.uniform(0.0, 50.0, number),
        "is_wet": depth > 0.0,
    }


@pytest.fixture
def crs() -> CRS:
    return parse_crs("EPSG:25832+5778")


@pytest.fixture(params=["cloud.las", "cloud.laz"])
def written(request, tmp_path, rng, crs):
    """A path, the points and the values that were written there."""
    points = ORIGIN + rng.uniform(-20.0, 20.0, (1000, 3))
    values = values_for(1000, rng)
    path = tmp_path / request.param
    write_cloud(path, points, crs, **values, user_data=values["num_views"] % 7)
    return path, points, values


def test_a_cloud_comes_back_with_all_its_values(written):
    path, points, values = written
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points, points, rtol=0.0, atol=HALF_STEP_M)
    np.testing.assert_array_equal(cloud.rgb, values["rgb"])
    np.testing.assert_array_equal(cloud.classification, np.where(values["is_wet"], 40, 2))
    np.testing.assert_array_equal(cloud.extra["num_views"], values["num_views"])
    for name in ("depth_m", "std_m", "std_common_m", "incidence_deg"):
        np.testing.assert_array_equal(cloud.extra[name.rpartition("_")[0]], values[name].astype(np.float32))
    assert [part.to_epsg() for part in cloud.crs.sub_crs_list] == [25832, 5778]
    assert cloud.notes == ()


def test_the_header_is_las_14_format_7_as_the_standard_wants_it(written):
    path, points, _ = written
    head = path.read_bytes()[:375]
    assert head[:4] == b"LASF"
    assert (head[24], head[25]) == (1, 4)
    assert struct.unpack_from("<H", head, 6)[0] & 0b10000, "the WKT bit of the global encoding"
    assert head[26:58].rstrip(b"\0") == b"bathynerf"
    assert head[58:90].startswith(b"bathynerf ")
    day, year = struct.unpack_from("<HH", head, 90)
    made = datetime.date(year, 1, 1) + datetime.timedelta(days=day - 1)
    assert abs((datetime.date.today() - made).days) <= 1
    assert head[104] & 0x3F == 7
    assert struct.unpack_from("<H", head, 105)[0] == 36 + 18, "point format 7 and the extra bytes"
    assert head[107:131] == bytes(24), "legacy counts are zero"
    assert struct.unpack_from("<3d", head, 131) == (0.001, 0.001, 0.001)
    offsets = struct.unpack_from("<3d", head, 155)
    assert all(offset.is_integer() for offset in offsets)
    extremes = np.array(struct.unpack_from("<6d", head, 179)).reshape(3, 2)
    np.testing.assert_allclose(extremes[:, 0], points.max(axis=0), rtol=0.0, atol=HALF_STEP_M)
    np.testing.assert_allclose(extremes[:, 1], points.min(axis=0), rtol=0.0, atol=HALF_STEP_M)
    assert struct.unpack_from("<16Q", head, 247) == (1000, 1000, *[0] * 14), "all are first and only returns"


def test_the_records_hold_one_wkt_1_and_one_extra_bytes_descriptor(written):
    path, _, values = written
    with laspy.open(path) as reader:
        records = [vlr for vlr in reader.header.vlrs if vlr.user_id in ("LASF_Projection", "LASF_Spec")]
        assert [(vlr.user_id, vlr.record_id) for vlr in records] == [("LASF_Projection", 2112), ("LASF_Spec", 4)]
        assert records[0].string.startswith('COMPD_CS["ETRS89 / UTM zone 32N + GHA height",PROJCS[')
        assert records[0].record_data_bytes().endswith(b"\0")
        described = {record.name.decode(): record for record in records[1].extra_bytes_structs}
    assert list(described) == ["depth", "std", "std_common", "num_views", "incidence"]
    for name, given in (("depth", "depth_m"), ("num_views", "num_views")):
        assert described[name].min[0] == values[given].astype(described[name].min.dtype).min()
        assert described[name].max[0] == values[given].astype(described[name].max.dtype).max()
    assert described["depth"].description == b"true depth below the water, m"
    assert described["depth"].no_data[0] == -9999.0
    assert described["num_views"].no_data is None


def test_other_readers_see_single_synthetic_returns_and_16_bit_colours(written):
    path, _, values = written
    las = laspy.read(path)
    assert (las.return_number == 1).all()
    assert (las.number_of_returns == 1).all()
    assert (las.synthetic == 1).all()
    assert (las.withheld == 0).all()
    assert (las.overlap == 0).all()
    np.testing.assert_array_equal(las.user_data, values["num_views"] % 7)
    np.testing.assert_array_equal(las.red, values["rgb"][:, 0].astype(np.uint16) * 257)
    np.testing.assert_allclose(np.asarray(las.depth), values["depth_m"], rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "centre"), [("EPSG:4979", (13.17, 46.9, 5.0)), ("EPSG:4326+5773", (-179.5, -17.9, 0.0))]
)
def test_longitude_and_latitude_are_stored_to_a_hundred_millionth_of_a_degree(tmp_path, rng, text, centre):
    points = np.array(centre) + rng.uniform(-1.0, 1.0, (50, 3)) * [0.01, 0.01, 10.0]
    write_cloud(tmp_path / "cloud.las", points, parse_crs(text), **values_for(50, rng))
    with laspy.open(tmp_path / "cloud.las") as reader:
        np.testing.assert_array_equal(reader.header.scales, [1e-8, 1e-8, 1e-3])
        np.testing.assert_array_equal(reader.header.offsets % 1.0, 0.0)
    cloud = read_cloud(tmp_path / "cloud.las")
    assert (np.abs(cloud.points - points) <= [HALF_STEP_DEG, HALF_STEP_DEG, HALF_STEP_M]).all()
    assert len(cloud.crs.axis_info) == 3


def test_missing_values_are_declared_as_no_data_and_read_as_nan(tmp_path, rng, crs):
    values = values_for(10, rng)
    values["depth_m"][3:6] = np.nan
    values["std_m"][:] = np.nan
    write_cloud(tmp_path / "cloud.las", ORIGIN + rng.uniform(-1, 1, (10, 3)), crs, **values)
    raw = laspy.read(tmp_path / "cloud.las")
    assert (np.asarray(raw.depth)[3:6] == -9999.0).all()
    described = raw.header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs
    assert described[0].min[0] > -9999.0, "no data is not a minimum"
    assert described[1].min is None, "no range where no value is known"
    cloud = read_cloud(tmp_path / "cloud.las")
    np.testing.assert_array_equal(np.isnan(cloud.extra["depth"]), np.isnan(values["depth_m"]))
    assert np.isnan(cloud.extra["std"]).all()


def test_an_empty_cloud_is_written_and_refused_when_read(tmp_path, rng, crs):
    path = tmp_path / "cloud.las"
    write_cloud(path, np.zeros((0, 3)), crs, **values_for(0, rng))
    with laspy.open(path) as reader:
        assert reader.header.point_count == 0
    with pytest.raises(UnreadableFile, match=r"cloud\.las has no points"):
        read_cloud(path)


def test_many_identical_points_are_no_trouble(tmp_path, crs):
    cloud = read_cloud(write_las(tmp_path / "cloud.laz", np.broadcast_to(ORIGIN, (250_000, 3)), crs))
    assert len(cloud.points) == 250_000
    np.testing.assert_array_equal(np.ptp(cloud.points, axis=0), 0.0)


@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz"])
@pytest.mark.parametrize("room", [0, 300, 20000])
def test_a_disk_that_fills_leaves_the_old_file_and_no_scraps(tmp_path, rng, crs, name, room):
    path = tmp_path / name
    path.write_bytes(b"an older result")
    points, values = ORIGIN + rng.uniform(-20, 20, (20000, 3)), values_for(20000, rng)
    with pytest.raises(UnwritableFile) as caught, file_size_limit(room):
        write_cloud(path, points, crs, **values)
    assert str(path) in str(caught.value)
    assert "write elsewhere" in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == b"an older result"


@pytest.mark.parametrize(
    ("points", "number", "kind", "words"),
    [
        (ORIGIN + np.array([[0.0, 0.0, 0.0], [0.0, 1e7, 0.0]]), 2, GeoError,
         r"more than LAS holds .* give \[area\] bounds"),
        ([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]], 2, ValueError, "1 of 2 points have coordinates that are not finite"),
        (np.zeros((2, 3)), 3, ValueError, r"rgb has shape \(3, 3\), expected \(2, 3\)"),
        (np.zeros(3), 1, ValueError, r"expected points of shape \(N, 3\)"),
    ],
)  # fmt: skip
def test_clouds_that_las_cannot_hold_are_refused(tmp_path, rng, crs, points, number, kind, words):
    with pytest.raises(kind, match=words):
        write_cloud(tmp_path / "cloud.las", points, crs, **values_for(number, rng))
    with pytest.raises(UnwritableFile, match=r"suffix must be \.las or \.laz"):
        write_cloud(tmp_path / "cloud.txt", ORIGIN[None], crs, **values_for(1, rng))
    assert list(tmp_path.iterdir()) == []


def test_every_cut_of_a_file_is_an_error_that_names_it(written, tmp_path):
    path, _, _ = written
    data = path.read_bytes()
    cut = tmp_path / f"cut{path.suffix}"
    # Within the signature, the short header, the long header, the records, the points, and at a whole point.
    for size in (0, 3, 200, 300, 500, 3000, len(data) // 2, len(data) - 50, len(data) - 1):
        cut.write_bytes(data[:size])
        with pytest.raises(UnreadableFile, match=r"cut\.la[sz] cannot be read as LAS or LAZ.*(copy|export)"):
            read_cloud(cut)


def test_damaged_files_end_in_an_error_of_ours_or_in_points(written, tmp_path, rng):
    path, _, _ = written
    data = path.read_bytes()
    damaged = tmp_path / f"damaged{path.suffix}"
    refused = 0
    for _ in range(60):
        bad = bytearray(data)
        for position in rng.integers(0, 1500, 4):
            bad[position] = rng.integers(0, 256)
        damaged.write_bytes(bad)
        try:
            read_cloud(damaged)
        except GeoError:
            refused += 1
    assert refused > 0


@pytest.mark.parametrize(
    ("kind", "at", "value", "words"),
    [
        ("<I", 100, [2**32 - 1], "promises 4294967295 records before the points"),
        # The first of the records after the points, and their number.
        ("<QI", 235, [-10, 7], "promises 7 records after the points"),
        ("<d", 131, [np.inf], r"gives coordinates that are not finite \(scales .*inf"),
    ],
)
def test_a_head_that_cannot_be_true_is_refused_before_it_is_followed(written, kind, at, value, words):
    path, _, _ = written
    data = bytearray(path.read_bytes())
    struct.pack_into(kind, data, at, *(len(data) + each if each < 0 else each for each in value))
    path.write_bytes(data)
    with pytest.raises(UnreadableFile, match=words):
        read_cloud(path)


def test_paths_that_are_no_las_files_are_named(tmp_path):
    (tmp_path / "text.las").write_text("easting,northing,height\n" * 20)
    for name, words in (
        ("none.las", r"none\.las does not exist"), ("", "is a folder"), ("text.las", 'does not begin with "LASF"'),
    ):  # fmt: skip
        with pytest.raises(UnreadableFile, match=words):
            read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    ("keys", "codes", "note"),
    [
        ({1024: 1, 3072: 25832, 4096: 7837}, [25832, 7837], None),
        ({1024: 1, 3072: 25832}, [25832], "without a vertical part"),
        ({3072: 32615, 3076: 9001}, [32615], "without a vertical part"),
        ({1024: 2, 2048: 4326}, [4326], "without a vertical part"),
        ({1024: 1, 3072: 25832, 4096: 5030}, [25832], "without a vertical part"),
        ({1024: 1, 2048: 4269, 3072: 32767}, None, "user-defined"),
        ({1024: 1, 3072: 32104, 3076: 9003}, None, "in another unit than its own"),
    ],
)
def test_geotiff_keys_give_the_crs_or_say_why_not(tmp_path, keys, codes, note):
    cloud = read_cloud(keyed_las(tmp_path / "keys.las", keys, np.zeros((2, 3))))
    parts = None if cloud.crs is None else [part.to_epsg() for part in cloud.crs.sub_crs_list or [cloud.crs]]
    assert parts == codes
    assert (note is None and cloud.notes == ()) or note in cloud.notes[0]


def test_a_crs_that_is_absent_or_not_understood_is_none_and_noted(tmp_path):
    header = laspy.LasHeader(version="1.4", point_format=6)
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.ones((3, 2))
    las.write(tmp_path / "a.las")
    cloud = read_cloud(tmp_path / "a.las")
    assert cloud.crs is None
    assert cloud.rgb is None
    assert "states no CRS" in cloud.notes[0]
    header.vlrs.append(WktCoordinateSystemVlr('PROJCS["half a'))
    las.write(tmp_path / "b.las")
    cloud = read_cloud(tmp_path / "b.las")
    assert cloud.crs is None
    assert "not understood" in cloud.notes[0]


@pytest.mark.parametrize(
    ("whole", "damaged"), [(b'"EPSG","4258"', b'"EPSG","425["'), (b'UNIT["metre",1,', b'UNIT["metre",0,')]
)
def test_a_compound_crs_whose_parts_are_damaged_is_a_note(tmp_path, rng, whole, damaged):
    path = tmp_path / "a.las"
    crs = parse_crs("EPSG:25832+7837")
    write_cloud(path, ORIGIN + rng.uniform(size=(20, 3)), crs, **values_for(20, rng))
    # A bracket within the code of the geographic CRS: the compound one is read, its parts are not.
    data = path.read_bytes()
    assert whole in data
    path.write_bytes(data.replace(whole, damaged))
    cloud = read_cloud(path)
    assert cloud.crs is None
    assert "not understood" in cloud.notes[0]


def test_colours_are_read_alike_whether_written_with_8_bits_or_with_either_way_to_16(tmp_path):
    for factor in (1, 256, 257):
        las = laspy.LasData(laspy.LasHeader(version="1.2", point_format=2))
        las.x, las.y, las.z = np.ones((3, 256))
        las.red = las.green = las.blue = np.arange(256, dtype=np.uint16) * np.uint16(factor)
        las.write(tmp_path / "c.las")
        np.testing.assert_array_equal(read_cloud(tmp_path / "c.las").rgb[:, 0], np.arange(256))


def test_scaled_integers_with_no_data_are_read_in_their_unit(tmp_path):
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.add_extra_dim(laspy.ExtraBytesParams("sigma", np.int16, "m", scales=[0.01], offsets=[1.0], no_data=[-32768]))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.ones((3, 3))
    las["sigma"] = [1.0, 1.25, 0.5]
    las.points.array["sigma"][1] = -32768
    las.write(tmp_path / "s.las")
    np.testing.assert_allclose(read_cloud(tmp_path / "s.las").extra["sigma"], [1.0, np.nan, 0.5], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "number", "code", "unit"),
    [
        ("autzen_trim.laz", 110000, None, "foot"),
        ("file_with_both_wkt_and_geotiff_vlrs.las", 25408, 6880, "US survey foot"),
        ("test1_4.las", 1000, None, "US survey foot"),
        ("simple1_4.las", 22600, 4326, "degree"),
        ("simple.copc.laz", 1065, None, "metre"),
        ("simple.las", 1065, None, None),
        ("simple1_1.las", 1065, None, None),
        ("extrabytes.las", 1065, None, None),
    ],
)
def test_files_made_elsewhere_are_read_with_their_true_units(data_dir, name, number, code, unit):
    cloud = read_cloud(data_dir / "real/laspy_las" / name)
    assert cloud.points.shape == (number, 3)
    assert np.isfinite(cloud.points).all()
    assert cloud.notes == () if name == "simple.copc.laz" else cloud.notes
    if unit is None:
        assert cloud.crs is None
    else:
        assert cloud.crs.axis_info[0].unit_name.lower() == unit.lower()
        assert cloud.crs.to_epsg() == code
    if name == "extrabytes.las":
        assert cloud.extra["Colors"].shape == (1065, 3)
        assert cloud.extra["Flags"].shape == (1065, 2)
        assert cloud.extra["Time"].dtype == np.uint64


@pytest.mark.parametrize(
    ("kind", "of_table", "value", "words"),
    [("<I", 4, 0x4C000000, "promises 1275068416 chunks, for 50 points"), ("<q", None, 2**40, "lies outside")],
)
def test_a_laz_table_that_promises_more_chunks_than_there_are_is_refused(
    tmp_path, rng, crs, kind, of_table, value, words
):
    """The decoder would take 16 bytes for each, and end the process where there are none."""
    path = write_las(tmp_path / "c.laz", ORIGIN + rng.uniform(-20.0, 20.0, (50, 3)), crs)
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    struct.pack_into(kind, data, start if of_table is None else table + of_table, value)
    path.write_bytes(data)
    with pytest.raises(UnreadableFile, match=words):
        read_cloud(path)
