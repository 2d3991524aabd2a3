"""Marks that are proposed in other photographs: by likeness through the water, and of coded and chequered targets."""

import cv2
import numpy as np
import pytest
from small_survey import E0, LEVEL, N0, TOML, small_survey

from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.marking.mark_store import PointKey
from survey.marking.proposals import coded, corner
from survey.marking.session import MarkingSession

DEPTH_M = 0.9
# Of a photograph in 64 x 48 px of the small survey, which is drawn ten times as large here.
SIZE, FOCAL = (640, 480), 1000.0


@pytest.fixture
def textured(tmp_path):
    """The small survey, over a level bed with texture, as its cameras see that through the water."""
    toml = TOML.replace("[64, 48]", f"[{SIZE[0]}, {SIZE[1]}]").replace("focal_px = 100.0", f"focal_px = {FOCAL}")
    toml = toml.replace("[32.0, 24.0]", f"[{SIZE[0] / 2}, {SIZE[1] / 2}]")
    folder = small_survey(tmp_path / "s", toml=toml)
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(path), np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    survey = load_survey(folder)
    ground = np.random.default_rng(7).integers(0, 255, (1200, 1200), dtype=np.uint8)
    ground = cv2.GaussianBlur(ground, (0, 0), 2.0)
    ground = cv2.normalize(ground, None, 0, 255, cv2.NORM_MINMAX)
    across, down = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    level = float(survey.water.height(0.0, 0.0))
    for view in survey.views:
        path = view.camera.paths(np.stack([across, down], axis=-1), survey.water)
        under = path.at(path.air_length + 1.0) - path.crossing
        at = path.crossing - under * ((DEPTH_M + path.crossing[..., 2] - level) / under[..., 2])[..., None]
        u, v = (600.0 + 40.0 * (at[..., axis] - 4.0) for axis in (0, 1))
        cv2.imwrite(str(view.path), cv2.remap(ground, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR))
    return folder, survey


def test_what_looks_like_a_mark_under_water_is_proposed_where_other_photographs_show_it(textured):
    folder, survey = textured
    session = MarkingSession(folder)
    true = (E0 + 3.2, N0 - 1.3, LEVEL - DEPTH_M)
    # Its coordinates are off by 10 px, as GPS has them.
    key = session.store.add("ground", "p", (true[0] + 0.15, true[1] - 0.1, true[2] + 0.1))
    local = survey.frame.local_from_crs(np.array(true))
    pixels = {view.name: view.camera.project(local, survey.water) for view in survey.views}
    session.store.set(key, "0001.jpg", tuple(pixels["0001.jpg"].tolist()))
    found = session.propose(key)
    shown = {view.name for view in survey.views if view.camera.sees(pixels[view.name])} - {"0001.jpg"}
    assert {each["image"] for each in found} == shown
    for each in found:
        assert each["pixel"] == pytest.approx(pixels[each["image"]], abs=0.3)
    assert session.store.marks() == {PointKey("ground", "p"): {"0001.jpg": pytest.approx(pixels["0001.jpg"], abs=1e-3)}}


def test_a_coded_target_is_found_by_the_number_in_the_name_of_its_point():
    code = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11), 7, 80)
    grey = np.full((400, 500), 200, dtype=np.uint8)
    corners = np.array([[210.0, 150.0], [275.0, 165.0], [262.0, 228.0], [190.0, 210.0]])
    square = np.array([[-0.5, -0.5], [79.5, -0.5], [79.5, 79.5], [-0.5, 79.5]])
    seen_as = cv2.getPerspectiveTransform(square.astype(np.float32), corners.astype(np.float32) - 0.5)
    cv2.warpPerspective(code, seen_as, (500, 400), dst=grey, borderMode=cv2.BORDER_TRANSPARENT)
    middle = cv2.perspectiveTransform(np.array([[[39.5, 39.5]]]), seen_as)[0, 0] + 0.5
    assert coded(grey, "GCP 07", None).pixel == pytest.approx(middle, abs=0.5)
    assert coded(grey, "GCP 8", None) is None
    assert coded(grey, "pier", None) is None


def test_a_mark_goes_to_the_corner_of_a_chequered_target():
    u, v = np.meshgrid(np.arange(60) + 0.5 - 31.3, np.arange(60) + 0.5 - 28.6)
    turned = (0.9 * u + 0.44 * v) * (0.9 * v - 0.44 * u)
    grey = cv2.GaussianBlur(np.where(turned > 0, 230, 30).astype(np.uint8), (0, 0), 1.0)
    assert corner(grey, (29.0, 31.0)) == pytest.approx((31.3, 28.6), abs=0.1)
    # Neither where nothing is, at the border, nor on texture or an edge.
    plain = np.full((60, 60), 90, dtype=np.uint8)
    texture = cv2.GaussianBlur(np.random.default_rng(1).normal(128.0, 200.0, (60, 60)), (0, 0), 2.0).clip(0, 255)
    edge = np.where(u > 0, 200, 40)
    for each, pixel in ((plain, (30.0, 30.0)), (plain, (0.0, 60.0)), (texture, (30.0, 30.0)), (edge, (31.0, 30.0))):
        with pytest.raises(SurveyError, match="no corner of a chequered target"):
            corner(each.astype(np.uint8), pixel)
