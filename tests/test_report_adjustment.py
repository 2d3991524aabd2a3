"""The part of the report about the adjustment: its figures, tables and pictures, and what it says of the water."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from small_bed import plane_bed
from small_report import PLAN
from small_survey import E0, LEVEL, N0, small_survey
from test_adjust_parts import cut

from survey.adjust.result.adjustment import ControlResidual, Status
from survey.control.points import Checkpoint, Control, ControlPoint
from survey.display.quantities import length, typeset
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import load_survey
from survey.report import ReportFacts
from survey.report.adjustment import adjustment_of, correlations, parameter_table, shown_lenses
from survey.report.checkpoints import CheckpointAccuracy, CheckpointRow
from survey.report.figures import figures_of, json_of
from survey.report.flight_pictures import (
    Residual,
    clip_outliers,
    draw_correlation,
    draw_ground_residuals,
    draw_image_residuals,
    draw_parts,
    draw_residuals,
    mean_residuals,
    residuals_of,
)
from survey.report.page import render_page
from tests.block_survey import drawn_adjustment
from tests.changed_survey import changed

OFF = np.array([0.03, -0.02, 0.05])


@pytest.fixture(scope="module")
def facts(tmp_path_factory) -> ReportFacts:
    """A report on a random block over the place of the small survey; its positions were given 6.2 cm off."""
    block, found = drawn_adjustment(num_views=20, dry_share=0.3)
    survey = load_survey(small_survey(tmp_path_factory.mktemp("survey") / "small"))
    priors = {
        name: PosePrior(centre - OFF, np.array([0.02, 0.02, 0.03]), None, "survey.toml")
        for name, centre in zip(found.poses.names, found.poses.centres, strict=True)
    }
    places = survey.frame.crs_from_local(found.points[:2])
    points = tuple(
        ControlPoint(row.name, tuple(crs), local, np.full(3, 0.01), row.is_check)
        for row, crs, local in zip(found.control, places, found.points, strict=False)
    )
    survey = changed(survey, water=block.plane, is_adjusted=True, priors=priors, control=Control(points, (), 0.5))
    bed = plane_bed(survey, num=20)
    points_crs = survey.frame.crs_from_local(bed.xyz)
    return ReportFacts(survey, PLAN, {}, {}, bed, points_crs, adjustment=found)


def test_report_json_has_the_adjustment_by_its_names(facts):
    found = json_of(figures_of(facts))["adjustment"]
    assert list(found) == [
        "parameters", "kinds", "num_points", "num_left_out", "positions", "poses", "control", "control_groups",
        "parts", "correlation_names", "correlation", "ground", "height_std_common_m",
    ]  # fmt: skip
    assert list(found["parameters"][0]) == ["name", "value", "std", "given", "given_std", "status", "verdict"]
    assert list(found["height_std_common_m"]) == ["mean", "typical"]
    assert 0.0 < found["height_std_common_m"]["mean"] < found["height_std_common_m"]["typical"]


def test_positions_are_told_by_their_distance_to_those_given(facts):
    positions = adjustment_of(facts.survey, facts.adjustment)["positions"]
    assert positions["num"] == 20
    assert positions["rms_m"] == pytest.approx(np.abs(OFF))
    assert positions["largest_m"] == pytest.approx(np.linalg.norm(OFF))


def test_what_heights_of_positions_have_in_common_is_told_apart(facts):
    priors = facts.survey.observations.priors
    higher = {
        name: replace(prior, position=prior.position + np.array([0.0, 0.0, 25.0])) for name, prior in priors.items()
    }
    survey, found = changed(facts.survey, priors=higher), replace(facts.adjustment, common_up_m=(25.0, 0.1))
    positions = adjustment_of(survey, found)["positions"]
    assert positions["rms_m"] == pytest.approx(np.abs(OFF))
    assert positions["common_up_m"] == (25.0, 0.1)
    page = render_page(figures_of(replace(facts, survey=survey, adjustment=found)), [])
    assert f"all {length(25.0)} too high" in page


def test_control_and_check_points_are_told_apart(facts):
    control, check = adjustment_of(facts.survey, facts.adjustment)["control_groups"]
    assert (control["name"], control["num"], control["rms_px"]) == ("control", 1, pytest.approx(0.31))
    assert check["rms_m"] == pytest.approx([0.012, 0.006, 0.021])
    assert check["le95_m"] == pytest.approx(1.9599640 * 0.021)
    # Of two errors that are alike, the square over the variance is that of an exponential distribution: -2 ln 0.1.
    assert check["ce95_m"] == pytest.approx(
        np.sqrt(-2.0 * np.log(0.05)) * np.sqrt((0.012**2 + 0.006**2) / 2.0), rel=1e-6
    )


def test_correlations_leave_out_what_was_not_to_move(facts):
    found = facts.adjustment
    covariance = found.covariance.matrix.copy()
    # The level and the focal length with a correlation of 0.5; a slope that was held.
    covariance[0, 4] = covariance[4, 0] = 0.5 * np.sqrt(covariance[0, 0] * covariance[4, 4])
    covariance[1, 1] = 1e-18
    names, matrix = correlations(replace(found, covariance=replace(found.covariance, matrix=covariance)))
    assert "slope_x" not in names
    assert matrix[names.index("height_m"), names.index("camera0.f")] == pytest.approx(0.5)
    np.testing.assert_allclose(np.diag(matrix), 1.0)


def test_the_page_has_verdicts_control_and_the_uncertainty_of_all_heights(facts):
    figures = figures_of(facts)
    level, *others = figures["adjustment"]["parameters"]
    lost = replace(level, status=Status.UNKNOWN, verdict="not observable: 1 sigma is +- 2 m")
    page = render_page(figures | {"adjustment": figures["adjustment"] | {"parameters": (lost, *others)}}, [])
    assert "<h2>Adjustment</h2>" in page
    # In words what has no value; of the others the table has the values.
    assert [typeset(f"{row.name} {row.verdict}") in page for row in (lost, *others)] == [True, *[False] * len(others)]
    assert "gcp2" in page
    assert "tandard deviation by water, lens and poses: " in page


def test_what_was_given_exactly_has_no_digits_of_its_error(facts):
    level, *others = adjustment_of(facts.survey, facts.adjustment)["parameters"]
    slope = replace(level, name="slope_east", value=0.0, given=0.0, std=1e-9, given_std=1e-9)
    assert parameter_table((level, slope, *others)).rows[1] == ("slope_east", "free", "0", "exact", "0", "exact")


def test_water_says_what_the_adjustment_found_and_what_it_kept(facts):
    water = figures_of(facts)["water"]
    assert water["level_from"] == "found by the adjustment"
    assert water["refractive_index_from"] == "survey.toml"
    level, *others = facts.adjustment.parameters
    unknown = replace(facts.adjustment, parameters=(replace(level, status=Status.UNKNOWN), *others))
    assert figures_of(replace(facts, adjustment=unknown))["water"]["level_from"] == "survey.toml, [water] level_m"


def test_a_run_without_an_adjustment_has_no_such_section(facts):
    figures = figures_of(replace(facts, adjustment=None))
    assert json_of(figures)["adjustment"] is None
    assert "<h2>Adjustment</h2>" not in render_page(figures, [])


def test_each_lens_has_its_own_residuals(facts, tmp_path):
    found = facts.adjustment
    lens_of = np.arange(len(found.poses.names)) % 2
    # One lens leaves a pixel to the right, the other one downwards.
    left = np.where(lens_of[found.residuals.view][:, None] == 0, [1.0, 0.0], [0.0, 1.0])
    poses, residuals = replace(found.poses, lens_of=lens_of), replace(found.residuals, px=left)
    two = replace(found, lenses=found.lenses * 2, poses=poses, residuals=residuals)
    for number, expected in enumerate(((1.0, 0.0), (0.0, 1.0))):
        _, vectors, _ = mean_residuals(two, number)
        np.testing.assert_allclose(vectors, np.tile(expected, (len(vectors), 1)))
    assert draw_image_residuals(tmp_path / "residuals_image.png", two).path.is_file()


def test_of_a_lens_for_each_photograph_four_are_drawn(facts, tmp_path):
    found = facts.adjustment
    num = len(found.poses.names)
    each = replace(found, lenses=found.lenses[:1] * num, poses=replace(found.poses, lens_of=np.arange(num)))
    shown = shown_lenses(each)
    count = np.bincount(found.residuals.view, minlength=num)
    assert num > 4 == len(shown)
    assert count[shown].min() >= np.delete(count, shown).max()
    picture = draw_image_residuals(tmp_path / "residuals_image.png", each)
    assert f"Of {num} lenses the 4 with the most residuals" in picture.caption


def test_a_block_that_falls_apart_has_a_table_and_a_picture_of_its_parts(facts, tmp_path):
    found, _ = cut(facts.adjustment)
    apart = replace(facts, adjustment=found)
    page = render_page(figures_of(apart), [draw_parts(tmp_path / "parts.png", apart.survey, found)])
    assert "Parts without common tie points" in page
    assert "Parts of the block without common points" in page
    with Image.open(tmp_path / "parts.png") as image:
        assert np.asarray(image.convert("L")).std() > 5.0
    parts = json_of(figures_of(apart))["adjustment"]["parts"]
    assert sum(len(part["names"]) for part in parts) == len(found.poses.names)
    assert json_of(figures_of(facts))["adjustment"]["parts"] == []


def test_the_pictures_are_drawn_and_are_whole(facts, tmp_path):
    pictures = [
        draw_ground_residuals(tmp_path / "residuals_ground.png", facts.survey, facts.adjustment),
        draw_image_residuals(tmp_path / "residuals_image.png", facts.adjustment),
        draw_correlation(tmp_path / "correlation.png", facts.adjustment),
    ]
    for picture in pictures:
        with Image.open(picture.path) as image:
            assert np.asarray(image.convert("L")).std() > 5.0, picture.path
    page = render_page(figures_of(facts), pictures)
    assert page.count("data:image/png;base64,") == 3


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return load_survey(small_survey(tmp_path_factory.mktemp("survey") / "s"))


def test_adjusted_points_and_the_cloud_at_rods_are_put_together(survey):
    place, local = (E0, N0, LEVEL), np.zeros(3)
    points = tuple(ControlPoint(name, place, local, np.full(3, 0.01), name == "c2") for name in ("c1", "c2"))
    survey = changed(survey, control=Control(points, (), 0.5), checkpoints=(Checkpoint("rod", place, local),))
    rows = (
        CheckpointRow("rod", 0.0, 0.0, LEVEL, 1.0, -0.03),
        CheckpointRow("c2", 0.0, 0.0, LEVEL, None, 0.5),
        CheckpointRow("far", 0.0, 0.0, LEVEL, 1.0, None),
    )
    adjusted = [ControlResidual(name, name == "c2", False, (0.01, 0.02, 0.03), 3, 0.4) for name in ("c1", "c2")]
    found = residuals_of(survey, _Adjusted(adjusted), CheckpointAccuracy(rows, (), 0.25))
    assert [(each.name, each.is_check) for each in found] == [("c1", False), ("c2", True), ("rod", True)]
    assert found[1].off_m == (0.01, 0.02, 0.03)
    assert found[2].off_m[2] == -0.03
    assert np.isnan(found[2].off_m[:2]).all()
    assert residuals_of(survey, None, None) == []


class _Adjusted:
    """What the map takes of an adjustment."""

    def __init__(self, control):
        self.control = control


def middle_of_arrows(survey, path, east: float) -> float:
    """Column of the pixels in the colour of arrows in plan, of points that are off to the east."""
    residuals = [
        Residual("a", (E0, N0), (east, 0.0, 0.0), False),
        Residual("b", (E0 + 4.0, N0 + 8.0), (east, 0.0, 0.0), False),
        Residual("rod", (E0, N0 + 4.0), (np.nan, np.nan, 0.01), True),
    ]
    assert draw_residuals(path, survey, residuals).title == "Control and check points"
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    # Not their sample in the legend below the map.
    pixels = pixels[: int(0.8 * len(pixels))]
    columns = np.argwhere(np.abs(pixels - (0x2F, 0x6F, 0x9F)).sum(axis=2) < 30)[:, 1]
    assert len(columns) > 100
    return float(np.median(columns))


def test_arrows_point_to_where_points_are_off(survey, tmp_path):
    right, left = (middle_of_arrows(survey, tmp_path / f"{east}.png", east) for east in (0.02, -0.02))
    assert right - left > 50.0


def test_a_point_far_off_sets_no_scale_for_the_others():
    off, _, is_far = clip_outliers(
        np.array([(0.02, 0.0, 0.01), (0.0, 0.03, -0.02), (0.01, 0.01, 0.02), (0.8, -2.0, -5.0)])
    )
    long = np.hypot(*off[:, :2].T)
    assert is_far.tolist() == [False, False, False, True]
    # Not a hundredth of the arrow of the wrong one, which is cut.
    assert long[1] > 0.3 * long[3]
