"""Cameras, water and the height over the take-off point: what cannot all be true."""

from __future__ import annotations

from dataclasses import replace

import pytest
from small_survey import LEVEL, small_survey, unposed

from geo.crs import parse_crs
from survey.folder.faults import start_height_warnings
from survey.folder.found import find_survey
from survey.folder.sfm_views import require_solvable
from survey.folder.survey import load_survey
from survey.photos.exif import Exif


def headers(above_start_m: float | None) -> dict[str, Exif]:
    return {f"{i}.jpg": Exif((64, 48), None, None, 1, "", above_start_m) for i in range(4)}


@pytest.mark.parametrize(
    ("over_water", "above_start", "words"),
    [
        (20.0, 24.0, None),  # a start at the water, with the drift of a barometer
        (60.0, 40.0, None),  # a start from a low cliff
        (20.0, None, None),
        (float("nan"), 20.0, None),
        (20.0, 30.0, "which would lie 10.0 m under the water"),
        (65.0, 20.0, "which would lie 45.0 m over the water"),
    ],
)
def test_a_start_under_the_water_or_far_over_it_is_doubted(over_water, above_start, words):
    found = start_height_warnings(
        {f"{i}.jpg": over_water for i in range(4)},
        headers(above_start),
        LEVEL,
        (46.9, 10.17),
        parse_crs("EPSG:25832+5778"),
    )
    assert [words in text for text in found] == ([] if words is None else [True])


def with_start(found, above_start_m: float):
    return replace(
        found, headers={name: replace(head, above_start_m=above_start_m) for name, head in found.headers.items()}
    )


def test_it_is_said_once_with_poses_and_without(tmp_path):
    posed = find_survey(small_survey(tmp_path / "a"))
    assert load_survey(tmp_path / "a", found=with_start(posed, 19.0)).findings.warnings == ()
    (warning,) = load_survey(tmp_path / "a", found=with_start(posed, 35.0)).findings.warnings
    assert warning.startswith(
        "the cameras are 20.0 m over the water (median), and by RelativeAltitude in XMP 35.0 m over"
    )
    found = find_survey(unposed(tmp_path / "b", (f"level_m = {LEVEL}", f"level_m = {LEVEL - 45.0}")))
    (warning,) = require_solvable(with_start(found, 20.0))
    assert "45.0 m over the water; check that [water] level_m" in warning
