"""Geometry of marking against closed forms: Snell's law over a plane, collinearity, covariance of an intersection."""

import math

import numpy as np
import pytest

from refract import FlatWater, PinholeCamera
from refract.lens import Lens
from survey.marking.geometry import by_gain, crossing, epipolar_curve, seen_at
from survey.photos.cameras import View, intersect

HEIGHT, FOCAL, INDEX = 30.0, 1000.0, 1.34
LENS = Lens("SIMPLE_PINHOLE", (FOCAL, 600.0, 400.0), 1200, 800)
WATER = FlatWater((0.0, 0.0, 0.0), n_water=INDEX)
DOWN = np.diag([1.0, -1.0, -1.0])


def nadir(name: str, x: float, y: float = 0.0) -> View:
    return View(name, None, LENS.camera(np.array([x, y, HEIGHT]), DOWN), LENS)


def oblique(name: str) -> View:
    """A camera 20 m south of the place and 12 m beside it, which looks at it from 40 degrees above."""
    forward = np.array([-0.35, 0.75, -0.75]) / np.linalg.norm([-0.35, 0.75, -0.75])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return View(
        name, None, LENS.camera([14.0, -20.0, 24.0], np.array([right, np.cross(forward, right), forward])), LENS
    )


def pixel_of(view: View, place: np.ndarray) -> np.ndarray:
    """Where a camera over the water sees a point below it: the angle in air by bisection of Snell's law."""
    centre = view.camera.centre
    way = (place - centre)[:2]
    away, low, high = float(np.hypot(*way)), 0.0, math.radians(89.0)
    for _ in range(100):
        angle = 0.5 * (low + high)
        reach = centre[2] * math.tan(angle) - place[2] * math.tan(math.asin(math.sin(angle) / INDEX))
        low, high = (angle, high) if reach < away else (low, angle)
    x, y, z = view.camera.cam_from_local @ np.array([*(math.tan(low) * way / away), -1.0])
    return np.array([600.0 + FOCAL * x / z, 400.0 + FOCAL * y / z])


VIEWS = [nadir("a", -6.0), nadir("b", 5.0, 2.0), nadir("c", 1.0, -7.0)]
PLACE = np.array([2.0, 3.0, -4.0])


def test_a_place_under_water_is_predicted_where_snells_law_shows_it():
    for view in (*VIEWS, oblique("d")):
        assert seen_at(view, PLACE, WATER) == pytest.approx(tuple(pixel_of(view, PLACE)), abs=1e-6)
    # Straight rays are some ten pixels off.
    straight = seen_at(VIEWS[0], PLACE, None)
    assert math.dist(straight, seen_at(VIEWS[0], PLACE, WATER)) > 5.0
    assert seen_at(VIEWS[0], np.array([100.0, 0.0, 0.0]), WATER) is None
    assert seen_at(VIEWS[0], np.array([0.0, 0.0, 40.0]), WATER) is None


def distance_to(polyline: np.ndarray, pixel) -> float:
    """Of a pixel to the nearest piece of a curve."""
    start, step = polyline[:-1], np.diff(polyline, axis=0)
    share = np.clip(((pixel - start) * step).sum(axis=1) / np.maximum((step**2).sum(axis=1), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(start + share[:, None] * step - pixel, axis=1).min())


def test_the_epipolar_curve_passes_through_the_place_and_bends_at_the_water():
    a, b = VIEWS[0], oblique("b")
    curve = epipolar_curve(a, tuple(pixel_of(a, PLACE)), b, WATER)
    assert distance_to(curve.wet, pixel_of(b, PLACE)) < 0.05
    # Above the water it is a line, which goes on to where the ray meets the water.
    line = curve.dry - curve.dry[0]
    normal = np.array([-line[-1][1], line[-1][0]]) / np.linalg.norm(line[-1])
    assert np.abs(line @ normal).max() < 1e-6
    meets = crossing(a, tuple(pixel_of(a, PLACE)), WATER)
    assert meets[2] == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(curve.dry[-1], seen_at(b, meets, None), atol=1e-6)
    assert np.allclose(curve.wet[0], curve.dry[-1], atol=1e-6)
    # Below it, it leaves that line: a ray that is not bent would miss the place.
    assert distance_to(epipolar_curve(a, tuple(pixel_of(a, PLACE)), b, None).dry, pixel_of(b, PLACE)) > 1.0


def test_a_dry_epipolar_curve_reaches_from_the_camera_to_infinity():
    a, b, _ = VIEWS
    curve = epipolar_curve(a, (700.0, 300.0), b, None)
    assert not len(curve.wet)
    far = PinholeCamera.project(b.camera, a.camera.centre + 1e9 * a.camera.directions(np.array([700.0, 300.0])), None)
    assert np.linalg.norm(curve.dry[-1] - far) < 0.01 * FOCAL
    assert not len(epipolar_curve(a, (700.0, 300.0), a, None).dry)


def test_marks_meet_in_their_place_with_the_covariance_of_least_squares():
    cameras = [view.camera for view in VIEWS]
    met = intersect(cameras, np.array([pixel_of(view, PLACE) for view in VIEWS]), np.full(3, 0.5), WATER)
    assert np.abs(met.place - PLACE).max() < 1e-6
    assert np.abs(met.residuals).max() < 1e-5
    # Derivatives of Snell's law by differences of a millimetre.
    steps = 1e-3 * np.eye(3)
    slopes = [
        [(pixel_of(view, PLACE + step) - pixel_of(view, PLACE - step)) / 2e-3 for step in steps] for view in VIEWS
    ]
    slope = np.concatenate([np.transpose(each) for each in slopes])
    assert np.allclose(met.covariance, 0.25 * np.linalg.inv(slope.T @ slope), rtol=1e-4)


def test_marks_of_a_dry_place_meet_on_straight_rays_and_rays_from_one_place_nowhere():
    place, cameras = np.array([2.0, 3.0, 1.5]), [view.camera for view in VIEWS]
    pixels = np.array([camera.project(place, None) for camera in cameras])
    assert np.abs(intersect(cameras, pixels, np.full(3, 0.5), WATER).place - place).max() < 1e-6
    cameras = [nadir("a", 0.0).camera, nadir("b", 0.1).camera]
    pixels = np.array([camera.project(PLACE, WATER) for camera in cameras])
    assert intersect(cameras, pixels, np.full(2, 0.5), WATER) is None
    assert intersect(cameras[:1], pixels[:1], np.full(1, 0.5), WATER) is None


def test_residuals_are_marks_less_the_place_as_it_is_seen():
    cameras = [view.camera for view in VIEWS]
    pixels = np.array([camera.project(PLACE, WATER) for camera in cameras])
    pixels[0, 0] += 3.0
    met = intersect(cameras, pixels, np.full(3, 0.5), WATER)
    shown = np.array([camera.project(met.place, WATER) for camera in cameras])
    assert np.abs(met.residuals - (pixels - shown)).max() < 1e-6
    assert met.residuals[0][0] > 0.1


def test_the_next_photograph_is_the_one_that_tells_most():
    views = [nadir("marked", 0.0), nadir("beside", 0.5), nadir("across", 9.0), nadir("elsewhere", 300.0)]
    place = np.array([1.0, 0.0, -1.0])
    order = by_gain(views, place, WATER, views[:1], 0.5)
    assert order == ["across", "beside"]
    # By the definition: the trace of the covariance of both marks with a place known to a metre.
    cameras = {view.name: view.camera for view in views}
    traces = {}
    for name in order:
        pair = [cameras["marked"], cameras[name]]
        pixels = np.array([camera.project(place, WATER) for camera in pair])
        met = intersect(pair, pixels, np.full(2, 0.5), WATER)
        if met is not None:
            traces[name] = np.trace(np.linalg.inv(np.linalg.inv(met.covariance) + np.eye(3)))
    assert list(traces) == ["across"]
    assert traces["across"] < 0.1
