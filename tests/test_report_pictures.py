"""The pictures of a report: all of them, of every kind of bed, with a profile where there are points for one."""

import itertools
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from PIL import Image
from pyproj import CRS
from slow_cases import slow
from small_bed import plane_bed, plane_height_map
from small_report import PLAN, facts_of
from small_survey import TOML, small_survey

from geo import LocalFrame
from geo.grid import Grid
from survey.display import canvas
from survey.display.canvas import map_canvas, write_labels
from survey.display.palette import RED
from survey.display.plan_grid import PlanGrid
from survey.folder.survey import load_survey
from survey.photos.exif import read_exif
from survey.report import NUM_STEPS, write_report
from survey.report.flight_pictures import draw_plan, flight_lines
from survey.report.maps import draw_std, draw_unseen
from survey.report.profile import _medians, choose_cut, draw_profile, has_profile, two_digits
from survey.report.seen_cells import SeenCells, cells_of
from survey.run.folder import RunDir
from tests.changed_survey import changed


@pytest.fixture(scope="module")
def dry_survey(tmp_path_factory):
    dry = TOML[: TOML.index("[water]")]
    return load_survey(small_survey(tmp_path_factory.mktemp("survey") / "dry", toml=dry))


@pytest.mark.parametrize(("field", "words"), [("solver", "the normal matrix"), ("off", "the views that agree")])
def test_the_picture_of_the_std_says_where_it_comes_from(shallow_survey, tmp_path, field, words):
    bed = plane_bed(shallow_survey, num=20)
    facts = replace(facts_of(shallow_survey, bed), plan=replace(PLAN, field=field))
    low, high = bed.xyz[:, :2].min(axis=0), bed.xyz[:, :2].max(axis=0)
    picture = draw_std(tmp_path / "std.png", facts, PlanGrid.within(bed.xyz, low, high, 1.0))
    assert picture.title == "Standard deviation of the height"
    assert words in picture.caption


def test_all_pictures_are_drawn_and_are_whole(plane_report):
    paths = sorted(plane_report.run.pictures_path.iterdir())
    errors = "error error_bands error_histogram"
    names = f"completeness depth {errors} histograms orthophoto plan profile std unseen view views"
    assert [path.name for path in paths] == [f"{name}.png" for name in names.split()]
    # There is no adjustment, which has four, no control, and still water.
    assert plane_report.num_steps == len(paths) == NUM_STEPS - 6
    for path in paths:
        with Image.open(path) as image:
            assert np.asarray(image.convert("L")).std() > 5.0, path  # neither black nor white


@pytest.mark.parametrize("kind", [slow("dry"), "empty", slow("one point"), "strip in degrees", slow("tilted water")])
def test_every_kind_of_bed_gets_a_report(shallow_survey, dry_survey, tmp_path, kind):
    survey = dry_survey if kind == "dry" else shallow_survey
    if kind == "strip in degrees":
        frame = LocalFrame(CRS("EPSG:4979"), (10.16, 46.89, 2105.0))
        survey = changed(survey, frame=frame, bounds=None)
    if kind == "tilted water":
        survey = replace(survey, water=replace(survey.water, slope_x=0.01, slope_y=-0.02))
    bed = plane_bed(survey, num=40)
    keep = {
        "empty": np.zeros(len(bed), bool),
        "one point": np.arange(len(bed)) == 7,
        "strip in degrees": np.abs(bed.xyz[:, 1]) < 0.06,
    }
    bed = bed[keep.get(kind, np.ones(len(bed), bool))]
    maps = [plane_height_map(survey, 0)] if kind == "dry" else None
    with RunDir(tmp_path / "run") as run:
        figures = write_report(run.path, facts_of(survey, bed, height_maps=maps))
    assert figures["cloud"]["points"] == len(bed)
    assert (run.pictures_path / "plan.png").exists()
    assert (run.pictures_path / "depth.png").exists() == (len(bed) > 0)
    assert (run.pictures_path / "profile.png").exists() == (kind not in ("empty", "one point"))
    assert figures["verdict"] is None
    if kind == "dry":
        assert figures["water"] is None
        assert figures["cloud"]["depth_m"] is None
        assert "a dry survey" in run.report_html_path.read_text(encoding="utf-8")


def test_the_cut_runs_down_the_slope_of_the_bed(shallow_survey):
    """The bed of the small survey falls to the west alone."""
    cut = choose_cut(facts_of(shallow_survey, plane_bed(shallow_survey)))
    along, across = cut.along_and_across(cut.ends)
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    np.testing.assert_allclose(along, [0.0, cut.length_m], atol=1e-9)
    # From edge to edge, in one of twelve directions.
    assert abs(cut.direction[0]) * cut.length_m == pytest.approx(14.0, rel=0.1)


def test_the_cut_of_a_bed_with_a_pit_goes_through_it(shallow_survey):
    bed = plane_bed(shallow_survey)
    in_pit = np.hypot(bed.xyz[:, 0] - 3.0, bed.xyz[:, 1] + 4.0) < 1.5
    bed = replace(bed, depth=np.where(in_pit, 5.0, 0.3).astype(bed.depth.dtype))
    _, across = choose_cut(facts_of(shallow_survey, bed)).along_and_across(np.array([[3.0, -4.0]]))
    assert abs(across[0]) < 1.5


def test_the_medians_of_a_profile_skip_gaps():
    x, y = _medians(np.array([0.1, 0.2, 0.3, 2.4, np.nan]), np.array([5.0, 7.0, 6.0, 1.0, np.nan]), 1.0)
    np.testing.assert_array_equal(x, [0.5, 1.5, 2.5])
    np.testing.assert_array_equal(y, [6.0, np.nan, 1.0])


def test_a_handful_of_points_gets_no_profile(shallow_survey):
    bed = plane_bed(shallow_survey)
    few = facts_of(shallow_survey, bed[np.arange(len(bed)) % (len(bed) // 33) == 0])
    assert not has_profile(few, choose_cut(few))
    all_of_it = facts_of(shallow_survey, bed)
    assert has_profile(all_of_it, choose_cut(all_of_it))


def test_a_profile_of_a_wet_survey_shows_the_level_even_over_a_dry_bed(shallow_survey, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(canvas, "save", lambda figure, _path: drawn.append(figure.axes[0]))
    bed = plane_bed(shallow_survey)
    level = shallow_survey.config.water.level_m
    facts = facts_of(shallow_survey, bed)
    raised = np.array([0.0, 0.0, level + 3.0 - facts.points_crs[:, 2].min()])
    facts = replace(facts, points_crs=facts.points_crs + raised)
    draw_profile(tmp_path / "profile.png", facts, choose_cut(facts))
    low, high = drawn[0].get_ylim()
    assert low < level < level + 3.0 < high
    assert "water" in drawn[0].get_legend_handles_labels()[1]


@pytest.mark.parametrize(("value", "text"), [(0.123, "0.12"), (1.0, "1"), (1.849, "1.8"), (18.4, "18"), (183.0, "180")])
def test_a_factor_has_two_digits_and_no_exponent(value, text):
    assert two_digits(value) == text


def test_flight_lines_go_from_exposure_to_exposure_and_not_over_a_pause():
    seconds = np.array([4.0, 0.0, 2.0, 60.0, 62.0])
    centres = np.arange(10.0).reshape(5, 2)
    lines = flight_lines(seconds, centres)
    assert lines.tolist() == [[[2, 3], [4, 5]], [[4, 5], [0, 1]], [[6, 7], [8, 9]]]


def test_the_plan_of_a_flight_has_its_lines(shallow_survey, tmp_path):
    start = datetime(2026, 6, 1, tzinfo=UTC)
    headers = {
        view.name: replace(read_exif(view.path), taken=start + timedelta(seconds=2 * i))
        for i, view in enumerate(shallow_survey.views)
    }
    facts = facts_of(shallow_survey, plane_bed(shallow_survey, num=20))
    draw_plan(tmp_path / "without.png", facts)
    draw_plan(tmp_path / "with.png", replace(facts, headers=headers))
    assert (tmp_path / "with.png").read_bytes() != (tmp_path / "without.png").read_bytes()


def test_ground_without_points_is_told_apart_by_the_views_that_see_it():
    has_point, num_views = np.array([[True, False], [False, False]]), np.array([[3, 4], [1, 0]])
    cells = SeenCells(Grid.northward_from(np.zeros(2), 1.0, (2, 2)), has_point, num_views, np.zeros((2, 2)))
    assert cells.gaps.tolist() == [[0, 1], [2, 0]]


def test_the_map_of_what_was_not_found_says_how_much_of_the_ground_it_is(shallow_survey, tmp_path):
    bed = plane_bed(shallow_survey, num=40)
    half = bed[bed.xyz[:, 0] < np.median(bed.xyz[:, 0])]
    facts = facts_of(shallow_survey, half)
    whole, part = (cells_of(shallow_survey, each.xyz, facts.plan.gsd_m).gaps for each in (bed, half))
    assert (part == 1).sum() > (whole == 1).sum()
    draw_unseen(tmp_path / "unseen.png", facts)
    with Image.open(tmp_path / "unseen.png") as image:
        colours = np.asarray(image.convert("RGB")).reshape(-1, 3)
    red = np.array([int(RED[k : k + 2], 16) for k in (1, 3, 5)])
    assert (np.abs(colours - red.astype(int)).sum(axis=1) < 6).mean() > 0.02


def test_labels_cover_neither_points_nor_each_other():
    figure, axes = map_canvas((0.0, 10.0, 0.0, 10.0), None)
    places = np.array([[5.0, 5.0], [5.3, 5.2], [5.6, 4.9], [9.9, 9.9], [1.0, 1.0]])
    write_labels(axes, places, ["rod1", "rod2", "rod3", "rod4", "rod5"])
    renderer = figure.canvas.get_renderer()
    boxes = [text.get_window_extent(renderer) for text in axes.texts if text.get_text().startswith("rod")]
    assert len(boxes) >= 4
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    assert not any(box.contains(*place) for box in boxes for place in axes.transData.transform(places))


def test_the_scale_bar_lies_below_the_map_and_is_true_to_scale():
    _, axes = map_canvas((512300.0, 512340.0, 5960000.0, 5960030.0), CRS("EPSG:25832"))
    (bar,) = axes.lines
    (start, end), heights = bar.get_data()
    (label,) = [text.get_text() for text in axes.texts if text.get_text().endswith(" m")]
    west, east = axes.get_xlim()
    assert (end - start) * (east - west) == pytest.approx(float(label.removesuffix(" m")))
    assert max(heights) < 0.0
    assert axes.transAxes.transform((0.0, heights[0]))[1] > 0.0
