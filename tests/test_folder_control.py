"""Control and check points of a survey folder: beside its cameras, in its local frame, with their accuracies."""

import tomllib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from control_files import METASHAPE, POINTS, SURVEY_CRS, odm, table, written
from pyproj import Transformer
from small_survey import E0, LEVEL, N0, TOML, camera_lines, rows_of, small_survey, unposed, write_poses

from geo.crs import parse_crs
from survey.control.reading import merge_control, read_control
from survey.errors import ControlError
from survey.folder.control import checkpoint_findings, find_control, mark_residuals
from survey.folder.found import find_survey, survey_inputs
from survey.folder.sfm_views import require_solvable
from survey.folder.survey import load_survey
from survey.plan.check import check_survey
from survey.settings.tables import ControlConfig
from survey.stage_key import stage_key
from survey.water.surface import Departure


def test_marks_of_a_drawn_survey_are_where_its_true_lens_shows_the_points(data_dir):
    """Marks are good to 0.4 px; an origin of pixels half a pixel off would show in the mean of 46."""
    survey = load_survey(data_dir / "shore")
    truth = tomllib.loads((data_dir / "shore" / "truth.toml").read_text())
    focal, (cx, cy) = truth["focal_px"], truth["principal_point_px"]
    matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    cameras = {view.name: view.camera for view in survey.views}
    local = {point.name: point.local for point in survey.observations.control.points}
    residuals = []
    for mark in survey.observations.control.marks:
        camera = cameras[mark.view]
        in_cam = camera.cam_from_local @ (local[mark.point] - camera.centre)
        shown, _ = cv2.projectPoints(
            in_cam[None, None], np.zeros(3), np.zeros(3), matrix, np.array(truth["distortion"])
        )
        residuals.append(np.array(mark.pixel) - shown.ravel())
    assert (len(survey.observations.control.points), len(residuals)) == (6, 46)
    assert np.abs(np.mean(residuals, axis=0)).max() < 3.0 * 0.4 / 46**0.5
    assert np.std(residuals) < 0.5


def test_the_control_and_check_points_of_a_drawn_survey_are_in_crs_and_local(data_dir):
    survey = load_survey(data_dir / "shore")
    point, rod = survey.observations.control.points[0], survey.observations.checkpoints[0]
    assert (point.name, point.crs) == ("gcp1", (512345.8136, 5960213.4390, 3.28))
    assert np.abs(survey.frame.crs_from_local(point.local) - point.crs).max() < 1e-6
    assert point.std.tolist() == [0.01, 0.01, 0.01]
    assert survey.observations.control.marks_std_px == 0.5
    assert (len(survey.observations.checkpoints), rod.name, rod.crs[2]) == (20, "rod1", -0.139)
    assert said(survey, "0.01 m is assumed")
    assert stage_key(survey.observations.control, survey.observations.checkpoints, survey.observations.priors)


def with_control(tmp_path, control: str = 'gcps = "gcp_list.txt"', **files: str):
    folder = small_survey(tmp_path / "s", toml=TOML + f"[control]\n{control}\n")
    written(folder, **(files or {"gcp_list__txt": odm()}))
    return folder


def test_a_survey_has_its_control_in_local_and_its_settings_say_what_was_assumed(tmp_path):
    survey = load_survey(with_control(tmp_path))
    assert [point.name for point in survey.observations.control.points] == ["p1", "p2", "p3"]
    for point, (_, *place) in zip(survey.observations.control.points, POINTS, strict=True):
        assert (point.local == survey.frame.local_from_crs(place)).all()
    assert survey.findings.assumptions == ("[control] marks_std_px = 0.5, the std of their marks in pixels",)
    assert said(survey, "stated for 3 of 3 control points: 0.01 m is assumed")
    assert (survey.config.control.std_m, survey.config.control.marks_std_px) == (0.01, 0.5)


def said(survey, words: str) -> list[str]:
    """The warnings with these words."""
    return [warning for warning in survey.findings.warnings if words in warning]


@pytest.mark.parametrize(
    ("text", "untold"),
    [
        ('gcps = "gcp_list.txt"', 3),
        ('gcps = "points.xml"', 2),
        ('gcps = "gcp_list.txt"\nstd_m = 0.02', 0),
        ('gcps = "points.xml"\nstd_m = [0.02, 0.04]\nmarks_std_px = 0.3', 0),
    ],
)
def test_accuracies_of_survey_toml_count_where_the_file_has_none_and_a_lack_of_both_is_said(tmp_path, text, untold):
    survey = load_survey(with_control(tmp_path, text, gcp_list__txt=odm(), points__xml=METASHAPE))
    told = said(survey, f"no accuracy is stated for {untold} of 3 control points")
    assert len(told) == len(said(survey, "no accuracy")) == (untold > 0)
    if "marks_std_px" in text:
        p1, p2, _ = survey.observations.control.points
        assert (p1.std.tolist(), p2.std.tolist()) == ([0.02, 0.02, 0.04], [0.02, 0.03, 0.05])
        assert (survey.observations.control.marks_std_px, survey.findings.assumptions) == (0.3, ())


def test_marks_in_photographs_without_a_pose_are_left_out_by_name(tmp_path):
    folder = with_control(tmp_path)
    write_poses(folder, camera_lines()[1:])
    survey = load_survey(folder)
    assert {mark.view for mark in survey.observations.control.marks} == {"0001.jpg"}
    assert said(survey, "1 photograph with marks of control has no pose, its marks left out: 0000.jpg")


SWAPPED = [(name, n, e, h) for name, e, n, h in POINTS]
LAT_LON = [(name, *Transformer.from_crs("EPSG:25832", "EPSG:4326").transform(*place), h) for name, *place, h in POINTS]


@pytest.mark.parametrize(
    ("points", "header", "words"),
    [
        (SWAPPED, "EPSG:25832", r"among them with easting and northing \(or .*\) swapped; swap the two columns"),
        (LAT_LON, "EPSG:4326", "swapped; swap the two columns in the file"),
        (
            [("p", 10.17, 46.9, LEVEL)],
            "EPSG:25832",
            "looks like longitude and latitude, expected ETRS89 / UTM zone 32N",
        ),
        ([*POINTS, ("far", E0 + 30e3, N0, LEVEL)], "EPSG:25832", r"line 8: the point far at .* lies 30 km from the n"),
        ([("far", 1e30, N0, LEVEL)], "EPSG:25832", r"line 2: the point far at 1e\+30"),
        (POINTS, "EPSG:25833", r"line 2: the point p1 at .* lies \d+ km from the nearest camera"),
    ],
)
def test_points_far_from_the_cameras_are_refused_with_what_is_likely_wrong(tmp_path, points, header, words):
    folder = with_control(tmp_path, gcp_list__txt=odm(points, header))
    with pytest.raises(ControlError, match=words):
        load_survey(folder)


def test_of_the_file_in_marks_only_the_marks_count(tmp_path):
    moved = [(name, e + 0.5, n, h) for name, e, n, h in POINTS]
    control = 'gcps = "points.csv"\nmarks = "markers.xml"'
    survey = load_survey(with_control(tmp_path, control, points__csv=table(moved), markers__xml=METASHAPE))
    assert [point.crs[0] for point in survey.observations.control.points] == [e for _, e, _, _ in moved]
    assert len(survey.observations.control.marks) == 6


def test_points_far_from_gps_positions_are_refused_before_structure_from_motion(tmp_path):
    folder = unposed(tmp_path / "s", ("[water]", '[control]\ngcps = "gcp_list.txt"\n[water]'))
    written(folder, gcp_list__txt=odm([("far", E0 + 30e3, N0, LEVEL)]))
    with pytest.raises(ControlError, match="30 km from the nearest camera"):
        require_solvable(find_survey(folder))


def test_points_above_all_cameras_are_doubted(tmp_path):
    high = [(name, e, n, h + 50.0) for name, e, n, h in POINTS]
    survey = load_survey(with_control(tmp_path, gcp_list__txt=odm(high)))
    assert said(survey, "3 of 3 control or check points lie above all cameras")


@pytest.mark.parametrize("height", [LEVEL / 10.0, -LEVEL, 0.0])
def test_a_check_point_whose_height_is_far_from_the_others_is_named(tmp_path, height):
    _, east, north, level = POINTS[0]
    rods = [(f"p{i}", east + 0.1 * i, north, level + 0.3 * i) for i in range(6)]
    for wrong, expected in (([], 0), ([("typo", east, north, height)], 1)):
        survey = load_survey(
            with_control(tmp_path / str(expected), 'checkpoints = "rods.csv"', rods__csv=table(rods + wrong))
        )
        far = said(survey, "far from the others by its height")
        assert len(far) == len(said(survey, f"typo ({height:.2f} m in ")) == expected


def test_check_points_are_read_with_or_without_names(tmp_path):
    survey = load_survey(with_control(tmp_path, 'checkpoints = "rods.csv"', rods__csv=table()))
    assert survey.observations.control is None
    assert [rod.name for rod in survey.observations.checkpoints] == ["p1", "p2", "p3"]
    bare = f"easting,northing,height\n{E0},{N0},{LEVEL - 2}\n"
    (rod,) = load_survey(with_control(tmp_path, 'checkpoints = "rods.csv"', rods__csv=bare)).observations.checkpoints
    assert (rod.name, rod.crs) == ("1", (E0, N0, LEVEL - 2))
    with pytest.raises(ControlError, match=r"rods\.csv has no check points"):
        load_survey(with_control(tmp_path, 'checkpoints = "rods.csv"', rods__csv="easting,northing,height\n"))
    with pytest.raises(ControlError, match=r"line 5: check point p1 is in .* too"):
        load_survey(with_control(tmp_path, 'checkpoints = "rods.csv"', rods__csv=table([*POINTS, POINTS[0]])))


@pytest.mark.parametrize("height", [LEVEL - 2.0, LEVEL + 1.0])
def test_check_points_that_no_photograph_shows_are_named(tmp_path, height):
    lines = [f"{name},{E0 + east},{N0},{height}" for name, east in (("near", 0.0), ("far", 60.0))]
    rods = "\n".join(["name,easting,northing,height", *lines])
    survey = load_survey(with_control(tmp_path, 'checkpoints = "rods.csv"', rods__csv=rods))
    message = "1 check point that no photograph shows, so that nothing is compared with it: far"
    # That lowers no verdict on the other; where none is shown, their place is doubted.
    assert (message in survey.findings.assumptions, said(survey, "no photograph shows")) == (True, [])
    (folder := tmp_path / "far").mkdir()
    alone = "\n".join(["name,easting,northing,height", lines[1]])
    survey = load_survey(with_control(folder, 'checkpoints = "rods.csv"', rods__csv=alone))
    assert said(survey, "no photograph shows") == [message]


def test_check_points_are_looked_for_through_the_water_that_is_there(tmp_path):
    """Five metres under water that stands four over its plane, where a ray bent at this plane alone shows the point."""
    rods = f"name,easting,northing,height\nedge,{E0 + 7.75},{N0},{LEVEL - 5.0}"
    survey = load_survey(with_control(tmp_path, 'checkpoints = "rods.csv"', rods__csv=rods))
    points, first = survey.observations.checkpoints, survey.views[:1]
    low = replace(survey.water, point=(*survey.water.point[:2], survey.water.point[2] - 4.0))
    corners = np.array([[-30.0, -30.0], [-30.0, 30.0], [30.0, -30.0], [30.0, 30.0]])
    higher = Departure(np.column_stack([corners, np.full(4, 4.0)]), np.full(4, 0.01))
    assert not checkpoint_findings(points, first, low, None).warnings
    for water, departure in ((survey.water, None), (low, higher)):
        (warning,) = checkpoint_findings(points, first, water, departure).warnings
        assert "no photograph shows" in warning


def test_the_files_of_control_are_inputs(tmp_path):
    folder = with_control(tmp_path, 'gcps = ["a.csv", "b.csv"]\nmarks = "m.csv"\ncheckpoints = "rods.csv"')
    written(folder, **dict.fromkeys(("a__csv", "b__csv", "m__csv", "rods__csv"), "\n"))
    assert {folder / name for name in ("a.csv", "b.csv", "m.csv", "rods.csv")} <= set(survey_inputs(folder).files)


def test_real_marks_of_photographs_that_were_halved_lie_outside_and_doubled_they_fit(data_dir):
    folder = data_dir / "real" / "copr_half"
    content = read_control(folder / "gcp_list.txt")
    names = sorted(path.name for path in (folder / "images").iterdir())
    crs = parse_crs("EPSG:32611+5773")
    with pytest.raises(ControlError, match=r"lies outside .* if the photographs were reduced, reduce the marks too"):
        merge_control([content], crs, dict.fromkeys(names, (2136, 1424)))
    found, findings = merge_control([content], crs, dict.fromkeys(names, (4272, 2848)))
    assert (len(found.points), len(found.marks)) == (len({mark.point for mark in found.marks}), 27)
    assert findings.warnings == ("all control points have the height 0; check that the file has their heights",)


def seen_marks(survey, shift=(0.0, 0.0)) -> str:
    """gcp_list.txt whose marks are where the views of a survey show three points at the water line."""
    lines = []
    for name, e, n, h in POINTS:
        for view in survey.views:
            x, y = view.camera.project(survey.frame.local_from_crs([e, n, h]), None)
            if not (4.0 < x < 60.0 and 4.0 < y < 44.0):
                continue
            lines.append(f"{e} {n} {h} {x - 0.5 + shift[0]:.3f} {y - 0.5 + shift[1]:.3f} {view.name} {name}")
    return "\n".join(["EPSG:25832", *lines]) + "\n"


def test_marks_are_held_against_the_poses(tmp_path):
    bare = load_survey(small_survey(tmp_path / "bare"))
    control = 'gcps = "gcp_list.txt"\nstd_m = 0.02'
    survey = load_survey(with_control(tmp_path, control, gcp_list__txt=seen_marks(bare)))
    assert mark_residuals(survey.observations.control, survey.views, survey.water).max() < 2e-3
    assert survey.findings.warnings == ()
    shifted = load_survey(with_control(tmp_path, control, gcp_list__txt=seen_marks(bare, (3.0, 0.0))))
    (warning,) = shifted.findings.warnings
    assert warning.startswith("the marks of control points lie 3 px (median) from where the poses show these points;")
    lines = seen_marks(bare).splitlines()
    parts = lines[1].split()
    parts[3] = "60.0"
    (warning,) = load_survey(
        with_control(tmp_path, control, gcp_list__txt="\n".join([lines[0], " ".join(parts), *lines[2:]]))
    ).findings.warnings
    assert warning == "1 mark far from where the pose shows its point, to be checked: p1 in 0000.jpg"


def test_marks_are_measured_under_a_lens_that_distorts(tmp_path):
    toml = TOML.replace('model = "PINHOLE"', 'model = "OPENCV"\ndistortion = [-0.2, 0.05, 0.002, 0.0]')
    folder = small_survey(tmp_path / "s", toml=toml)
    survey = load_survey(folder)
    place = (E0 + 5.5, N0 - 3.0, LEVEL + 0.5)
    local = survey.frame.local_from_crs(place)
    lines = ["EPSG:25832"]
    for view in survey.views:
        x, y = view.camera.project(local, survey.water) - 0.5  # OpenDroneMap counts from the centre of the first pixel
        lines.append(f"{place[0]} {place[1]} {place[2]} {x:.4f} {y:.4f} {view.name} far")
    (folder / "gcp_list.txt").write_text("\n".join(lines) + "\n")
    (folder / "survey.toml").write_text(toml + '[control]\ngcps = "gcp_list.txt"\n')
    survey = load_survey(folder)
    # The file has four digits.
    assert mark_residuals(survey.observations.control, survey.views, survey.water).max() < 1e-3


def test_check_says_how_many_points_and_marks_there_are_and_how_well_all_is_known(tmp_path):
    control = 'gcps = "gcp_list.txt"\nstd_m = [0.02, 0.03]\ncheckpoints = "rods.csv"'
    folder = with_control(tmp_path, control, gcp_list__txt=odm(), rods__csv=table())
    text = (folder / "survey.toml").read_text()
    text = text.replace("[water]", "position_std_m = 0.02\n[water]\nlevel_std_m = 0.05\nindex_std = 0.001")
    (folder / "survey.toml").write_text(text)
    rows = rows_of(check_survey(folder), "Found")
    assert rows["control"] == (
        "3 points, with 6 marks in 2 images; 3 good to 0.02 m across and 0.03 m in height ([control] std_m); marks to "
        "0.5 px"
    )
    assert rows["check points"] == "3, which results are compared with"
    assert rows["accuracy"] == "4 of 4 positions good to 0.02, 0.02 and 0.02 m east, north and up (survey.toml)"
    assert rows["water"].endswith("; known: level to 0.05 m, index to 0.001 (survey.toml)")
    assert "px (median) from where poses and lens show their points, at most" in rows["marks"]


def test_check_says_it_before_structure_from_motion_too(tmp_path):
    control = '[control]\ngcps = "points.xml"\nstd_m = 0.02\n[water]'
    folder = unposed(tmp_path / "s", ("[water]", control))
    written(folder, points__xml=METASHAPE)
    rows = rows_of(check_survey(folder), "Found")
    assert rows["control"] == (
        "3 points, 1 of them check points, with 6 marks in 2 images; 1 good to 0.02, 0.03 and 0.05 m (their file), 2 "
        "good to 0.02 m ([control] std_m); marks to 0.5 px"
    )
    assert rows["accuracy"] == "4 of 4 positions of unknown accuracy (GPS EXIF)"


def test_what_lies_in_the_folder_or_the_settings_without_being_used_is_said(tmp_path):
    folder = unposed(tmp_path / "s", ("[water]", "rotation_std_deg = 1\n[water]"))
    written(folder, gcp_list__txt=odm())
    (folder / "images/100_Timestamp.MRK").write_text("1\n")
    positions, rotation, control = find_survey(folder).findings.warnings
    assert positions.startswith("GNSS positions not read, of 100_Timestamp.MRK: ")
    assert rotation.startswith("[cameras] rotation_std_deg = ")
    assert control == 'gcp_list.txt is not used; for its control points write gcps = "gcp_list.txt" in [control]'


@pytest.mark.parametrize(("shift", "is_named"), [(0.0, True), (0.02, True), (0.3, False)])
def test_check_points_at_control_points_are_named(tmp_path, shift, is_named):
    rods = [(f"c{i}", e + shift, n, h) for i, (_, e, n, h) in enumerate(POINTS)]
    files = {"gcp_list__txt": odm(), "rods__csv": table([*rods, ("free", E0 + 2.0, N0 + 3.0, LEVEL - 1.0)])}
    survey = load_survey(with_control(tmp_path, 'gcps = "gcp_list.txt"\ncheckpoints = "rods.csv"', **files))
    found = said(survey, "at the place of a control point")
    assert [text.rpartition(": ")[2] for text in found] == (["c0, c1, c2"] if is_named else [])


@pytest.mark.parametrize(
    ("heights", "words"),
    [
        ([-0.4, -1.2, -2.0], None), ([0.4, -1.2, -2.0], None), ([0.4, 1.2, 2.0], "lie over the water, by"),
        ([0.8 - LEVEL, 1.2 - LEVEL, 2.0 - LEVEL], "lie under the water, by"),
    ],
)  # fmt: skip
def test_check_points_whose_heights_may_be_depths_are_named(tmp_path, heights, words):
    rods = [(name, e, n, LEVEL + over) for (name, e, n, _), over in zip(POINTS, heights, strict=True)]
    survey = load_survey(with_control(tmp_path, 'checkpoints = "rods.csv"', rods__csv=table(rods)))
    found = said(survey, "if their heights are depths, call the column depth")
    assert [words in text for text in found] == ([] if words is None else [True])


@pytest.mark.parametrize(
    ("level", "heights", "is_named"),
    [(-3.0, (3.2, 5.0), True), (3.0, (-3.5, -1.0), True), (3.0, (1.0, 5.0), False), (-0.5, (0.8, 2.0), False),
     (584.0, (584.5, 586.0), False), (0.0, (5.0, 9.0), False)],
)  # fmt: skip
def test_a_level_whose_sign_is_wrong_is_doubted_by_control(tmp_path, level, heights, is_named):
    rods = table([("a", E0, N0, heights[0]), ("b", E0 + 1.0, N0, heights[1])])
    written(tmp_path, rods__csv=rods)
    _, findings = find_control(tmp_path, ControlConfig(checkpoints="rods.csv"), SURVEY_CRS, {}, level)
    assert any("check the sign of [water] level_m" in text for text in findings.warnings) == is_named
