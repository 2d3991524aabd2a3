"""COPC: what laspy's and copclib's readers find by place, by level and of each point."""

import struct
from io import BytesIO

import laspy
import numpy as np
import pytest

from geo.copc import build_octree, write_copc
from geo.crs import parse_crs
from geo.errors import GeoError
from geo.las import read_cloud, write_cloud
from geo.las_header import EXTRA_BYTES

ORIGIN = np.array([589012.0, 5194736.0, 2105.0])
NUMBER = 80_000
HALF_STEP_M = 0.0005 + 2e-9  # half of the scale, and the spacing of float64 at 5.2e6
CRS = parse_crs("EPSG:25832+5778")


def values_for(points: np.ndarray) -> dict[str, np.ndarray]:
    """Values by which each point can be told from all others."""
    number = np.arange(len(points))
    return {
        "rgb": np.stack([number % 256, number // 256 % 256, number // 65536], axis=1).astype(np.uint8),
        "depth_m": ORIGIN[2] - points[:, 2],
        "std_m": np.where(number % 7 == 0, np.nan, 0.01),
        "num_views": 2 + number % 9,
        "incidence_deg": number % 40,
        "is_wet": number % 2 == 0,
    }


def number_of(points) -> np.ndarray:
    """The number of points of a LAS file, from their colours."""
    red, green, blue = (np.asarray(colour, dtype=np.int64) // 257 for colour in (points.red, points.green, points.blue))
    return red + 256 * green + 65536 * blue


@pytest.fixture(scope="module")
def bed() -> np.ndarray:
    """A bed that is wavy, with one part ten times as dense."""
    rng = np.random.default_rng(4)
    plan = rng.uniform(-20.0, 20.0, (NUMBER, 2)) * np.where(np.arange(NUMBER) % 2, 1.0, 0.3)[:, None]
    return ORIGIN + np.column_stack([plan, -2.0 + np.sin(plan[:, 0])])


@pytest.fixture(scope="module")
def copc(bed, tmp_path_factory):
    path = tmp_path_factory.mktemp("copc") / "bed.copc.laz"
    write_cloud(path, bed, CRS, **values_for(bed))
    return path


def test_every_point_comes_back_once_with_all_its_values(bed, copc):
    with laspy.CopcReader.open(copc) as reader:
        found = reader.query()
        assert reader.header.parse_crs().sub_crs_list[0].to_epsg() == 25832
    order = np.argsort(number_of(found))
    assert (number_of(found)[order] == np.arange(NUMBER)).all()
    values = values_for(bed)
    xyz = np.stack([found.x, found.y, found.z], axis=1)[order]
    np.testing.assert_allclose(xyz, bed, rtol=0.0, atol=HALF_STEP_M)
    np.testing.assert_array_equal(found["depth"][order], values["depth_m"].astype(np.float32))
    np.testing.assert_array_equal(found["num_views"][order], values["num_views"])
    np.testing.assert_array_equal(np.asarray(found.classification)[order] == 40, values["is_wet"])


def test_a_reader_fetches_the_points_of_a_place(bed, copc):
    low, high = ORIGIN[:2] + np.array([[-3.0, 1.0], [2.0, 6.0]])
    stored = np.round(1000.0 * (bed - ORIGIN)[:, :2])
    with laspy.CopcReader.open(copc) as reader:
        found = reader.query(bounds=laspy.copc.Bounds(low, high))
    inside = ((stored >= [-3000, 1000]) & (stored <= [2000, 6000])).all(axis=1)
    assert sorted(number_of(found)) == np.flatnonzero(inside).tolist()


def test_the_first_level_is_thin_and_each_further_one_twice_as_dense(bed, copc):
    with laspy.CopcReader.open(copc) as reader:
        info = reader.copc_info
        levels = [reader.query(level=level) for level in range(4)]
        finest = reader.query(resolution=info.spacing / 2.0)
    assert sum(len(level) for level in levels) == NUMBER
    assert len(finest) == len(levels[0]) + len(levels[1])
    low = info.center - info.halfsize
    cells = np.stack([levels[0].x, levels[0].y, levels[0].z], axis=1)
    cells = np.floor((cells - low) / info.spacing).astype(int)
    assert len(np.unique(cells, axis=0)) == len(levels[0]), "two points of the first level share a cell"
    assert info.spacing == pytest.approx(2.0 * info.halfsize / 128)
    np.testing.assert_allclose(low, np.round(bed, 3).min(axis=0), atol=2e-9)


def test_the_record_of_copc_is_where_the_specification_has_it(copc):
    content = copc.read_bytes()
    assert content[377:381] == b"copc"
    assert struct.unpack_from("<HH", content, 393) == (1, 160)
    assert content[104] == 0x80 | 7
    assert content[26:35] == b"bathynerf"
    first_extended, count = struct.unpack_from("<QI", content, 235)
    assert count == 1
    assert content[first_extended + 2 : first_extended + 6] == b"copc"
    root, size = struct.unpack_from("<QQ", content, 429 + 40)
    assert (root, root + size) == (first_extended + 60, len(content))


def test_readers_of_laz_read_it_too_and_the_same_cloud_gives_the_same_file(bed, copc, tmp_path):
    cloud = read_cloud(copc)
    assert len(cloud.points) == NUMBER
    assert np.isnan(cloud.extra["std"]).sum() == len(range(0, NUMBER, 7))
    assert [part.to_epsg() for part in cloud.crs.sub_crs_list] == [25832, 5778]
    write_cloud(tmp_path / "again.copc.laz", bed, CRS, **values_for(bed))
    assert (tmp_path / "again.copc.laz").read_bytes() == copc.read_bytes()


def test_copclib_finds_every_point_within_its_node(copc):
    copclib = pytest.importorskip("copclib")
    reader = copclib.FileReader(str(copc))
    assert reader.ValidateSpatialBounds(verbose=False)
    assert sum(node.point_count for node in reader.GetAllNodes()) == NUMBER
    assert len(reader.copc_config.extra_bytes_vlr.items) == len(EXTRA_BYTES) - 2  # those of --tpu


@pytest.mark.parametrize("kind", ["one point", "one place", "degrees"])
def test_clouds_without_extent_and_in_degrees_are_written_too(tmp_path, rng, kind):
    path = tmp_path / "few.copc.laz"
    crs = CRS
    points = np.tile(ORIGIN, (1 if kind == "one point" else 40_000, 1))
    if kind == "degrees":
        crs = parse_crs("EPSG:4979")
        points = [13.17, 46.9, 5.0] + rng.uniform(-1.0, 1.0, (40_000, 3)) * [0.01, 0.01, 10.0]
    write_cloud(path, points, crs, **values_for(points))
    with laspy.CopcReader.open(path) as reader:
        found = reader.query()
    assert sorted(number_of(found)) == list(range(len(points)))
    assert np.ptp(found.z) == pytest.approx(np.ptp(points[:, 2]), abs=0.001)


def test_records_are_made_a_portion_at_a_time_with_the_same_file(rng):
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, 0.001)
    steps = rng.integers(-50_000, 50_000, (40_000, 3), dtype=np.int32)
    asked: list[int] = []

    def records(part: slice | np.ndarray) -> laspy.LasData:
        las = laspy.LasData(header)
        las.points = laspy.ScaleAwarePointRecord.zeros(len(steps[part]), header=header)
        las.X, las.Y, las.Z = steps[part].T
        las.return_number[:] = 1
        asked.append(len(las.points))
        return las

    whole, portions = BytesIO(), BytesIO()
    write_copc(header, records, len(steps), whole)
    asked.clear()
    write_copc(header, records, len(steps), portions, portion=7_000)
    assert asked[:6] == [7_000] * 5 + [5_000]
    assert portions.getvalue() == whole.getvalue()
    found = laspy.read(BytesIO(portions.getvalue()))
    assert found.header.point_count == len(steps)
    assert sorted(found.X) == sorted(steps[:, 0])
    np.testing.assert_allclose(found.header.mins, 0.001 * steps.min(axis=0))


def test_an_empty_cloud_is_refused(tmp_path):
    with pytest.raises(GeoError, match=r"out\.copc\.laz: COPC needs one point at least"):
        write_cloud(tmp_path / "out.copc.laz", np.zeros((0, 3)), CRS, **values_for(np.zeros((0, 3))))
    assert list(tmp_path.iterdir()) == []


def test_a_node_comes_after_its_parent_and_its_points_lie_in_it(rng):
    steps = rng.integers(-1000, 100_000, (100_000, 3))
    tree = build_octree(steps.T)
    nodes = {tuple(key): number for number, key in enumerate(tree.keys)}
    assert len(nodes) == len(tree.keys)
    assert sorted(tree.order) == list(range(len(steps)))
    ends = np.cumsum(tree.counts)
    for number, ((level, *place), end, count) in enumerate(zip(tree.keys, ends, tree.counts, strict=True)):
        if level:
            assert nodes[(level - 1, *(np.array(place) // 2))] < number
        low = tree.corner + np.array(place) * tree.side / 2**level
        inside = steps[tree.order[end - count : end]]
        assert (inside >= low).all()
        assert (inside <= low + tree.side / 2**level).all()
