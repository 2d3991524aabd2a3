"""`bathynerf check` and the plan: what they say of a survey, with numbers computed by hand."""

import math
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from small_survey import (
    E0,
    LEVEL,
    N0,
    TOML,
    camera_lines,
    replaced,
    rows_of,
    small_survey,
    unposed,
    write_image,
    write_poses,
)

from survey.errors import ConfigError, ImageError, PosesError, SurveyError
from survey.folder.plausible import angle_warnings, ground_below
from survey.folder.survey import load_survey
from survey.photos.poses import CAM_FROM_OPK_CAM, PoseFrame, grid_from_opk
from survey.plan.check import check_survey, require_processable
from survey.plan.choices import Choices
from survey.plan.heights import dry_ground
from survey.plan.plan import make_plan, pose_choice, require_placeable
from survey.pose_files import read_poses
from tests.changed_survey import changed

# Where a level has no standard deviation.
ASKED = "; level_std_m is not given, 0.02 m as of a staff are assumed: say how well it is known"


def test_check_says_what_was_found_and_what_the_plan_is(tmp_path):
    sections = check_survey(small_survey(tmp_path / "s"))
    assert [section.title for section in sections] == ["Found", "Plan"]
    found = rows_of(sections, "Found")
    assert found["images"] == "4 with a pose, of 4 in images"
    assert found["camera"] == "PINHOLE, 64 x 48 px, focal length 100.0 px, 4 images"
    assert found["poses"] == "cameras.csv, heights 2125.00 to 2125.00"
    # 20 m over the water, 64 x 48 px at a focal length of 100 px.
    assert found["views"] == "0.0 to 0.0 degrees off nadir, one covers 12.8 x 9.6 m"
    assert "level 2105 m at 589012, 5194736, slope 0 east and 0 north, index 1.333" in found["water"]
    assert found["water"].endswith(f"cameras 20.0 to 20.0 m over it{ASKED}")
    assert rows_of(sections, "Found")["pixels"].startswith("200\u00a0mm on the ground")


def test_check_says_what_was_assumed_and_what_is_doubtful(tmp_path):
    folder = small_survey(tmp_path / "s", toml=TOML.replace("refractive_index = 1.333", ""))
    write_image(folder / "images" / "more.jpg")
    sections = check_survey(folder)
    assert [section.title for section in sections] == ["Found", "Plan", "Assumed", "Warnings"]
    assert "fresh water" in rows_of(sections, "Assumed")[""]
    assert rows_of(sections, "Found")["water"].endswith(f"to 0.004 (survey.toml; that of the index is assumed){ASKED}")
    assert rows_of(sections, "Warnings")[""] == "1 image without a pose, left out: more.jpg"


def test_an_index_that_is_stated_is_not_said_to_be_assumed_however_uncertain_it_is(tmp_path):
    toml = TOML.replace("refractive_index = 1.333", "refractive_index = 1.333\nindex_std = 0.004")
    sections = check_survey(small_survey(tmp_path / "s", toml=toml))
    assert rows_of(sections, "Found")["water"].endswith(f"known: index to 0.004 (survey.toml){ASKED}")


def test_check_says_that_structure_from_motion_would_run_and_does_not_run_it(tmp_path):
    folder = small_survey(tmp_path / "s", gps=True, toml=TOML.replace('poses = "cameras.csv"', ""))
    (folder / "cameras.csv").unlink()
    before = sorted(folder.rglob("*"))
    sections = check_survey(folder)
    assert rows_of(sections, "Found")["positions"] == "4 of 4 images have one in EXIF, heights 2125.0 to 2125.0 m"
    assert rows_of(sections, "Found")["water"].endswith(f"by EXIF the cameras are 20.0 to 20.0 m over it{ASKED}")
    assert rows_of(sections, "Plan")["structure from motion"].startswith("on: there is no poses file")
    assert sorted(folder.rglob("*")) == before
    image = folder / "images" / "0001.jpg"
    image.write_bytes(image.read_bytes()[:1500])
    with pytest.raises(ImageError, match=r"0001\.jpg is damaged or cut off"):
        check_survey(folder)


@pytest.mark.parametrize(
    ("pairs", "kind", "words"),
    [
        ([("[64, 48]", "[32, 48]"), ("[32.0, 24.0]", "[16, 24]")], ImageError, "has 64 x 48 pixels, expected 32 x 48"),
        ([("100.0", "100.0\ngps_height = 'ellipsoidal'")], ConfigError, "needs a transformation of heights"),
        ([("100.0", "[100.0, 90.0]")], SurveyError, "structure from motion solves for square pixels"),
        ([("100.0", "8.8")], ConfigError, "8.8 px, so that its 64 x 48 px span 155.2 degrees from corner to corner"),
    ],
)
def test_what_structure_from_motion_would_refuse_is_refused_before_it_starts(tmp_path, pairs, kind, words):
    folder = unposed(tmp_path / "s", *pairs)
    for look in (check_survey, load_survey, require_processable):
        with pytest.raises(kind) as error:
            look(folder)
        assert words in str(error.value)


def test_positions_on_one_line_over_dry_ground_are_refused_before_structure_from_motion_starts(tmp_path):
    water = f"[water]\nlevel_m = {LEVEL}\nlevel_at = [{E0}, {N0}]\nrefractive_index = 1.333\n"
    folder = unposed(tmp_path / "s", (water, ""))
    for line in camera_lines():
        name, e, n, h, *_ = line.split(",")
        write_image(folder / "images" / name, gps=(float(e), float(n), float(h)))
    with pytest.raises(PosesError, match="4 GPS positions lie on one line"):
        check_survey(folder)


def test_one_pose_for_all_photographs_is_refused_and_for_two_of_them_doubted(tmp_path):
    folder = small_survey(tmp_path / "s")
    lines = camera_lines()
    write_poses(folder, [lines[0], lines[1], lines[2], lines[1].replace("0001", "0003")])
    assert load_survey(folder).findings.warnings == ("1 image with the pose of another one: 0003.jpg",)
    write_poses(folder, [f"{i:04d}.jpg,{E0},{N0},{LEVEL + 20},0,0,{10 * i}" for i in range(4)])
    for look in (check_survey, load_survey):
        with pytest.raises(PosesError, match="all 4 cameras are at one place within 10 mm"):
            look(folder)


@pytest.mark.parametrize(
    ("focal", "kind", "words"),
    [
        # 28 mm on film of 36 mm are 49.8 px of 64.
        (
            "498.0",
            ConfigError,
            "the focal length of 0002.jpg is 498 px, and EXIF gives 50 px, expected a factor of at most 5",
        ),
        ("4.98", ConfigError, "span 165.8 degrees from corner to corner, expected 1 to 135"),
    ],
)
def test_a_focal_length_ten_times_off_is_refused(tmp_path, focal, kind, words):
    folder = small_survey(tmp_path / "s", toml=replaced(("100.0", focal)))
    for line in camera_lines():
        write_image(folder / "images" / line.split(",")[0], FocalLengthIn35mmFilm=28)
    for look in (check_survey, load_survey):
        with pytest.raises(kind) as error:
            look(folder)
        assert words in str(error.value)


def test_a_focal_length_with_which_no_two_views_overlap_is_refused_even_without_exif(tmp_path):
    # The cameras stand 3.61 m apart, and 64 x 48 px of 1000 px see 1.28 x 0.96 m from 20 m.
    folder = small_survey(tmp_path / "s", toml=replaced(("100.0", "1000.0")))
    with pytest.raises(PosesError, match=r"4 of 4 views .* one covers 1\.60 m, and the next one begins 2\.01 m away"):
        check_survey(folder)


def test_a_view_apart_from_the_others_and_a_long_lens_are_doubted(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced(("100.0", "390.0")))
    lines = [line.replace(f"{E0 + 9:.3f}", f"{E0 + 40:.3f}") for line in camera_lines()]
    write_poses(folder, lines)
    warnings = load_survey(folder).findings.warnings
    assert warnings[0].startswith("the focal length of 0000.jpg is 390 px, a view of 11.7 degrees")
    assert warnings[1:] == ("1 view without overlap with another one at the water: 0003.jpg",)


def test_a_focal_length_of_a_cropped_photograph_is_doubted_by_check_and_by_process_alike(tmp_path):
    folder = small_survey(tmp_path / "s")
    for line in camera_lines():
        write_image(folder / "images" / line.split(",")[0], FocalLengthIn35mmFilm=28)
    (warning,) = load_survey(folder).findings.warnings
    assert warning.startswith("the focal length of 0002.jpg is 100 px, and EXIF gives 50 px; check that")
    assert rows_of(check_survey(folder), "Warnings")[""] == warning


def bounds_toml(e0: float, n0: float, e1: float, n1: float) -> str:
    """The settings of `small_survey` with bounds, in metres from the first camera."""
    return f"{TOML}[area]\nbounds = [{E0 + e0}, {N0 + n0}, {E0 + e1}, {N0 + n1}]\n"


@pytest.mark.parametrize("bounds", [(100.0, -5.0, 105.0, 5.0), (-6000.0, 100.0, 6000.0, 4000.0)])
@pytest.mark.parametrize("dry", [False, True])
def test_bounds_that_no_two_photographs_see_are_refused_with_the_extent_of_the_footprints(tmp_path, bounds, dry):
    toml = bounds_toml(*bounds)
    folder = small_survey(tmp_path / "s", toml=re.sub(r"(?s)\[water\].*(?=\[area\])", "", toml) if dry else toml)
    with pytest.raises(ConfigError, match=r"\[area\] bounds .* seen by fewer than two photographs") as error:
        check_survey(folder)
    words = str(error.value)
    assert f"{E0 + bounds[0]:.10g} to {E0 + bounds[2]:.10g} east" in words
    if not dry:
        # Four cameras 3 m apart to the east, 20 m over the water, 64 x 48 px of 100 px, turned by up to 30 degrees.
        low, high = map(float, re.search(r"reach from ([\d.]+) to ([\d.]+) east", words).groups())
        half = [6.4 * math.cos(math.radians(a)) + 4.8 * math.sin(math.radians(a)) for a in (0, 30)]
        assert low == pytest.approx(E0 - half[0], abs=0.02)
        assert high == pytest.approx(E0 + 9.0 + half[1], abs=0.02)


@pytest.mark.parametrize(
    "bounds",
    [
        (4.0, -3.0, 4.2, -2.9),  # less than the steps between the places of a photograph
        (-5e4, -5e4, 5e4, 5e4),
        (9.0, -6.0, 400.0, 400.0),  # a corner of it
    ],
)
def test_bounds_that_two_photographs_see_a_part_of_are_fine(tmp_path, bounds):
    assert require_processable(small_survey(tmp_path / "s", toml=bounds_toml(*bounds))).warnings == ()


def with_angles(folder, angles: np.ndarray) -> tuple[str, ...]:
    """The warnings of a survey whose poses have these angles, as they are written."""
    folder = small_survey(folder, num=len(angles))
    rows = [line.split(",")[:4] for line in camera_lines(len(angles))]
    lines = [",".join([*row, *(f"{a:.9f}" for a in three)]) for row, three in zip(rows, angles, strict=True)]
    write_poses(folder, lines)
    return load_survey(folder).findings.warnings


@pytest.mark.parametrize("name", ["quick", "river", "wreck_water"])
def test_the_angles_of_nadir_and_oblique_surveys_are_doubted_only_as_radians(data_dir, name):
    poses = read_poses(data_dir / name / "cameras.csv").poses
    angles = np.loadtxt(data_dir / name / "cameras.csv", delimiter=",", skiprows=1, usecols=(4, 5, 6))
    turned = [
        replace(p, cam_from_world=(grid_from_opk(*np.radians(a)) @ CAM_FROM_OPK_CAM).T)
        for p, a in zip(poses, np.radians(angles), strict=True)
    ]
    # Of one strip too, along which nothing turns.
    for num in (5, 9, len(poses)):
        assert angle_warnings(poses[:num], PoseFrame.GRID) == []
        assert len(angle_warnings(turned[:num], PoseFrame.GRID)) == 1


def test_angles_in_radians_are_doubted_and_degrees_are_not(tmp_path):
    # Strips flown to and fro on a gimbal that is good to a few tenths of a degree; strips that all look north.
    strips = np.random.default_rng(3).normal(0.0, [0.3, 0.3, 1.0], (6, 3))
    strips[3:, 2] += 180.0
    assert with_angles(tmp_path / "degrees", strips) == ()
    (warning,) = with_angles(tmp_path / "radians", np.radians(strips))
    assert warning.startswith("omega, phi, kappa are at most 3.1")
    assert "look like radians, expected degrees" in warning
    for seed in range(5):
        north = np.random.default_rng(seed).normal(0.0, [0.5, 0.5, 1.5], (8, 3))
        assert with_angles(tmp_path / str(seed), north) == ()


def test_a_size_of_the_settings_that_a_model_contradicts_is_said_not_to_be_used(tmp_path):
    folder = small_survey(tmp_path / "s", toml=replaced(("[64, 48]", "[640, 480]"), ("cameras.csv", "sparse")))
    (folder / "sparse").mkdir()
    (folder / "sparse" / "cameras.txt").write_text("1 PINHOLE 64 48 100 100 32 24\n")
    lines = [f"{i + 1} 0 1 0 0 {-3 * i} 0 20 1 {i:04d}.jpg\n\n" for i in range(4)]
    (folder / "sparse" / "images.txt").write_text("".join(lines))
    with (folder / "survey.toml").open("a") as file:
        file.write(f"[local]\norigin = [{E0}, {N0}, {LEVEL}]\n")
    (warning,) = load_survey(folder).findings.warnings
    assert warning.startswith("[cameras] size_px = [640, 480] in survey.toml has no effect: sparse has a lens")


def test_what_process_has_to_know_first_is_read_once_and_without_anything_slow(tmp_path):
    checked = require_processable(small_survey(tmp_path / "s"))
    assert [view.name for view in checked.survey.views] == list(checked.found.images)
    assert require_processable(unposed(tmp_path / "t")).survey is None
    code = "import sys, survey.plan.check; print({'torch', 'drjit', 'pycolmap', 'matplotlib'} & sys.modules.keys())"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "set()"


@pytest.mark.parametrize("toml", [TOML[: TOML.index("[water]")], TOML.replace("1.333", "1.0")])
def test_without_water_and_with_water_of_index_one_nothing_is_bent(tmp_path, toml):
    plan = make_plan(load_survey(small_survey(tmp_path / "s", toml=toml)))
    assert {d.name: d.choice for d in plan.decisions}["refraction"] == "off"


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
        ("draft", (4000, 3000), 0.25),
        ("standard", (2500, 2400), 1.0),
        ("standard", (2501, 2400), 0.5),
        ("fine", (5472, 3648), 1.0),
    ],
)
def test_images_are_halved_until_they_fit_the_quality(tmp_path, quality, size, scale):
    folder = small_survey(tmp_path / "s", num=3)
    first = folder / "images" / "0000.jpg"
    write_image(first, size=size)
    for name in ("0001.jpg", "0002.jpg"):
        (folder / "images" / name).write_bytes(first.read_bytes())
    toml = replaced(("[64, 48]", str(list(size))), ("principal_point_px = [32.0, 24.0]\n", ""), ("100.0", f"{size[0]}"))
    (folder / "survey.toml").write_text(toml)
    plan = make_plan(load_survey(folder), Choices(quality=quality))
    assert plan.image_scale == scale
    # 20 m over the water at a focal length of one width, and larger pixels of smaller images.
    assert plan.gsd_m == pytest.approx(20.0 / size[0] / scale)


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
    assert ground_below(cameras_of(dry)).height + dry.frame.origin[2] == pytest.approx(bed, abs=0.5)
    assert make_plan(dry).height_m == pytest.approx(make_plan(wet).height_m + 3.5, abs=0.5)
    # Nadir views 3.61 m apart whose shorter side sees 0.48 of the height: 3.61 / (0.25 * 0.48) = 30 m.
    nadir = load_survey(small_survey(tmp_path / "s", toml=TOML[: TOML.index("[water]")]))
    centre = np.median([view.camera.centre[2] for view in nadir.views])
    assert centre - ground_below(cameras_of(nadir)).height == pytest.approx(
        math.hypot(3.0, 2.0) / (0.25 * 0.48), rel=1e-3
    )


def test_dry_ground_is_where_points_are_known_and_a_guess_is_named_as_one(tmp_path):
    toml = TOML[: TOML.index("[water]")]
    nadir = load_survey(small_survey(tmp_path / "s", toml=toml))
    guess = make_plan(nadir)
    assert dry_ground(nadir).is_guess
    (line,) = [d for d in guess.decisions if d.name == "height over ground"]
    assert "a guess" in line.reason
    top = np.median([view.camera.centre[2] for view in nadir.views])
    # Half as high as the overlap suggests: everything that is counted in pixels follows.
    points = np.column_stack([np.zeros((60, 2)), np.full(60, top - 0.5 * guess.height_m)])
    known = make_plan(changed(nadir, points=points))
    assert known.height_m == pytest.approx(0.5 * guess.height_m)
    assert known.gsd_m == pytest.approx(0.5 * guess.gsd_m)
    assert known.footprint_m == pytest.approx([0.5 * side for side in guess.footprint_m])
    low = nadir.frame.crs_from_local(np.array([0.0, 0.0, top - 0.4 * guess.height_m]))[2]
    high = nadir.frame.crs_from_local(np.array([0.0, 0.0, top - 0.2 * guess.height_m]))[2]
    area = replace(nadir.config, area=replace(nadir.config.area, heights=(float(low), float(high))))
    assert make_plan(replace(nadir, config=area)).height_m == pytest.approx(0.3 * guess.height_m, rel=1e-3)


def test_views_too_few_to_check_their_poses_are_counted(tmp_path):
    choice, reason = pose_choice(load_survey(small_survey(tmp_path / "s")), "auto", free_water=False)
    assert choice == "fixed"
    assert reason.endswith("count as exact; a check needs at least 12 views, and there are 4")


def test_poses_that_are_kept_are_not_placed_on_an_earlier_survey():
    with pytest.raises(SurveyError, match="and --poses fixed leaves it out; leave out --poses fixed, or reference"):
        require_placeable("earlier.laz", "fixed")
    require_placeable("earlier.laz", "auto")
    require_placeable(None, "fixed")
