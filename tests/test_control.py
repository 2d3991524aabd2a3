"""Control points, marks and check points: every format, in every CRS, and a sentence for every mistake."""

from __future__ import annotations

import tomllib

import cv2
import numpy as np

from survey.folder.survey import load_survey
from survey.stage_key import stage_key


def test_marks_of_a_drawn_survey_are_where_its_true_lens_shows_the_points(data_dir):
    """Marks are good to 0.4 px; an origin of pixels half a pixel off would show in the mean of 46."""
    survey = load_survey(data_dir / "shore")
    truth = tomllib.loads((data_dir / "shore" / "truth.toml").read_text())
    focal, (cx, cy) = truth["focal_px"], truth["principal_point_px"]
    matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    cameras = {view.name: view.camera for view in survey.views}
    local = {point.name: point.local for point in survey.control.points}
    residuals = []
    for mark in survey.control.marks:
        camera = cameras[mark.view]
        in_cam = camera.cam_from_local @ (local[mark.point] - camera.centre)
        shown, _ = cv2.projectPoints(
            in_cam[None, None], np.zeros(3), np.zeros(3), matrix, np.array(truth["distortion"])
        )
        residuals.append(np.array(mark.pixel) - shown.ravel())
    assert (len(survey.control.points), len(residuals)) == (6, 46)
    assert np.abs(np.mean(residuals, axis=0)).max() < 3.0 * 0.4 / 46**0.5
    assert np.std(residuals) < 0.5


def test_the_control_and_check_points_of_a_drawn_survey_are_in_crs_and_local(data_dir):
    survey = load_survey(data_dir / "shore")
    point, rod = survey.control.points[0], survey.checkpoints[0]
    assert (point.name, point.crs) == ("gcp1", (512345.8136, 5960213.4390, 3.28))
    assert np.abs(survey.frame.crs_from_local(point.local) - point.crs).max() < 1e-6
    assert point.std.tolist() == [0.01, 0.01, 0.01]
    assert survey.control.marks_std_px == 0.5
    assert (len(survey.checkpoints), rod.name, rod.crs[2]) == (20, "rod1", -0.139)
    assert any("std_m = 0.01" in text for text in survey.assumptions)
    assert stage_key(survey.control, survey.checkpoints, survey.priors)
