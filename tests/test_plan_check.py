"""`bathynerf check` and the plan: what they say of a survey, with numbers computed by hand."""

from __future__ import annotations

import json
import math
import sys

import numpy as np
import pytest
from small_survey import E0, LEVEL, N0, TOML, camera_lines, small_survey, write_image

from survey.errors import ImageError, SurveyError
from survey.folder.survey import load_survey
from survey.plan.check import check_survey
from survey.plan.plan import ground_height, make_plan


def said(sections, title: str) -> dict[str, str]:
    (section,) = [section for section in sections if section.title == title]
    return dict(section.rows)


def test_check_says_what_was_found_and_what_the_plan_is(tmp_path):
    sections = check_survey(small_survey(tmp_path / "s"))
    assert [section.title for section in sections] == ["Found", "Plan"]
    found = said(sections, "Found")
    assert found["images"] == "4 with a pose, of 4 in images"
    assert found["camera"] == "PINHOLE, 64 x 48 px, focal length 100.0 px, 4 images"
    assert found["poses"] == "cameras.csv, heights 2125.00 to 2125.00"
    # 20 m over the water, 64 x 48 px at a focal length of 100 px.
    assert found["views"] == "0.0 to 0.0 degrees off nadir, one covers 12.8 x 9.6 m"
    assert "level 2105 m at 589012, 5194736, slope 0 east and 0 north, index 1.333" in found["water"]
    assert found["water"].endswith("cameras 20.0 to 20.0 m over it")
    assert said(sections, "Plan")["ground sampling distance"] == "20 cm: cameras 20.0 m over the water"


def test_check_says_what_was_assumed_and_what_is_doubtful(tmp_path):
    folder = small_survey(tmp_path / "s", toml=TOML.replace("refractive_index = 1.333", ""))
    write_image(folder / "images" / "more.jpg")
    sections = check_survey(folder)
    assert [section.title for section in sections] == ["Found", "Plan", "Assumed", "Warnings"]
    assert "fresh water" in said(sections, "Assumed")[""]
    assert said(sections, "Warnings")[""] == "1 image without a pose, left out: more.jpg"


def test_check_says_that_structure_from_motion_would_run_and_does_not_run_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "survey.sfm.poses", None)  # importing it fails
    folder = small_survey(tmp_path / "s", gps=True, toml=TOML.replace('poses = "cameras.csv"', ""))
    (folder / "cameras.csv").unlink()
    before = sorted(folder.rglob("*"))
    sections = check_survey(folder)
    assert said(sections, "Found")["positions"] == "4 of 4 images have one in EXIF, heights 2125.0 to 2125.0 m"
    assert said(sections, "Found")["water"].endswith("by EXIF the cameras are 20.0 to 20.0 m over it")
    assert said(sections, "Plan")["structure from motion"].startswith("on: there is no poses file")
    assert sorted(folder.rglob("*")) == before
    image = folder / "images" / "0001.jpg"
    image.write_bytes(image.read_bytes()[:1500])
    with pytest.raises(ImageError, match=r"0001\.jpg is damaged or cut off"):
        check_survey(folder)


def test_a_dry_survey_needs_no_refraction(tmp_path):
    plan = make_plan(load_survey(small_survey(tmp_path / "s", toml=TOML[: TOML.index("[water]")])))
    assert not plan.is_on("refraction")
    reasons = {decision.name: decision.reason for decision in plan.decisions}
    assert reasons["refraction"] == "a dry survey: there is no [water]"


def test_water_of_index_one_is_not_bent(tmp_path):
    toml = TOML.replace("refractive_index = 1.333", "refractive_index = 1.0")
    plan = make_plan(load_survey(small_survey(tmp_path / "s", toml=toml)))
    assert not plan.is_on("refraction")


def test_views_to_the_horizon_are_counted(tmp_path):
    folder = small_survey(tmp_path / "s")
    lines = camera_lines()
    # 80 degrees off nadir with 13.5 degrees of field on either side.
    lines[0] = lines[0].replace(",0,0,0", ",80,0,0")
    (folder / "cameras.csv").write_text("\n".join(["image,easting,northing,height,omega,phi,kappa", *lines]))
    plan = make_plan(load_survey(folder))
    (refraction,) = [decision for decision in plan.decisions if decision.name == "refraction"]
    assert refraction.reason.endswith("; 1 of 4 views look past the water to the horizon")


@pytest.mark.parametrize(
    ("quality", "size", "scale"),
    [
        ("draft", (640, 480), 1.0),
        ("draft", (1024, 768), 1.0),
        ("draft", (4000, 3000), 0.25),
        ("standard", (2500, 2400), 1.0),
        ("standard", (2501, 2400), 0.5),
        ("standard", (4000, 3000), 0.5),
        ("fine", (5472, 3648), 1.0),
    ],
)
def test_images_are_halved_until_they_fit_the_quality(tmp_path, quality, size, scale):
    folder = small_survey(tmp_path / "s", num=3)
    first = folder / "images" / "0000.jpg"
    write_image(first, size=size)
    for name in ("0001.jpg", "0002.jpg"):
        (folder / "images" / name).write_bytes(first.read_bytes())
    toml = TOML.replace("[64, 48]", str(list(size))).replace("principal_point_px = [32.0, 24.0]\n", "")
    (folder / "survey.toml").write_text(toml)
    plan = make_plan(load_survey(folder), quality=quality)
    assert plan.image_scale == scale
    # 20 m over the water at 100 px, and larger pixels of smaller images.
    assert plan.gsd_m == pytest.approx(0.2 / scale)


def test_the_sampling_distance_of_oblique_views_counts_along_their_axis(tmp_path):
    folder = small_survey(tmp_path / "s")
    lines = [line.replace(",0,0,", ",40,0,") for line in camera_lines()]
    (folder / "cameras.csv").write_text("\n".join(["image,easting,northing,height,omega,phi,kappa", *lines]))
    plan = make_plan(load_survey(folder))
    # Within 10 m of the origin grid axes and local ones differ by 0.1 degrees, along the slope of the tilt.
    assert plan.gsd_m == pytest.approx(0.2 / math.cos(math.radians(40.0)), rel=2e-3)


def cameras_of(survey):
    return [view.camera for view in survey.views]


def test_the_ground_of_a_dry_survey_is_where_oblique_axes_meet_or_where_neighbours_overlap_as_usual(tmp_path, data_dir):
    dry, wet = load_survey(data_dir / "wreck_dry"), load_survey(data_dir / "wreck_water")
    bed = 2105.0 - 3.5
    assert ground_height(cameras_of(dry)) + dry.frame.origin[2] == pytest.approx(bed, abs=0.5)
    assert make_plan(dry).height_m == pytest.approx(make_plan(wet).height_m + 3.5, abs=0.5)
    # Nadir views 3.61 m apart whose shorter side sees 0.48 of the height: 3.61 / (0.25 * 0.48) = 30 m.
    nadir = load_survey(small_survey(tmp_path / "s", toml=TOML[: TOML.index("[water]")]))
    centre = np.median([view.camera.centre[2] for view in nadir.views])
    assert centre - ground_height(cameras_of(nadir)) == pytest.approx(math.hypot(3.0, 2.0) / (0.25 * 0.48), rel=1e-3)


def test_an_unknown_quality_or_device_is_refused_with_the_known_ones(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    with pytest.raises(SurveyError, match="quality is best, expected one of draft, standard, fine"):
        make_plan(survey, quality="best")
    with pytest.raises(SurveyError, match="device is tpu, expected one of auto, cpu, cuda"):
        make_plan(survey, device="tpu")


def test_the_plan_is_saved_as_plain_numbers_and_texts(tmp_path):
    plan = make_plan(load_survey(small_survey(tmp_path / "s")))
    again = json.loads(json.dumps(plan.as_dict()))
    assert again["gsd_m"] == plan.gsd_m
    assert again["decisions"][0]["name"] == "refraction"
    assert f"{LEVEL:g} m" in again["decisions"][0]["reason"]


def test_the_area_is_shown_in_crs(tmp_path):
    toml = TOML + f"[area]\nbounds = [{E0}, {N0}, {E0 + 5}, {N0 + 6}]\n"
    found = said(check_survey(small_survey(tmp_path / "s", toml=toml)), "Found")
    assert found["area"] == "589012 to 589017 east, 5194736 to 5194742 north"
