"""The map of control and check points: whose residuals it shows, and that its arrows point where points are off."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from small_survey import E0, LEVEL, N0, small_survey

from survey.adjust.result.adjustment import ControlResidual
from survey.control.points import Checkpoint, Control, ControlPoint
from survey.folder.survey import load_survey
from survey.report.adjustment_pictures import Residual, clip_outliers, draw_residuals, residuals_of
from survey.report.checkpoints import CheckpointAccuracy, CheckpointRow
from tests.changed_survey import changed


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return load_survey(small_survey(tmp_path_factory.mktemp("survey") / "s"))


def test_adjusted_points_and_the_cloud_at_rods_are_put_together(survey):
    place, local = (E0, N0, LEVEL), np.zeros(3)
    points = tuple(ControlPoint(name, place, local, np.full(3, 0.01), name == "c2") for name in ("c1", "c2"))
    survey = changed(survey, control=Control(points, (), 0.5), checkpoints=(Checkpoint("rod", place, local),))
    rows = (
        CheckpointRow("rod", LEVEL, 1.0, -0.03),
        CheckpointRow("c2", LEVEL, None, 0.5),
        CheckpointRow("far", LEVEL, 1.0, None),
    )
    adjusted = [ControlResidual(name, name == "c2", False, (0.01, 0.02, 0.03), 3, 0.4) for name in ("c1", "c2")]
    found = residuals_of(survey, _Adjusted(adjusted), CheckpointAccuracy(rows, (), 0.25))
    assert [(each.name, each.is_check) for each in found] == [("c1", False), ("c2", True), ("rod", True)]
    assert found[1].off_m == (0.01, 0.02, 0.03)
    assert found[2].off_m[2] == -0.03
    assert np.isnan(found[2].off_m[:2]).all()
    assert residuals_of(survey, None, None) == []


class _Adjusted:
    """What the map takes of an adjustment."""

    def __init__(self, control):
        self.control = control


def middle_of_arrows(survey, path, east: float) -> float:
    """Column of the pixels in the colour of arrows in plan, of points that are off to the east."""
    residuals = [
        Residual("a", (E0, N0), (east, 0.0, 0.0), False),
        Residual("b", (E0 + 4.0, N0 + 8.0), (east, 0.0, 0.0), False),
        Residual("rod", (E0, N0 + 4.0), (np.nan, np.nan, 0.01), True),
    ]
    assert draw_residuals(path, survey, residuals).title == "Control and check points"
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    # Not their sample in the legend below the map.
    pixels = pixels[: int(0.8 * len(pixels))]
    columns = np.argwhere(np.abs(pixels - (0x2F, 0x6F, 0x9F)).sum(axis=2) < 30)[:, 1]
    assert len(columns) > 100
    return float(np.median(columns))


def test_arrows_point_to_where_points_are_off(survey, tmp_path):
    right, left = (middle_of_arrows(survey, tmp_path / f"{east}.png", east) for east in (0.02, -0.02))
    assert right - left > 50.0


def test_a_point_far_off_sets_no_scale_for_the_others():
    off, _, is_far = clip_outliers(
        np.array([(0.02, 0.0, 0.01), (0.0, 0.03, -0.02), (0.01, 0.01, 0.02), (0.8, -2.0, -5.0)])
    )
    long = np.hypot(*off[:, :2].T)
    assert is_far.tolist() == [False, False, False, True]
    # Not a hundredth of the arrow of the wrong one, which is cut.
    assert long[1] > 0.3 * long[3]
