"""What the heads of photographs say of accuracy, attitude, speed and focal length."""

from __future__ import annotations

import math

import pytest
from PIL import ExifTags
from small_survey import write_image

from survey.photos.exif import read_exif
from survey.photos.exif_focal import focal_candidates
from survey.photos.xmp import Motion, Rtk, motion_of, rtk_of

FIXED = 'drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.01234" drone-dji:RtkStdLat="0.02" drone-dji:RtkStdHgt="0.035"'


def test_the_accuracy_of_the_receiver_is_east_north_up():
    assert rtk_of(FIXED) == Rtk(50, (0.01234, 0.02, 0.035))
    assert rtk_of(FIXED.replace('="', ">").replace('"', "<")) == Rtk(50, (0.01234, 0.02, 0.035))


@pytest.mark.parametrize(
    ("old", "new"),
    [('"50"', '"x"'), ('"0.02"', '"0"'), ('"0.02"', '"99999"'), ("RtkStdHgt", "Other"), ('"0.02"', '"1..2"')],
)
def test_an_accuracy_that_cannot_be_is_none(old, new):
    assert rtk_of(FIXED.replace(old, new)) is None


def test_speed_is_turned_from_north_east_down_and_angles_are_yaw_pitch_roll():
    xmp = (
        'drone-dji:GimbalRollDegree="+0.50" drone-dji:GimbalYawDegree="+45.00" drone-dji:GimbalPitchDegree="-89.90" '
        'drone-dji:FlightYawDegree="46" drone-dji:FlightPitchDegree="1.8" drone-dji:FlightRollDegree="3" '
        'drone-dji:FlightXSpeed="+4.0" drone-dji:FlightYSpeed="-1.5" drone-dji:FlightZSpeed="0.25"'
    )
    assert motion_of(xmp) == Motion((45.0, -89.9, 0.5), (46.0, 1.8, 3.0), (-1.5, 4.0, -0.25))
    assert motion_of(xmp.replace("FlightZSpeed", "Other")).speed is None
    assert motion_of("") == Motion()


def test_all_readings_of_the_focal_length_are_given():
    details = {
        ExifTags.Base.FocalLengthIn35mmFilm: 24,
        ExifTags.Base.FocalLength: 8.8,
        ExifTags.Base.FocalPlaneXResolution: 4000.0,
        ExifTags.Base.FocalPlaneResolutionUnit: 3,
        ExifTags.Base.ExifImageWidth: 5472,
        ExifTags.Base.ExifImageHeight: 3648,
    }
    found = focal_candidates((2736, 1824), details, 'drone-dji:CalibratedFocalLength="3666.67"')
    by_source = {candidate.source: candidate.focal_px for candidate in found}
    assert by_source["35 mm film, by width"] == pytest.approx(24.0 / 36.0 * 2736.0)
    assert by_source["35 mm film, by diagonal"] == pytest.approx(
        24.0 * math.hypot(2736.0, 1824.0) / math.hypot(36.0, 24.0)
    )
    # 8.8 mm at 400 px/mm is 3520 px of the camera's image, which was halved; the calibration was too.
    assert by_source["focal plane"] == pytest.approx(1760.0)
    assert by_source["DJI calibration"] == pytest.approx(0.5 * 3666.67)
    assert focal_candidates((2736, 1824), {}, "") == ()


def test_width_and_diagonal_agree_only_at_three_to_two():
    details = {ExifTags.Base.FocalLengthIn35mmFilm: 24}
    width, diagonal = (c.focal_px for c in focal_candidates((4000, 3000), details, ""))
    assert diagonal / width == pytest.approx(1.25 / (math.hypot(36.0, 24.0) / 36.0))


def test_a_photograph_of_a_drone_tells_its_attitude(data_dir):
    head = read_exif(data_dir / "real" / "brighton_beach" / "images" / "DJI_0018.JPG")
    assert head.motion == Motion((45.0, -89.9, 0.0), (46.0, 1.8, 3.0), None)
    assert head.rtk is None
    # 20 mm of 35 mm film at 1600 px; EXIF's focal plane and a calibration are not there.
    assert [round(c.focal_px) for c in head.focal_candidates] == [889, 849]
    assert head.focal_px == pytest.approx(head.focal_candidates[0].focal_px)


def test_a_photograph_without_xmp_has_none_of_it(tmp_path):
    write_image(tmp_path / "a.jpg")
    head = read_exif(tmp_path / "a.jpg")
    assert (head.rtk, head.motion, head.focal_candidates) == (None, Motion(), ())
