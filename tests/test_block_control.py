"""Drawn photographs placed by control, with GPS and without, and what is said of bad input: from the folder on."""

import csv
import dataclasses
import re
import shutil
import tomllib
from pathlib import Path

import field_settings
import field_surveys
import numpy as np
import pytest
import tomli_w
from adjust_rows import copy_without_gps

from geo.errors import GeoError
from survey.adjust.refine import adjust_survey
from survey.errors import SurveyError
from survey.folder.survey import Survey, load_survey


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    """A survey of 11 photographs of a bank and shallow water, with GPS and five control points."""
    folder = tmp_path_factory.mktemp("drawn") / "01"
    settings = dataclasses.replace(
        field_settings.draw_settings(1),
        size_m=(5.0, 4.0), size_px=(320, 240), stated_focal_px=336.0, focal_px=337.0, principal_px=(161.0, 119.0),
        height_m=8.0, depth_m=0.8, dry_share=0.6, bare_share=0.0, num_nadir=8, num_oblique=3, wave_m=0.0, noise=1.0,
    )  # fmt: skip
    field_surveys.draw_field_survey(folder, settings)
    return folder


@pytest.fixture(scope="module")
def blind(drawn, tmp_path_factory) -> Path:
    """The same without GPS."""
    folder = tmp_path_factory.mktemp("blind") / "01"
    shutil.copytree(drawn, folder)
    for path in (folder / "images").iterdir():
        copy_without_gps(path, path)
    settings = tomllib.loads((folder / "survey.toml").read_text(encoding="utf-8"))
    del settings["cameras"]["position_std_m"]
    (folder / "survey.toml").write_text(tomli_w.dumps(settings), encoding="utf-8")
    return folder


def loaded(folder: Path, tmp_path: Path, edit=lambda rows: rows) -> Survey:
    """The survey with other lines in its gcp_list.txt; its photographs are solved once."""
    copy = tmp_path / "survey"
    copy.mkdir()
    (copy / "images").symlink_to(folder / "images")
    for name in ("survey.toml", "checkpoints.csv"):
        shutil.copy(folder / name, copy / name)
    head, *lines = (folder / "gcp_list.txt").read_text(encoding="utf-8").strip().splitlines()
    rows = edit([head, *(line.split() for line in lines)])
    text = "\n".join(row if isinstance(row, str) else " ".join(row) for row in rows)
    (copy / "gcp_list.txt").write_text(text + "\n", encoding="utf-8")
    return load_survey(copy, workspace=folder / "sfm")


def shifted(name: str | None, *shift: float):
    """Other coordinates of a point, or of all."""

    def edit(rows):
        moved = [
            [f"{float(c) + d:.4f}" for c, d in zip(row[:3], shift, strict=True)] + row[3:]
            if name in (None, row[6])
            else row
            for row in rows[1:]
        ]
        return [rows[0], *moved]

    return edit


def only(*names: str):
    return lambda rows: [rows[0], *(row for row in rows[1:] if row[6] in names)]


def errors_of(survey: Survey, folder: Path, centres: np.ndarray) -> np.ndarray:
    with (folder / "truth" / "cameras.csv").open(newline="") as file:
        truth = {row["image"]: row for row in csv.DictReader(file)}
    true = [[float(truth[view.name][key]) for key in ("easting", "northing", "height")] for view in survey.views]
    return centres - survey.frame.local_from_crs(np.array(true))


@pytest.mark.slow
def test_a_survey_without_gps_is_placed_by_control_and_adjusted(blind, tmp_path):
    survey = loaded(blind, tmp_path)
    assert len(survey.views) == 11
    assert all(prior.position is None for prior in survey.observations.priors.values())
    before = errors_of(survey, blind, np.array([view.camera.centre for view in survey.views]))
    assert np.abs(before).max() < 0.5
    found = adjust_survey(survey, use_windows=False)
    errors = errors_of(survey, blind, found.poses.centres)
    assert np.sqrt(np.mean(errors**2)) < 0.06
    assert np.mean(np.abs(errors) < 2.6 * found.poses.position_std) > 0.7
    assert not found.warnings


def test_too_little_control_is_refused_before_anything_is_computed(blind, tmp_path):
    with pytest.raises(SurveyError, match=r"0 of 11 images have a GPS .*; 2 of 2 control points are marked in two .*3"):
        loaded(blind, tmp_path, only("gcp1", "gcp2"))


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda rows: [rows[0], *([row[1], row[0], *row[2:]] for row in rows[1:])], "easting .* before northing"),
        (lambda rows: ["EPSG:25832", *rows[1:]], r"bounds .* lie [\d.]+ km from the nearest camera"),
        (lambda rows: [rows[0], *([*row[:6], "gcp1"] for row in rows[1:])], "gcp1 is at .* but at"),
        (shifted(None, 0.0, 0.0, -40.0), r"level_m is .* under the water"),
    ],
)
def test_control_that_cannot_be_is_refused_without_gps(blind, tmp_path, edit, words):
    with pytest.raises((SurveyError, GeoError), match=words):
        loaded(blind, tmp_path, edit)


def test_wrong_marks_and_coordinates_are_named_without_gps(blind, tmp_path):
    def edit(rows):
        x, y = 320.0 - float(rows[1][3]), 240.0 - float(rows[1][4])
        return [rows[0], [*rows[1][:3], f"{x}", f"{y}", *rows[1][5:]], *shifted("gcp3", 5.0, 0.0, 0.0)(rows)[2:]]

    survey = loaded(blind, tmp_path, edit)
    (mark,) = (text for text in survey.findings.warnings if "mark of control that the other marks" in text)
    assert "gcp1 in 00" in mark
    (point,) = (text for text in survey.findings.warnings if "control point that the others contradict" in text)
    assert abs(float(point.split("gcp3 (by ")[1].split(" m")[0]) - 5.0) < 0.1
    assert "gcp3" not in {each.name for each in survey.observations.control.points}


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (shifted(None, 120.0, 90.0, 0.0), r"put control points -1\d\d\.\d\d m east, .* another CRS or datum"),
        (lambda rows: ["EPSG:25832", *rows[1:]], "km from the nearest camera"),
        (lambda rows: [rows[0], *([row[1], row[0], *row[2:]] for row in rows[1:])], "swap the two columns"),
    ],
)
def test_control_of_another_place_than_gps_is_refused(drawn, tmp_path, edit, words):
    with pytest.raises(SurveyError, match=words):
        loaded(drawn, tmp_path, edit)


def test_control_decides_where_stated_positions_have_another_datum(drawn, tmp_path):
    survey = loaded(drawn, tmp_path, shifted(None, 1.5, -1.0, 2.5))
    (warning,) = [text for text in survey.findings.warnings if "fitted to the control" in text]
    east, north, up = (float(number) for number in re.findall(r"(-?\d+\.\d+) m (?:east|north|up)", warning)[:3])
    # Positions are good to 2 to 8 cm each, and their mean to a third of that.
    assert (east, north, up) == pytest.approx((-1.5, 1.0, -2.5), abs=0.08)
    errors = errors_of(survey, drawn, np.array([view.camera.centre for view in survey.views]))
    np.testing.assert_allclose(np.median(errors, axis=0), [1.5, -1.0, 2.5], atol=0.2)
    assert all(prior.position_std is None for prior in survey.observations.priors.values())


def test_good_control_beside_gps_is_all_used(drawn, tmp_path):
    survey = loaded(drawn, tmp_path)
    assert len(survey.observations.control.points) == 5
    assert [
        text for text in survey.findings.warnings if "control" in text and "no accuracy is stated" not in text
    ] == []


def test_control_on_one_line_places_nothing_and_is_used_beside_gps(drawn, blind, tmp_path):
    """Along a bank all of it may lie so."""

    def on_a_line(rows):
        kept = only("gcp1", "gcp2")(rows)
        # A third one halfway, with the marks of the first: only its coordinates are looked at before the marks are.
        first, second = (
            np.array([float(c) for c in next(r for r in kept[1:] if r[6] == n)[:3]]) for n in ("gcp1", "gcp2")
        )
        middle = [f"{c:.4f}" for c in 0.5 * (first + second)]
        return [*kept, *([*middle, *row[3:6], "gcp9"] for row in kept[1:] if row[6] == "gcp1")]

    with pytest.raises(SurveyError, match="3 control points do not fit the photographs"):
        loaded(blind, tmp_path, on_a_line)
    shutil.rmtree(tmp_path / "survey")
    assert {point.name for point in loaded(drawn, tmp_path, on_a_line).observations.control.points} >= {"gcp1", "gcp2"}
