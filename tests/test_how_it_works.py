"""docs/how-it-works.md tells the truth about its example: its geometry is computed again from what it gives."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from geo.crs import parse_crs
from geo.frames import LocalFrame
from refract import FlatWater, PinholeCamera
from survey.simulate.drawn import DrawnScene, stage_drawing

PAGE = Path(__file__).resolve().parent.parent / "docs" / "how-it-works.md"
TEXT = " ".join(PAGE.read_text(encoding="utf-8").split())
SCENE = DrawnScene()
PIXEL, VIEW = (30.5, 30.5), 9
HEIGHT = -2.842054
NUMBER = r"[−-]?\d+(?:\.\d+)?"


def told(before: str) -> np.ndarray:
    """The numbers in the first brackets after some words."""
    found = re.search(re.escape(before) + rf"\s*\(({NUMBER}(?:,\s*{NUMBER})*)\)", TEXT)
    assert found, f"the page no longer says {before!r}"
    return np.array([float(n.replace("−", "-")) for n in re.split(r",\s*", found[1])])


@pytest.fixture(scope="module")
def frame() -> LocalFrame:
    return LocalFrame(parse_crs(SCENE.crs), tuple(told("topocentric at the origin")))


@pytest.fixture(scope="module")
def camera(frame) -> PinholeCamera:
    """The camera of the scene, turned from the frame that it was drawn in into that of the survey."""
    drawn_in = LocalFrame(parse_crs(SCENE.crs), (*SCENE.origin, SCENE.level_m))
    own = SCENE.cameras()[VIEW]
    ahead = own.centre + own.cam_from_local
    centre, *axes = frame.local_from_crs(drawn_in.crs_from_local(np.vstack([own.centre, ahead])))
    return PinholeCamera(centre, np.array(axes) - centre, own.fx, own.fy, own.cx, own.cy, own.width, own.height)


@pytest.fixture(scope="module")
def water(frame) -> FlatWater:
    return FlatWater(tuple(frame.local_from_crs((*SCENE.origin, SCENE.level_m))), n_water=SCENE.n_water)


def test_the_camera_stands_where_the_page_says(frame, camera):
    assert told("example is the pixel") == pytest.approx(PIXEL)
    np.testing.assert_allclose(frame.crs_from_local(camera.centre), told("The centre of `0009.jpg` at"), atol=1e-6)
    np.testing.assert_allclose(camera.centre, told("becomes"), atol=1e-5)


def test_the_path_bends_as_the_page_says(camera, water):
    path = camera.paths(np.array(PIXEL), water)
    np.testing.assert_allclose(path.air_direction, told("undistorted and normalised:"), atol=1e-6)
    np.testing.assert_allclose(path.crossing, told("it meets the water at"), atol=1e-5)
    np.testing.assert_allclose(path.water_direction, told("the ray continues along"), atol=1e-6)
    assert f"After {path.air_length:.5f} m it meets" in TEXT
    for direction in (path.air_direction, path.water_direction):
        angle = math.degrees(math.acos(-direction @ np.array(water.up)))
        assert f"{angle:.4f}° off the normal" in TEXT
    air, wet = (np.hypot(*d[:2]) / -d[2] for d in (path.air_direction, path.water_direction))
    assert f"{-HEIGHT * (air - wet):.2f} m to the side" in TEXT


def test_the_point_lies_where_the_page_says(frame, camera, water):
    point = camera.paths(np.array(PIXEL), water).at_height(np.array(HEIGHT), water)
    np.testing.assert_allclose(point, told("is computed in float64,"), atol=1e-5)
    stored = frame.crs_from_local(point)
    np.testing.assert_allclose(stored, told("and from there"), atol=1e-4)
    assert "| x, y, z | " + ", ".join(f"{c:.3f}" for c in stored) in TEXT
    assert f"| depth | {SCENE.level_m - stored[2]:.3f} |" in TEXT


def test_the_true_height_is_the_one_that_the_page_says(water):
    drawing = stage_drawing(SCENE)
    point = drawing.renderer.trace(drawing.cameras[VIEW], np.array([PIXEL])).points
    assert f"true is −{drawing.water.depth(point)[0]:.3f} m" in TEXT
