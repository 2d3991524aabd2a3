"""Who took the photographs, when and with what, which are used, which not, and why."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from small_bed import plane_bed
from small_report import facts_of
from small_survey import write_image

from survey.display.blocks import Folded
from survey.photos.exif import Exif, read_exif
from survey.report.figures import figures_of, json_of
from survey.report.page import render_page
from survey.report.photographs import PhotographFigures, flight_time, table, taken_of, taken_rows
from survey.settings.config import ReportConfig, parse_config

GOOD = PhotographFigures("b.jpg", 0.01, 0.06)


def test_every_photograph_is_listed_with_its_use():
    photographs = (
        GOOD,
        PhotographFigures("a.jpg", 0.7, None),
        PhotographFigures("d.jpg", 0.0, 0.9, "blurred, or without texture"),
    )
    folded = table(photographs, ["c.jpg"])[-1]
    assert isinstance(folded, Folded)
    assert (
        folded.summary
        == "All 4 photographs, 1 of them left out; listed are those with more than 5.0\N{NO-BREAK SPACE}% left out"
    )
    assert folded.is_open
    assert [row[:2] for row in folded.table.rows] == [
        ("a.jpg", "little of it: more than half white"),
        ("b.jpg", "yes"),
        ("c.jpg", "left out: no pose"),
        ("d.jpg", "nothing of it: blurred, or without texture"),
    ]


def test_many_photographs_open_on_a_click_and_none_have_no_table():
    many = tuple(replace(GOOD, name=f"{i:03}.jpg") for i in range(100))
    assert not table(many)[-1].is_open
    assert table(()) == []


def test_photographs_without_a_pose_are_named_in_page_and_json(shallow_survey):
    write_image(shallow_survey.folder / "images" / "9999 & more.jpg")
    try:
        figures = figures_of(facts_of(shallow_survey, plane_bed(shallow_survey, num=20), photographs=(GOOD,)))
    finally:
        (shallow_survey.folder / "images" / "9999 & more.jpg").unlink()
    assert json_of(figures)["photographs_left_out"] == ["9999 & more.jpg"]
    assert figures["survey"]["views_left_out"] == 1
    page = render_page(figures, [])
    assert "<details open>" in page
    assert "9999 &amp; more.jpg" in page


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
