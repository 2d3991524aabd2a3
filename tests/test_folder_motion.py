"""Rolling shutters of a survey folder: velocities by XMP, times or settings, motion of the cameras, and warnings."""

from datetime import datetime, timedelta

import numpy as np
import pytest
from PIL import ExifTags, Image
from small_survey import replaced, rows_of, small_survey, unposed

from survey.errors import ConfigError
from survey.folder.observations import BY_SETTINGS, BY_TIMES, BY_XMP, velocities_of
from survey.folder.survey import load_survey
from survey.photos.exif import Exif, read_exif
from survey.photos.xmp import Motion, motion_of
from survey.plan.check import check_survey
from survey.settings.config import parse_config

KEY = ("[water]", "rolling_shutter_s = 0.047\n[water]")
START = datetime(2026, 6, 1, 10, 0, 0)


def xmp(north: float, east: float, down: float, more: str = "") -> str:
    return (
        f'<x:xmpmeta xmlns:drone-dji="x" drone-dji:FlightXSpeed="{north:+.2f}" drone-dji:FlightYSpeed="{east:+.2f}" '
        f'drone-dji:FlightZSpeed="{down:+.2f}" {more}/>'
    )


def add_xmp(path, text: str) -> None:
    """Write a photograph again with XMP."""
    image = Image.open(path)
    image.load()
    image.save(path, quality=90, exif=image.getexif(), xmp=text.encode())


def flown(folder, *pairs, text: str = xmp(3.0, 4.0, 0.5)):
    """The small survey, all photographs with the same XMP."""
    small_survey(folder, toml=replaced(*pairs), gps=True)
    for path in (folder / "images").iterdir():
        add_xmp(path, text)
    return folder


def head(clock: datetime | None = None, speed=None, taken: datetime | None = None) -> Exif:
    return Exif((64, 48), None, None, 1, "", None, taken=taken, motion=Motion(velocity=speed), clock=clock)


def test_speeds_in_xmp_move_cameras_from_row_to_row_east_north_and_up(tmp_path):
    survey = load_survey(flown(tmp_path / "s", KEY))
    assert survey.findings.warnings == ()
    # 48 rows in 47 ms: a millisecond from row to row.
    for view in survey.views:
        np.testing.assert_allclose(view.camera.motion, [4e-3, 3e-3, -0.5e-3], rtol=1e-12)
        assert survey.observations.velocities[view.name].source == BY_XMP
    pixels = np.array([[3.0, 0.5], [60.0, 24.0], [1.0, 47.5]])
    apart = survey.views[1].camera.centres(pixels) - survey.views[1].camera.centre
    np.testing.assert_allclose(apart, np.outer([-0.0235, 0.0, 0.0235], [4.0, 3.0, -0.5]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("pairs", "speed"), [((), 3.0), ((("[water]", "rolling_shutter_s = 0\n[water]"),), 3.0), ((KEY,), 0.0)]
)
def test_without_a_readout_and_where_they_hover_cameras_stand_still(tmp_path, pairs, speed):
    survey = load_survey(flown(tmp_path / "s", *pairs, text=xmp(speed, speed, 0.0)))
    assert [view.camera.motion for view in survey.views] == [None] * 4
    assert len(survey.findings.warnings) == (not pairs)


def test_a_flight_without_a_word_on_the_shutter_is_warned_of_with_its_effect(tmp_path):
    (warning,) = load_survey(flown(tmp_path / "s", text=xmp(3.0, 4.0, 0.0))).findings.warnings
    assert warning.startswith("by XMP the camera flew at up to 5.0 m/s")
    # A pixel is 20 cm on the water.
    assert "by up to 15 cm or 0.8 px; give [cameras] rolling_shutter_s" in warning
    assert "Warnings" in [section.title for section in check_survey(tmp_path / "s")]


def test_neither_a_hover_nor_a_mechanical_shutter_is_warned_of(tmp_path):
    for name, text in {
        "hover": xmp(0.0, 0.0, 0.0),
        "mechanical": xmp(3.0, 4.0, 0.0, 'drone-dji:ShutterType="Mechanical"'),
        "none": "<x:xmpmeta/>",
    }.items():
        assert load_survey(flown(tmp_path / name, text=text)).findings.warnings == ()
    assert motion_of(xmp(1, 2, 3, 'drone-dji:ShutterType="Electronic"')).is_mechanical is False


def test_check_says_what_the_shutter_does(tmp_path):
    row = rows_of(check_survey(flown(tmp_path / "s", KEY)), "Found")["shutter"]
    assert row == "rolls in 47 ms; velocities of 4 of 4 images (4 by XMP), which move rows by up to 24 cm or 1.2 px"
    for more, said in (
        ("rolling_shutter_std_s = 0.02\n", "rolls in 0 +- 20 ms; velocities of 4 of 4 images (4 by XMP)"),
        ("", "exposes all rows at once (global or mechanical)"),
    ):
        (tmp_path / "s" / "survey.toml").write_text(replaced(("[water]", f"rolling_shutter_s = 0\n{more}[water]")))
        assert rows_of(check_survey(tmp_path / "s"), "Found")["shutter"] == said


def test_before_structure_from_motion_the_warning_is_there_too(tmp_path):
    folder = unposed(tmp_path / "s")
    for path in (folder / "images").iterdir():
        add_xmp(path, xmp(3.0, 4.0, 0.0))
    warnings = rows_of(check_survey(folder), "Warnings").values()
    assert any("would move the last row against the first by up to 15 cm; give" in text for text in warnings)


def test_a_key_without_any_velocity_is_a_warning_that_says_what_to_give(tmp_path):
    (warning,) = load_survey(small_survey(tmp_path / "s", toml=replaced(KEY))).findings.warnings
    assert warning.startswith("[cameras] rolling_shutter_s is not used: nothing tells how fast the camera flew")
    assert warning.endswith("give speed_m_s in survey.toml")


def test_a_speed_in_the_settings_counts_along_the_line_of_names(tmp_path):
    toml = replaced(("[water]", "rolling_shutter_s = 0.047\nspeed_m_s = 5\n[water]"))
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    assert {velocity.source for velocity in survey.observations.velocities.values()} == {BY_SETTINGS}
    # From photograph to photograph 3 m east and 2 m south of the grid, which local is turned from by 0.9 degrees.
    along = np.array([3.0, -2.0, 0.0]) / np.sqrt(13.0)
    for view in survey.views:
        np.testing.assert_allclose(view.camera.motion, 5e-3 * along, atol=1e-4)


def lawnmower(seconds_between: float = 2.0, seconds_to_turn: float = 9.0):
    """Two lines of five photographs, 10 m apart in each, to and fro; places, times and true velocities."""
    places, times, velocities, now = [], [], [], 0.0
    for line in range(2):
        for k in range(5):
            places.append((10.0 * k if line == 0 else 40.0 - 10.0 * k, 25.0 * line, 30.0))
            times.append(now)
            velocities.append(((1 - 2 * line) * 10.0 / seconds_between, 0.0, 0.0))
            now += seconds_between if k < 4 else seconds_to_turn
    names = [f"{k}.jpg" for k in range(10)]
    return dict(zip(names, np.array(places), strict=True)), times, np.array(velocities)


def test_times_and_positions_give_velocities_along_lines_and_at_their_ends(rng):
    places, times, true = lawnmower()
    order = dict(sorted(places.items(), key=lambda _: rng.random()))
    for clock in ("clock", "taken"):
        headers = {n: head(**{clock: START + timedelta(seconds=t)}) for n, t in zip(places, times, strict=True)}
        found = velocities_of(order, headers, None)
        assert {velocity.source for velocity in found.values()} == {BY_TIMES}
        np.testing.assert_allclose([found[name].local for name in places], true, atol=1e-9)
    # A clock of whole seconds is good to a fifth.
    places, times, true = lawnmower(2.4)
    headers = {n: head(START + timedelta(seconds=int(t))) for n, t in zip(places, times, strict=True)}
    found = velocities_of(places, headers, None)
    assert np.linalg.norm([found[name].local - v for name, v in zip(places, true, strict=True)], axis=1).max() < 0.9


def test_a_photograph_at_a_turn_has_no_velocity():
    places = [(0, 0, 9), (5, 0, 9), (10, 0, 9), (10, 5, 9), (10, 10, 9)]
    corner = {f"{k}.jpg": np.array(place) for k, place in enumerate(places)}
    headers = {name: head(START + timedelta(seconds=k)) for k, name in enumerate(corner)}
    found = velocities_of(corner, headers, None)
    assert sorted(found) == ["0.jpg", "1.jpg", "3.jpg", "4.jpg"]
    np.testing.assert_allclose(found["1.jpg"].local, [5.0, 0.0, 0.0])
    np.testing.assert_allclose(found["3.jpg"].local, [0.0, 5.0, 0.0])


def test_photographs_without_times_or_far_apart_in_time_have_no_velocity():
    places, times, _ = lawnmower()
    assert velocities_of(places, {name: head() for name in places}, None) == {}
    headers = {n: head(START + timedelta(seconds=100 * t)) for n, t in zip(places, times, strict=True)}
    assert velocities_of(places, headers, None) == {}
    assert velocities_of(places, {name: head(START) for name in places}, None) == {}


def test_xmp_counts_before_times_and_times_before_settings():
    places, times, true = lawnmower()
    headers = {n: head(START + timedelta(seconds=t)) for n, t in zip(places, times, strict=True)}
    headers["2.jpg"] = head(START + timedelta(seconds=4), speed=(1.0, 2.0, 3.0))
    headers["7.jpg"] = head()
    found = velocities_of(places, headers, 5.0)
    assert (found["2.jpg"].source, found["2.jpg"].local.tolist()) == (BY_XMP, [1.0, 2.0, 3.0])
    assert found["3.jpg"].source == BY_TIMES
    # Of one photograph the time is missing: its neighbours are linked over it, and it has its order by name.
    np.testing.assert_allclose(found["6.jpg"].local, true[6])
    assert (found["7.jpg"].source, found["7.jpg"].local.tolist()) == (BY_SETTINGS, [-5.0, 0.0, 0.0])


def test_the_clock_of_a_camera_has_fractions_of_a_second(tmp_path):
    image, exif = Image.new("RGB", (8, 8)), Image.Exif()
    details = {ExifTags.Base.DateTimeOriginal: "2026:06:01 10:00:07", ExifTags.Base.SubsecTimeOriginal: "250"}
    exif[ExifTags.IFD.Exif] = details
    image.save(tmp_path / "a.jpg", exif=exif)
    assert read_exif(tmp_path / "a.jpg").clock == datetime(2026, 6, 1, 10, 0, 7, 250000)
    exif[ExifTags.IFD.Exif] = {**details, ExifTags.Base.SubsecTimeOriginal: "x"}
    image.save(tmp_path / "a.jpg", exif=exif)
    assert read_exif(tmp_path / "a.jpg").clock == datetime(2026, 6, 1, 10, 0, 7)
    image.save(tmp_path / "a.jpg")
    assert read_exif(tmp_path / "a.jpg").clock is None


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("rolling_shutter_s = -0.01", "rolling_shutter_s is -0.01, expected seconds"),
        ("rolling_shutter_s = 0.03\nspeed_m_s = 0", "speed_m_s is 0, expected metres per second"),
        ("speed_m_s = 5", "speed_m_s is given without rolling_shutter_s"),
    ],
)
def test_settings_that_cannot_be_are_refused(line, message):
    with pytest.raises(ConfigError, match=message.replace("[", r"\[")):
        parse_config(f"[cameras]\n{line}")
