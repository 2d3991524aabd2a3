"""What the headers of photographs say of accuracy, attitude, speed and focal length."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from survey.photos.exif import read_exif
from survey.photos.xmp import Motion, Rtk, gimbal_from_pix4d, height_datum, motion_of, rtk_of, stated_std, xmp_number

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
    assert motion_of(xmp) == Motion((45.0, -89.9, 0.5), (-1.5, 4.0, -0.25))
    assert motion_of(xmp.replace("FlightZSpeed", "Other")).velocity is None
    assert motion_of("") == Motion()


def test_a_photograph_of_a_drone_tells_its_attitude(data_dir):
    head = read_exif(data_dir / "real" / "brighton_beach" / "images" / "DJI_0018.JPG")
    assert head.motion == Motion((45.0, -89.9, 0.0), None)
    assert head.rtk is None
    # 20 mm of 35 mm film at 1600 px; a calibration is not there.
    assert head.focal_px == pytest.approx(20.0 / 36.0 * 1600.0)


# What Parrot's documentation gives as examples of one photograph of an Anafi Ai, and a photograph of a senseFly SODA.
PARROT = (
    'Camera:GPSXYAccuracy="845389/2097152" Camera:GPSZAccuracy="5117051/8388608" Camera:Roll="-0.041258" '
    'Camera:Pitch="38.011101" Camera:Yaw="146.781036" Camera:PerspectiveFocalLength="527/100" '
    "<drone-parrot:CameraRollDegree>-0.052789</drone-parrot:CameraRollDegree>"
    "<drone-parrot:CameraPitchDegree>-51.988888</drone-parrot:CameraPitchDegree>"
    "<drone-parrot:CameraYawDegree>146.848038</drone-parrot:CameraYawDegree>"
)
SENSEFLY = (
    "<Camera:Roll>3.7</Camera:Roll><Camera:Pitch>13.9</Camera:Pitch><Camera:Yaw>62.1</Camera:Yaw>"
    "<Camera:GPSXYAccuracy>1.2</Camera:GPSXYAccuracy><Camera:GPSZAccuracy>1.7</Camera:GPSZAccuracy>"
    "<CRSInfo:VERTCRS>EGM96</CRSInfo:VERTCRS>"
)


def test_parrot_states_angles_twice_and_both_say_the_same():
    assert motion_of(PARROT).gimbal_deg == (146.848038, -51.988888, -0.052789)
    of_frame = motion_of(PARROT.split("<drone")[0]).gimbal_deg
    # The two sets of the documentation differ by 0.07 degrees in yaw themselves.
    assert of_frame == pytest.approx((146.848038, -51.988888, -0.052789), abs=0.1)


def test_fractions_are_divided_and_accuracies_are_east_north_up():
    assert stated_std(PARROT) == pytest.approx((845389 / 2097152, 845389 / 2097152, 5117051 / 8388608))
    assert stated_std(SENSEFLY) == (1.2, 1.2, 1.7)
    assert stated_std(SENSEFLY.replace("1.7", "0")) is None
    assert stated_std(PARROT.replace("/2097152", "/0")) is None


def test_sensefly_counts_angles_from_a_frame_that_looks_down():
    assert gimbal_from_pix4d(62.0, 0.0, 0.0) == pytest.approx((62.0, -90.0, 0.0))
    assert gimbal_from_pix4d(62.0, 90.0, 0.0) == pytest.approx((62.0, 0.0, 0.0), abs=1e-9)
    assert gimbal_from_pix4d(-170.0, 13.9, 0.0) == pytest.approx((-170.0, -76.1, 0.0), abs=1e-9)
    yaw, pitch, roll = motion_of(SENSEFLY).gimbal_deg
    # A roll of 3.7 to the right tilts the axis away from the vertical by acos(cos 13.9 cos 3.7).
    assert -pitch == pytest.approx(
        90.0 - math.degrees(math.acos(math.cos(math.radians(13.9)) * math.cos(math.radians(3.7))))
    )
    assert (yaw, roll) != (62.1, 0.0)


def test_rotations_of_both_ways_of_counting_are_the_same(rng):
    def about(axis, degrees):
        turn = np.zeros(3)
        turn[axis] = math.radians(degrees)
        return Rotation.from_rotvec(turn)

    for yaw, pitch, roll in rng.uniform(-80.0, 80.0, (50, 3)):
        frame = about(2, yaw) * about(1, pitch) * about(0, roll) * about(1, -90.0)
        y, p, r = gimbal_from_pix4d(yaw, pitch, roll)
        gimbal = about(2, y) * about(1, p) * about(0, r)
        np.testing.assert_allclose(frame.as_matrix(), gimbal.as_matrix(), atol=1e-9)


def test_autel_has_the_names_of_dji_in_its_own_namespace():
    xmp = (
        'drone:GimbalRollDegree="0.0" drone:GimbalYawDegree="-12.5" drone:GimbalPitchDegree="-89.5" '
        'drone:RelativeAltitude="+41.2" xmlns:drone="http://www.autelrobotics.com/"'
    )
    assert motion_of(xmp).gimbal_deg == (-12.5, -89.5, 0.0)
    assert xmp_number(xmp, "RelativeAltitude") == 41.2
    # Another namespace that ends alike is another one.
    assert xmp_number(xmp.replace("drone:", "my-drone:"), "RelativeAltitude") is None


def test_older_autel_has_those_of_pix4d():
    assert motion_of(
        'rdf:about="Autel Robotics Meta Data" Camera:Pitch="0" Camera:Yaw="15" Camera:Roll="0"'
    ).gimbal_deg == (pytest.approx((15.0, -90.0, 0.0)))


@pytest.mark.parametrize(
    ("xmp", "expected"),
    [('drone-dji:AltitudeType="RtkAlt"', "ellipsoidal"), ('drone-dji:AltitudeType="GpsFusionAlt"', None),
     (SENSEFLY, "EGM96"), ('Camera:VertCS="ellipsoidal"', "ellipsoidal"), ("", None)],
)  # fmt: skip
def test_xmp_may_say_what_heights_count_from(xmp, expected):
    assert height_datum(xmp) == expected


def test_a_number_of_ten_thousand_digits_is_none():
    assert xmp_number(f'drone-dji:RelativeAltitude="{"9" * 10_000}"', "RelativeAltitude") is None
    assert stated_std(SENSEFLY.replace("1.2", "1" * 50)) is None
