"""What the directions of photographs promise for a level that is not given, before anything is computed."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_survey import LEVEL, rows_of, small_survey, unposed

from survey.folder.found import find_survey
from survey.folder.survey import load_survey
from survey.photos.xmp import Motion
from survey.plan.check import DOWN_DEG, check_survey, level_warning, require_processable
from survey.plan.choices import Choices
from survey.settings.config import WaterConfig
from tests.changed_survey import changed

ANGLES = st.lists(st.one_of(st.floats(0.0, DOWN_DEG - 0.5), st.floats(DOWN_DEG + 0.5, 80.0)), min_size=3, max_size=40)


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    """A survey with poses whose level the photographs have to tell."""
    survey = load_survey(small_survey(tmp_path_factory.mktemp("posed") / "s"))
    return changed(survey, is_level_known=False)


@pytest.fixture(scope="module")
def found(posed):
    found = find_survey(posed.folder)
    return replace(found, config=replace(found.config, water=WaterConfig()))


def looking(survey, tilts, yaw):
    """The survey with views tilted by angles [deg]."""
    view = survey.views[0]
    turns = [Rotation.from_euler("zyx", [yaw, tilt, 180.0], degrees=True).as_matrix().T for tilt in tilts]
    cameras = [replace(view.camera, cam_from_local=turn) for turn in turns]
    return replace(survey, views=tuple(replace(view, camera=camera) for camera in cameras))


def flown(found, tilts, yaw, num_untold):
    """The same as photographs whose XMP has the attitude of the gimbal, and some whose has none."""
    head = next(iter(found.headers.values()))
    motions = [Motion(gimbal_deg=(yaw, tilt - 90.0, 0.0)) for tilt in tilts] + [Motion()] * num_untold
    return replace(found, headers={f"{i}.jpg": replace(head, motion=motion) for i, motion in enumerate(motions)})


@given(tilts=ANGLES, yaw=st.floats(-180.0, 180.0), num_untold=st.integers(0, 5))
def test_blocks_that_look_straight_down_are_named_with_and_without_poses(posed, found, tilts, yaw, num_untold):
    down = sum(tilt < DOWN_DEG for tilt in tilts)
    by_poses = level_warning(found, looking(posed, tilts, yaw))
    by_heads = level_warning(flown(found, tilts, yaw, num_untold), None)
    assert by_poses == by_heads
    if 10 * (len(tilts) - down) >= len(tilts):
        assert by_poses is None
    else:
        assert f"{down} of {len(tilts)} photographs look straight down" in by_poses
        assert "level_m" in by_poses
        assert "tilted" in by_poses


@pytest.mark.parametrize("water", [None, WaterConfig(level_m=3.0), WaterConfig(clicks="clicks.csv")])
def test_a_level_that_is_given_in_any_way_and_a_dry_survey_leave_no_doubt(posed, found, water):
    told = flown(replace(found, config=replace(found.config, water=water)), [0.0] * 20, 0.0, 0)
    assert level_warning(told, None) is None
    assert level_warning(told, changed(looking(posed, [0.0] * 20, 0.0), is_level_known=True)) is None


def test_without_attitudes_it_is_said_on_what_it_depends(found):
    assert "the viewing directions of the photographs are not known yet" in level_warning(
        flown(found, [], 0.0, 4), None
    )


def test_check_says_it_first(tmp_path):
    folder = unposed(tmp_path / "s", (f"level_m = {LEVEL}\n", ""))
    checked = require_processable(folder)
    assert "not known yet" in checked.level_warning
    sections = check_survey(folder, chosen=Choices(device="cpu"), checked=checked)
    (warnings,) = [section for section in sections if section.title == "Warnings"]
    assert warnings.rows[0][1] == checked.level_warning
    assert "oblique photographs" in rows_of(sections, "Found")["water"]
    assert require_processable(unposed(tmp_path / "given")).level_warning is None
