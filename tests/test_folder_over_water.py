"""Blocks whose start is under their water or far above it, and starts that are doubted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from placed_by_gps import solved
from small_survey import LEVEL, small_survey, unposed

from geo.crs import parse_crs
from survey.errors import ConfigError
from survey.folder.found import find_survey
from survey.folder.heights import start_height_warnings
from survey.folder.sfm_views import require_solvable
from survey.folder.survey import Survey, load_survey
from survey.photos.exif import Exif
from survey.plan.check import check_survey

NAMES = ["0000.jpg", "0001.jpg", "0002.jpg"]
# Of the cameras over the true water, of the one matched point.
HEIGHT_M, POINT_M = 20.0, -2.0


def survey_with(folder: Path, monkeypatch, over: float, std: str = "") -> Survey:
    """The small survey with a level so far over the true one [m], as structure from motion places it by EXIF."""
    solved(monkeypatch, NAMES)
    stated = f"position_std_m = {std}\n" if std else ""
    return load_survey(
        unposed(folder, (f"level_m = {LEVEL}", f"level_m = {LEVEL + over}"), ("[water]", f"{stated}[water]"))
    )


@pytest.mark.parametrize("over", [100.0, 150.0, -400.0])
def test_a_block_under_its_water_or_far_above_it_begins_over_it(tmp_path, monkeypatch, over):
    survey = survey_with(tmp_path / "s", monkeypatch, over)
    depth = survey.water.depth(np.array([*survey.observations.points, *(view.camera.centre for view in survey.views)]))
    # A tenth of the flying height over the matched points.
    assert depth[0] == pytest.approx(0.1 * (HEIGHT_M - POINT_M))
    np.testing.assert_allclose(depth[1:], depth[0] - (HEIGHT_M - POINT_M))
    (said,) = (text for text in survey.findings.warnings if "taken from the water level" in text)
    assert f"({HEIGHT_M - over:.1f} to {HEIGHT_M - over:.1f} m over it)" in said
    assert ("cameras under the water" in said) == (over > 0.0)
    # The positions stay what they are: the adjustment finds by how much they are off.
    for view in survey.views:
        prior = survey.observations.priors[view.name]
        assert prior.common_up_std == 80.0
        assert float(survey.water.depth(prior.position)) == pytest.approx(over - HEIGHT_M, abs=1e-3)


@pytest.mark.parametrize(
    ("over", "std"),
    # A receiver with corrections; more than the pressure of any day explains; another datum explains it.
    [(33.0, "0.03"), (300.0, ""), (-700.0, ""), (49.0, "")],
)
def test_heights_that_cannot_be_off_by_so_much_are_refused(tmp_path, monkeypatch, over, std):
    with pytest.raises(
        ConfigError, match=r"if they are a barometer's, say so: \[cameras\] position_std_m = \[3, 3, 80\]"
    ):
        survey_with(tmp_path / "s", monkeypatch, over, std)


@pytest.mark.parametrize(("over", "std", "is_moved"), [(49.0, "[3.0, 3.0, 80.0]", True), (15.0, "", False)])
def test_heights_said_to_be_off_by_so_much_are_not_refused_and_a_block_over_its_water_stays(
    tmp_path, monkeypatch, over, std, is_moved
):
    survey = survey_with(tmp_path / "s", monkeypatch, over, std)
    assert any("taken from the water level" in text for text in survey.findings.warnings) == is_moved
    assert is_moved or float(survey.water.depth(survey.views[0].camera.centre)) == pytest.approx(-5.0)


@pytest.mark.parametrize(
    ("std", "said"),
    [
        (
            "",
            "may be 80 m off, the same for all: the level of the water places the block, unless positions prove good "
            "to 0.1 m",
        ),
        ("[2.0, 2.0, 4.0]", "may be 4 m off, the same for all: the level of the water places the block"),
        ("0.03", None),
    ],
)
def test_check_says_it_before_structure_from_motion(tmp_path, std, said):
    stated = f"position_std_m = {std}\n" if std else ""
    folder = unposed(tmp_path / "s", ("[water]", f"{stated}[water]"))
    rows = dict(next(section.rows for section in check_survey(folder) if section.title == "Found"))
    assert rows.get("heights", "").startswith(said) if said else "heights" not in rows


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
    over = {f"{i}.jpg": over_water for i in range(4)}
    found = start_height_warnings(over, headers(above_start), LEVEL, (46.9, 10.17), parse_crs("EPSG:25832+5778"))
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
