"""The head of the report: project, dates, cameras, by survey.toml and the headers of photographs."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from small_survey import write_image

from survey.photos.exif import Exif, read_exif
from survey.report.photographs import flight_time, taken_of, taken_rows
from survey.settings.config import ReportConfig, parse_config

START = datetime(2026, 6, 1, 10, 12, 40, tzinfo=UTC)
NOW = datetime(2026, 6, 3, 8, 5, tzinfo=UTC)
HEAD = Exif((64, 48), None, None, 1, "DJI FC6310", None, taken=START, serial="0A1B")
SAID = ReportConfig("Harbour & basin", "A. Surveyor")


def headers(**others: Exif) -> dict[str, Exif]:
    return {"0.jpg": HEAD, **{f"{name}.jpg": head for name, head in others.items()}}


def test_the_head_says_who_when_and_with_what():
    found = taken_of(SAID, headers(a=replace(HEAD, taken=START + timedelta(minutes=19))), NOW)
    assert found["cameras"] == [{"name": "DJI FC6310", "serials": ["0A1B"], "num": 2}]
    assert (found["first"], found["last"], found["clock"]) == ("2026-06-01T10:12:40", "2026-06-01T10:31:40", "UTC")
    assert taken_rows(found) == [
        ("project", "Harbour & basin"),
        ("operator", "A. Surveyor"),
        ("flown", "2026-06-01 10:12 to 10:31 UTC"),
        ("processed", NOW.isoformat(timespec="minutes").replace("T", " ")),
        ("camera", "DJI FC6310, serial number 0A1B: 2 photographs"),
    ]


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ({}, "2026-06-01 10:12 UTC"),
        ({"a": replace(HEAD, taken=START + timedelta(days=1))}, "2026-06-01 10:12 to 2026-06-02 10:12 UTC"),
    ],
)
def test_one_moment_and_several_days_are_said_as_such(others, expected):
    assert flight_time(taken_of(SAID, headers(**others), NOW)) == expected


def test_without_gps_time_the_clock_of_the_camera_counts_and_without_any_nothing():
    own = replace(HEAD, taken=None, clock=START.replace(tzinfo=None))
    assert flight_time(taken_of(SAID, {"a.jpg": own}, NOW)) == "2026-06-01 10:12 by the clock of the camera"
    bare = taken_of(ReportConfig(), {"a.jpg": replace(HEAD, taken=None, camera="", serial="")}, NOW)
    assert [label for label, _ in taken_rows(bare)] == ["processed", "camera"]
    assert taken_rows(None) == []


def test_many_serial_numbers_are_counted():
    many = {f"{i}.jpg": replace(HEAD, serial=str(i)) for i in range(6)}
    assert "6 of them: 6 photographs" in taken_rows(taken_of(SAID, many, NOW))[-1][1]


def test_the_serial_number_is_that_of_exif_or_xmp(tmp_path):
    write_image(tmp_path / "a.jpg", Make="DJI", Model="FC6310")
    assert read_exif(tmp_path / "a.jpg").serial == ""
    written = (tmp_path / "a.jpg").read_bytes()
    xmp = b'http://ns.adobe.com/xap/1.0/\0<x drone-dji:CameraSerialNumber="0K8T\x1b[0m"/>'
    segment = b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp
    (tmp_path / "b.jpg").write_bytes(written[:2] + segment + written[2:])
    assert read_exif(tmp_path / "b.jpg").serial == "0K8T[0m"


def test_the_words_come_from_survey_toml():
    config = parse_config('crs = "EPSG:25832+5778"\n[report]\nproject = "P"\noperator = "O"\n')
    assert config.report == ReportConfig("P", "O")
