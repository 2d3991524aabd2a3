"""The local frame against closed forms, PROJ's own topocentric step, and poses that were made elsewhere."""

import copy
import csv
import math
import pickle
import tomllib

import numpy as np
import pytest
from pyproj import CRS, Proj, Transformer
from scipy.spatial.transform import Rotation

from geo.crs import parse_crs
from geo.errors import GeoError, PlaceMismatch
from geo.frames import LocalFrame
from geo.projection import MapProjection, enu_from_geocentric, geocentric_from_geodetic, geodetic_from_geocentric

DEGREE = math.pi / 180.0
WGS84_A, WGS84_B = 6378137.0, 6356752.314245179
EPS_GEOCENTRIC_M = 1e-9  # spacing of float64 at 6.4e6 m
# Measured worst case over PLACES: 1.4e-8 m (EPSG:5514, whose iteration in PROJ ends there).
ROUND_TRIP_M = 2e-8
# Differences of two points 20 m apart, each rounded to EPS_GEOCENTRIC_M in three coordinates.
ROTATION_ERROR = 1e-9

PLACES = {
    "EPSG:25832+5778": (13.0, 47.0), "EPSG:4979": (13.0, 47.0), "EPSG:4326+5773": (179.9999, -80.0),
    "EPSG:32733+5773": (15.0, -33.0), "EPSG:32632+4979": (9.0, 0.0), "EPSG:32661+3855": (30.0, 89.9999),
    "EPSG:32761+3855": (-120.0, -75.0), "EPSG:3031+3855": (60.0, -70.0), "EPSG:2230+6360": (-117.0, 33.0),
    "EPSG:2992+6360": (-120.0, 44.0), "EPSG:27700+5701": (-3.0, 55.0), "EPSG:2056+5728": (8.0, 47.0),
    "EPSG:28992+5709": (5.0, 52.0), "EPSG:4807+5720": (1.0, 47.0), "EPSG:5514+5705": (15.0, 50.0),
    "EPSG:3857+3855": (100.0, 60.0), "EPSG:2193+7839": (173.0, -41.0), "EPSG:3035+5730": (10.0, 50.0),
    "EPSG:3375+5714": (102.0, 4.0),
}  # fmt: skip


def frame_at(text: str, height_m: float = 100.0) -> LocalFrame:
    crs = parse_crs(text)
    lon, lat = (value * DEGREE for value in PLACES[text])
    if crs.prime_meridian.name == "Paris":
        lon -= 2.5969213 * 0.9 * DEGREE  # in grads east of Greenwich
    return LocalFrame(crs, tuple(MapProjection(crs).crs_from_geodetic(lon, lat, height_m)))


def opk(omega, phi, kappa) -> np.ndarray:
    return Rotation.from_euler("XYZ", [omega, phi, kappa], degrees=True).as_matrix()


@pytest.mark.parametrize("text", PLACES)
def test_crs_to_local_and_back_returns_to_the_same_point(text, rng):
    frame = frame_at(text)
    points = rng.uniform(-2000.0, 2000.0, (500, 3))
    again = frame.local_from_crs(frame.crs_from_local(points))
    np.testing.assert_allclose(again, points, rtol=0.0, atol=ROUND_TRIP_M)
    np.testing.assert_allclose(frame.local_from_crs(frame.origin), 0.0, atol=ROUND_TRIP_M)


@pytest.mark.parametrize(
    "text", ["EPSG:25832+5778", "EPSG:4979", "EPSG:32733+5773", "EPSG:32761+3855", "EPSG:2230+6360"]
)
def test_local_agrees_with_the_topocentric_step_of_proj(text, rng):
    frame, unit_m = frame_at(text), 1200.0 / 3937.0 if text.endswith("6360") else 1.0
    points = frame.crs_from_local(rng.uniform(-500.0, 500.0, (100, 3)))
    horizontal = frame.crs.sub_crs_list[0] if frame.crs.is_compound else frame.crs
    geodetic = Transformer.from_crs(horizontal, horizontal.geodetic_crs, always_xy=True)
    lon0, lat0 = geodetic.transform(*frame.origin[:2])
    lon, lat = geodetic.transform(points[:, 0], points[:, 1])
    ellps = f"+a={WGS84_A} +rf={horizontal.ellipsoid.inverse_flattening!r}"
    topocentric = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=cart {ellps} "
        f"+step +proj=topocentric {ellps} +lon_0={lon0!r} +lat_0={lat0!r} +h_0={unit_m * frame.origin[2]!r}"
    )
    oracle = np.stack(topocentric.transform(lon, lat, unit_m * points[:, 2]), axis=-1)
    np.testing.assert_allclose(frame.local_from_crs(points), oracle, rtol=0.0, atol=ROUND_TRIP_M)


@pytest.mark.parametrize("text", ["EPSG:25832+5778", "EPSG:32733+5773", "EPSG:27700+5701", "EPSG:2056+5728"])
def test_grid_axes_at_the_origin_are_turned_by_the_meridian_convergence(text):
    frame = frame_at(text)
    rotation = frame.local_from_grid(frame.origin)
    horizontal = frame.crs.sub_crs_list[0]
    lon, lat = Transformer.from_crs(horizontal, horizontal.geodetic_crs, always_xy=True).transform(*frame.origin[:2])
    convergence = Proj(horizontal).get_factors(lon, lat).meridian_convergence * DEGREE
    # PROJ differentiates with steps of 1e-5 rad: 1e-7 rad is what its own number is good for.
    assert math.atan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(-convergence, abs=1e-6)
    np.testing.assert_allclose(rotation[:, 2], [0.0, 0.0, 1.0], rtol=0.0, atol=ROTATION_ERROR)


def test_grid_axes_of_longitude_and_latitude_are_east_and_north_at_the_point():
    frame = frame_at("EPSG:4979")
    point = np.add(frame.origin, [0.01, -0.005, 50.0])
    there, here = (enu_from_geocentric(*(np.asarray(p[:2]) * DEGREE)) for p in (point, frame.origin))
    np.testing.assert_allclose(frame.local_from_grid(point), here @ there.T, rtol=0.0, atol=ROTATION_ERROR)


@pytest.mark.parametrize("text", PLACES)
def test_grid_axes_are_a_rotation_everywhere(text, rng):
    frame = frame_at(text)
    points = frame.crs_from_local(rng.uniform(-1000.0, 1000.0, (4, 5, 3)))
    rotations = frame.local_from_grid(points)
    assert rotations.shape == (4, 5, 3, 3)
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, -1, -2), np.broadcast_to(np.eye(3), (4, 5, 3, 3)),
                               atol=1e-14)  # fmt: skip
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-14)


@pytest.mark.parametrize("name", ["quick", "river", "wreck_water"])
def test_poses_in_crs_become_the_poses_that_were_given_in_local(data_dir, name):
    survey = tomllib.loads((data_dir / name / "survey.toml").read_text())
    frame = LocalFrame(parse_crs(survey["crs"]), tuple(survey["local"]["origin"]))
    lines = (data_dir / name / "sparse/0/images.txt").read_text().splitlines()
    poses = {words[9]: np.array(words[1:8], float) for words in map(str.split, lines) if words and ".jpg" in words[-1]}
    rows = list(csv.DictReader((data_dir / name / "cameras.csv").read_text().splitlines()))
    assert len(rows) == len(poses)
    for row in rows:
        position = np.array([row["easting"], row["northing"], row["height"]], float)
        qw, qx, qy, qz, *translation = poses[row["image"]]
        cam_from_local = Rotation.from_quat([qx, qy, qz, qw]).as_matrix()
        # The table gives five decimals: half a unit of the last one.
        np.testing.assert_allclose(frame.local_from_crs(position), -cam_from_local.T @ translation, rtol=0.0, atol=1e-5)
        grid_from_camera = opk(float(row["omega"]), float(row["phi"]), float(row["kappa"]))
        local_from_cam = frame.local_from_grid(position) @ grid_from_camera @ np.diag([1.0, -1.0, -1.0])
        # Angles with eight decimals of a degree (1e-10 rad) and quaternions with nine or more digits.
        np.testing.assert_allclose(local_from_cam, cam_from_local.T, rtol=0.0, atol=1e-8)


def test_a_survey_across_the_antimeridian_stays_in_one_piece():
    frame = LocalFrame(parse_crs("EPSG:4979"), (179.9999, -17.0, 5.0))
    points = frame.crs_from_local([[-500.0, 0.0, 0.0], [500.0, 0.0, 0.0]])
    assert 0.0 < points[1, 0] - points[0, 0] < 0.01
    np.testing.assert_allclose(frame.local_from_crs(points)[:, 0], [-500.0, 500.0], rtol=0.0, atol=ROUND_TRIP_M)


def test_points_that_are_not_finite_or_not_on_the_map_become_nan_and_leave_the_others_alone():
    frame = frame_at("EPSG:25832+5778")
    points = np.array(
        [frame.origin, [np.nan, 5.2e6, 0.0], [np.inf, 5.2e6, 0.0], [5e5, 5.2e6, np.nan], [1e12, 1e12, 0.0]]
    )
    local = frame.local_from_crs(points)
    assert np.isnan(local[1:]).all()
    np.testing.assert_allclose(local[0], 0.0, atol=ROUND_TRIP_M)
    back = frame.crs_from_local([[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [1.0, 2.0, 3.0]])
    assert np.isnan(back[:2]).all()
    assert np.isfinite(back[2]).all()
    rotations = frame.local_from_grid(points)
    assert np.isnan(rotations[1:]).all()
    assert np.isfinite(rotations[0]).all()


def test_empty_arrays_and_single_points_keep_their_shape():
    frame = frame_at("EPSG:25832+5778")
    assert frame.local_from_crs(np.zeros((0, 3))).shape == (0, 3)
    assert frame.crs_from_local([1.0, 2.0, 3.0]).shape == (3,)
    with pytest.raises(ValueError, match=r"expected points of shape \(\.\.\., 3\), got \(4, 2\)"):
        frame.local_from_crs(np.zeros((4, 2)))
    with pytest.raises(ValueError, match="expected points"):
        frame.crs_from_local(3.0)


def test_a_frame_survives_pickle_and_copy_and_is_equal_to_its_twin():
    frame = frame_at("EPSG:25832+5778")
    point = np.add(frame.origin, [10.0, 20.0, 3.0])
    for twin in (pickle.loads(pickle.dumps(frame)), copy.deepcopy(frame)):
        assert twin == frame
        np.testing.assert_array_equal(twin.local_from_crs(point), frame.local_from_crs(point))


@pytest.mark.parametrize(
    ("crs", "origin", "words"),
    [
        ("EPSG:25832+5778", (5194736.0, 589012.0, 2105.0), "degrees outside the area"),
        ("EPSG:25832+5778", (math.nan, 5194736.0, 2105.0), "not three finite numbers"),
        ("EPSG:25832+5778", (589012.0, 5194736.0), "not three finite numbers"),
        ("EPSG:25832+5778", (1e12, 1e12, 0.0), "not on the map"),
        ("EPSG:4979", (47.0, 130.0, 0.0), "easting \\(or longitude\\) comes before"),
    ],
)
def test_an_origin_that_cannot_be_meant_is_refused(crs, origin, words):
    with pytest.raises(PlaceMismatch, match=words):
        LocalFrame(parse_crs(crs), origin)
    with pytest.raises(GeoError, match="no vertical part"):
        LocalFrame(CRS("EPSG:25832"), (589012.0, 5194736.0, 2105.0))


def test_geodetic_coordinates_return_from_geocentric_ones_at_all_latitudes_and_depths():
    lat, lon, height = np.meshgrid(np.linspace(-90, 90, 37) * DEGREE, [-3.0, 0.0, 2.0], [-11e3, 0.0, 9e3, 2e4])
    xyz = geocentric_from_geodetic(lon, lat, height, a=WGS84_A, b=WGS84_B)
    lon_2, lat_2, height_2 = geodetic_from_geocentric(xyz, a=WGS84_A, b=WGS84_B)
    again = geocentric_from_geodetic(lon_2, lat_2, height_2, a=WGS84_A, b=WGS84_B)
    np.testing.assert_allclose(again, xyz, rtol=0.0, atol=4 * EPS_GEOCENTRIC_M)
    np.testing.assert_allclose(height_2, height, rtol=0.0, atol=4 * EPS_GEOCENTRIC_M)
    np.testing.assert_allclose(lat_2 * WGS84_A, lat * WGS84_A, rtol=0.0, atol=4 * EPS_GEOCENTRIC_M)


@pytest.mark.parametrize("name", ["EPSG:25832+5778", "EPSG:4979", "EPSG:32661+3855", "EPSG:2230+6360"])
def test_points_in_one_local_frame_are_those_in_another_ten_kilometres_on(name):
    first = frame_at(name)
    second = LocalFrame(first.crs, tuple(first.crs_from_local([8_000.0, -6_000.0, 30.0])))
    points = np.random.default_rng(1).uniform((7_600.0, -6_100.0, -300.0), (8_200.0, -5_500.0, 300.0), (50, 3))
    there = second.from_frame(first)
    moved = second.local_from_crs(first.crs_from_local(points))
    np.testing.assert_allclose(there(points), moved, rtol=0.0, atol=5.0 * ROUND_TRIP_M)
    # Level ground falls by d^2 / 2 r, and tilts by d / r.
    assert there([0.0, 0.0, 0.0])[2] == pytest.approx(-30.0 - 10_000.0**2 / 6.371e6, abs=0.1)
    assert math.acos(there.rotation[2, 2]) == pytest.approx(10_000.0 / 6.371e6, rel=0.01)
    with pytest.raises(ValueError, match="expected a local frame of"):
        first.from_frame(frame_at("EPSG:27700+5701"))
