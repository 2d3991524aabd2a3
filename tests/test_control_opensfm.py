"""ground_control_points.json of OpenSfM: places, marks in units of the longer side, and what is refused."""

from __future__ import annotations

import json

import pytest
from pyproj import CRS

from survey.control.reading import merge_control, read_control
from survey.errors import ControlError

SIZES = {"01.jpg": (400, 300), "02.jpg": (300, 400)}


def point(name: str, **more) -> dict:
    position = {"latitude": 48.0, "longitude": 11.0 + 0.001 * len(name), "altitude": 500.0}
    marks = [{"shot_id": "01.jpg", "projection": [-0.25, 0.125]}, {"shot_id": "02.jpg", "projection": [0.0, 0.5]}]
    return {"id": name, "position": position, "observations": marks} | more


def written(folder, content) -> object:
    path = folder / "ground_control_points.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def gathered(path):
    found, said = merge_control([read_control(path)], CRS("EPSG:4326+5773"), SIZES)
    return found, list(said.warnings)


def test_marks_count_from_the_middle_in_units_of_the_longer_side(tmp_path):
    found, _ = gathered(written(tmp_path, {"points": [point("a"), point("bb"), point("ccc", role="metrics_only")]}))
    assert [p.name for p in found.points] == ["a", "bb", "ccc"]
    assert [p.is_check for p in found.points] == [False, False, True]
    assert found.points[0].place == pytest.approx((11.001, 48.0, 500.0))
    pixels = {(mark.point, mark.view): mark.pixel for mark in found.marks}
    # 400 wide: a quarter of it left of 200, an eighth of it below 150; upright: half of 400 below 200.
    assert pixels["a", "01.jpg"] == pytest.approx((100.0, 200.0))
    assert pixels["a", "02.jpg"] == pytest.approx((150.0, 400.0))


def test_points_without_a_place_or_a_height_are_left_out_and_named(tmp_path):
    bare = {key: value for key, value in point("bare").items() if key != "position"}
    flat = point("flat", position={"latitude": 48.0, "longitude": 11.0, "altitude": 0.0, "has_altitude": False})
    found, warnings = gathered(written(tmp_path, {"points": [point("a"), bare, flat]}))
    assert [p.name for p in found.points] == ["a"]
    assert any("bare" in text and "flat" in text for text in warnings)


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "{}",
        {"points": []},
        {"points": [{"id": 3}]},
        {"points": [point("a", position={"latitude": 480.0, "longitude": 11.0, "altitude": 1.0})]},
        {"points": [point("a", observations=[{"shot_id": "01.jpg", "projection": [0.1]}])]},
        {"points": [point("a", observations=7)]},
        '{"points": ' + "[" * 100_000,
    ],
)
def test_what_is_not_of_that_form_is_refused_in_one_sentence(tmp_path, content):
    with pytest.raises(ControlError, match="ground_control_points") as caught:
        read_control(written(tmp_path, content))
    assert "\n" not in str(caught.value)
