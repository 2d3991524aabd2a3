"""The report of a run: figures that are true, a page that needs nothing else, pictures of every bed."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from pyproj import CRS
from small_bed import SLOPE, SPACING_M, plane_bed, plane_depth_map, write_plane_mesh
from small_survey import TOML, small_survey

from evaluation import DistanceStatistics, iho_s44
from geo import LocalFrame
from survey.compare.comparison import CompareOptions, compare_surfaces
from survey.display.plan_grid import PlanGrid
from survey.display.quantities import LengthUnit, length
from survey.folder.survey import load_survey
from survey.plan.plan import Plan
from survey.plan.skipped import Decision
from survey.report import NUM_STEPS, ReportFacts, profile, write_report
from survey.report.collect import figures_of
from survey.report.cut import choose_cut
from survey.report.figures import Spread
from survey.report.headline import cards, headline
from survey.report.json_figures import json_of
from survey.report.maps import draw_std
from survey.report.page import render_page
from survey.report.profile import _medians, draw_profile, has_profile, two_digits
from survey.report.raster import hillshade, without_pinholes
from survey.report.verdict import Gate, Verdict
from survey.run.cloud import write_bed_las
from survey.run.folder import RunDir
from survey.run.stored import StoredBed

RAISED_M = 0.004
# LAS rounds heights to 1 mm, evenly to both sides.
LAS_STD_M = 1e-3 / np.sqrt(12.0)
# Ten different fractions of a millimetre are rounded; a tenth of one stays.
LAS_BIAS_M = 1e-4
# The water touches a level surface 5 m from the origin; over 12 m that is (12 m)^2 / 6.4e6 m at most.
CURVATURE_M = 2.3e-5

MET = Gate("covered", 87.5, 50.0, "%", True, "87.5 % of the ground has a point, at least 50 % is asked")
MISSED = Gate("spread", 9.9, 5.0, "cm", False, "The median standard deviation is 9.9 cm; 5 cm are allowed.")

PLAN = Plan(
    quality="standard",
    device="llvm",
    image_scale=1.0,
    gsd_m=0.05,
    height_m=20.0,
    footprint_m=(12.8, 9.6),
    decisions=(Decision("refraction", "on", "water of index 1.3330 <here>"),),
)


def _facts(survey, bed, **others) -> ReportFacts:
    points_crs = survey.frame.crs_from_local(bed.xyz)
    timings, others = {"sweep": 61.2, "bed": 4.0}, {"versions": {"bathynerf": "0.1.0"}} | others
    return ReportFacts(survey, PLAN, {"quality": "standard"}, timings, bed, points_crs, **others)


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    toml = TOML.replace('"small"', '"small & <shallow>"') + "[area]\nbounds = [589006, 5194730, 589019, 5194742]\n"
    return load_survey(small_survey(tmp_path_factory.mktemp("survey") / "small", toml=toml))


@pytest.fixture(scope="module")
def dry_survey(tmp_path_factory):
    dry = TOML[: TOML.index("[water]")]
    return load_survey(small_survey(tmp_path_factory.mktemp("survey") / "dry", toml=dry))


@pytest.fixture(scope="module")
def report(survey, tmp_path_factory):
    """A finished report against a reference 4 mm above the bed, its run and its figures."""
    folder = tmp_path_factory.mktemp("report")
    bed = plane_bed(survey)
    facts = _facts(survey, bed, depth_maps=[plane_depth_map(survey, 1)], verdict=Verdict((MET,)), notes=("a note",))
    write_bed_las(folder / "cloud.las", StoredBed(bed, facts.points_crs, survey.frame.crs, "small", 0.05))
    reference = write_plane_mesh(folder / "reference.ply", survey, raised_m=RAISED_M)
    facts = replace(
        facts,
        comparison=compare_surfaces(folder / "cloud.las", reference, CompareOptions(bounds=survey.bounds)),
    )
    steps = []
    with RunDir(folder / "run") as run:
        figures = write_report(run.path, facts, lambda: steps.append(1))
    return SimpleNamespace(run=run, facts=facts, figures=figures, num_steps=len(steps))


# --- figures ------------------------------------------------------------------------------------------------


def test_the_figures_of_a_plane_are_those_of_its_geometry(report):
    cloud, bed = report.figures.cloud, report.facts.bed
    assert (cloud.points, cloud.points_wet + cloud.points_dry) == (len(bed), len(bed))
    # Wet where SLOPE * x < 0.3, i.e. 134 of 140 columns (-6.95 to 6.35 m).
    assert cloud.points_wet == 134 * 140
    # One point per SPACING_M squared; the 56 cells of 0.25 m along a side are covered whole.
    assert cloud.covered_area_m2 == pytest.approx((56 * 0.25) ** 2)
    assert cloud.density_per_m2 == pytest.approx(1.0 / SPACING_M**2)
    # Depths run evenly between the two ends.
    low, high = 0.3 - SLOPE * 6.35, 0.3 + SLOPE * 6.95
    assert cloud.depth_m.min == pytest.approx(low, abs=CURVATURE_M)
    assert cloud.depth_m.max == pytest.approx(high, abs=CURVATURE_M)
    assert cloud.depth_m.median == pytest.approx(0.5 * (low + high), abs=SLOPE * SPACING_M)
    # Evenly from 5 to 15 mm.
    assert cloud.std_m.median == pytest.approx(0.010, abs=1e-6)
    assert cloud.std_m.p95 == pytest.approx(0.0145, abs=1e-6)
    assert cloud.views_per_point == Spread(2.0, 4.0, pytest.approx(4.0), 6.0, 6.0)
    assert cloud.incidence_deg.max == pytest.approx(np.degrees(0.5), abs=1e-5)


@pytest.mark.parametrize(("field", "words"), [("solver", "the normal matrix"), ("off", "the views that agree")])
def test_the_picture_of_the_std_says_where_it_comes_from(survey, tmp_path, field, words):
    bed = plane_bed(survey, num=20)
    facts = replace(_facts(survey, bed), plan=replace(PLAN, field=field))
    low, high = bed.xyz[:, :2].min(axis=0), bed.xyz[:, :2].max(axis=0)
    picture = draw_std(tmp_path / "std.png", facts, PlanGrid.within(bed.xyz, low, high, 1.0))
    assert picture.title == "Standard deviation of the height"
    assert words in picture.caption


def test_survey_and_water_say_where_they_come_from(report):
    survey, water = report.figures.survey, report.figures.water
    assert survey.crs.code == "EPSG:25832+5778"
    assert (survey.views_used, survey.views_left_out) == (4, 0)
    assert survey.bounds == (589006, 5194730, 589019, 5194742)
    assert (water.level_m, water.refractive_index) == (2105.0, 1.333)
    assert water.refractive_index_from == "survey.toml"
    assert report.figures.total_s == pytest.approx(65.2)
    assert report.figures.versions == {"bathynerf": "0.1.0"}


def test_an_assumed_index_and_an_image_left_out_are_told(tmp_path):
    toml = TOML.replace("refractive_index = 1.333\n", "")
    folder = small_survey(tmp_path / "small", toml=toml)
    (folder / "images" / "9999.jpg").write_bytes((folder / "images" / "0000.jpg").read_bytes())
    survey = load_survey(folder)
    figures = figures_of(_facts(survey, plane_bed(survey, num=20)))
    assert re.match(r"assumed: refractive_index = 1\.33\d+, fresh water", figures.water.refractive_index_from)
    assert figures.survey.views_left_out == 1
    assert "9999.jpg" in figures.warnings[0]


def test_the_comparison_is_that_of_the_cloud_with_the_raised_plane(report):
    comparison = report.figures.comparison.summary
    # The distance to a plane is along its normal; the cloud lies below it.
    assert comparison.distances.mean_m == pytest.approx(-RAISED_M / np.hypot(1.0, SLOPE), abs=LAS_BIAS_M)
    assert comparison.distances.std_m == pytest.approx(LAS_STD_M, rel=0.1)
    assert comparison.distances.n_points + comparison.n_cropped == len(report.facts.bed)


def test_vertical_uncertainty_is_that_of_the_comparison(report):
    iho = report.figures.comparison.uncertainty.iho
    # The bed lies 4 mm under the reference everywhere, and LAS rounds to half a millimetre.
    assert iho.error_95_m == pytest.approx(RAISED_M, abs=0.6e-3)
    assert all(order.meets_tvu for order in iho.orders)


def test_the_card_claims_an_order_only_where_every_depth_meets_it(report):
    def card(errors, depth):
        uncertainty = replace(report.figures.comparison.uncertainty, iho=iho_s44(errors, depth))
        comparison = replace(report.figures.comparison, uncertainty=uncertainty)
        return next(c for c in cards(replace(report.figures, comparison=comparison)) if c.label.startswith("IHO"))

    depth, errors = np.repeat([1.5, 3.5], [2000, 38_000]), np.zeros(40_000)
    everywhere = "strictest order whose TVU is met at every depth"
    assert (card(errors, depth).value, card(errors, depth).detail) == ("Exclusive", everywhere)
    errors[:200] = 0.2
    found = card(errors, depth)
    assert found.value == "Special"
    assert (
        found.detail.replace("\N{NO-BREAK SPACE}", " ") == f"{everywhere}; at 1 to 2 m only 90.0 % are within Exclusive"
    )
    errors[:200] = 9.0
    assert card(errors, depth).value == "none"


def test_no_order_is_claimed_without_a_reference(survey):
    figures = figures_of(_facts(survey, plane_bed(survey, num=20)))
    assert figures.comparison is None
    assert json_of(figures)["iho_s44"] is None
    assert "IHO S-44" not in render_page(figures, [])


# --- files --------------------------------------------------------------------------------------------------


def test_report_json_holds_exactly_the_figures(report):
    assert json.loads(report.run.report_json_path.read_text(encoding="utf-8")) == json_of(report.figures)


def test_report_json_keeps_its_names(report):
    """Scripts read it by these names."""
    found = json_of(report.figures)
    assert {name: list(found[name]) for name in ("verdict", "survey", "water", "plan", "cloud", "baselines")} == {
        "verdict": ["passed", "gates"],
        "survey": [
            "name", "crs", "bounds", "views_used", "views_left_out", "image_size_px", "focal_px", "poses", "shutter",
            "local_frame_origin",
        ],
        "water": [
            "level_m", "level_at", "level_from", "slope_east", "slope_north", "slope_from", "refractive_index",
            "refractive_index_from", "light",
        ],
        "plan": ["quality", "device", "image_scale", "gsd_m", "height_m", "footprint_m", "decisions"],
        "cloud": [
            "points", "points_wet", "points_dry", "extent", "covered_area_m2", "density_per_m2", "depth_m", "std_m",
            "std_common_m", "views_per_point", "incidence_deg",
        ],
        "baselines": ["places", "views_per_place", "rows", "note"],
    }  # fmt: skip
    assert list(found) == [
        "verdict", "survey", "water", "plan", "cloud", "comparison", "iho_s44", "checkpoints", "adjustment",
        "baselines", "photographs", "timings_s", "versions", "settings", "assumptions", "warnings", "notes",
    ]  # fmt: skip
    assert list(found["verdict"]["gates"][0]) == ["name", "value", "limit", "unit", "passed", "sentence"]
    assert list(found["survey"]["crs"]) == ["name", "code", "unit", "height_unit"]
    assert list(found["plan"]["decisions"][0]) == ["name", "choice", "reason"]
    assert list(found["baselines"]["rows"][0]) == ["name", "kind", "median_m", "nmad_m", "mean_m"]
    cloud = found["cloud"]
    assert list(cloud["extent"]) == ["low", "high"]
    assert list(cloud["depth_m"]) == ["min", "median", "p95", "max"]
    assert list(cloud["std_m"]) == ["median", "p95"]
    assert list(cloud["views_per_point"]) == ["min", "median", "mean", "max"]
    assert list(cloud["incidence_deg"]) == ["median", "p95", "max"]
    assert found["iho_s44"] == found["comparison"]["iho_s44"]
    assert found["timings_s"] == {"sweep": 61.2, "bed": 4.0, "total": pytest.approx(65.2)}


def test_report_html_loads_nothing_and_runs_nothing(report):
    page = report.run.report_html_path.read_text(encoding="utf-8")
    assert "<script" not in page
    assert not re.search(r"""(src|href)=["'](?!data:|#)|url\(|@import|https?:""", page)
    assert page.count('src="data:image/png;base64,') == len(list(report.run.pictures_path.glob("*.png")))


def test_report_html_shows_the_figures_of_report_json(report):
    page = report.run.report_html_path.read_text(encoding="utf-8")
    cloud, distances = report.figures.cloud, report.figures.comparison.summary.distances
    for text in (
        "small &amp; &lt;shallow&gt;",
        "water of index 1.3330 &lt;here&gt;",
        "EPSG:25832+5778",
        "19\u202f600",
        f"{cloud.depth_m.median:.2f}\u00a0m",
        f"{1000 * cloud.std_m.median:.1f}\u00a0mm",
        f"{1000 * distances.mean_inner90_m:.1f}".replace("-", "−"),
        f"±\u00a0{1000 * distances.std_inner90_m:.1f}\u00a0mm",
        "87.5\u00a0%",
        "<td>sweep</td>",
        "61.2</td>",
        "meets the TVU",
        "a note",
        "quality = &#34;standard&#34;",
    ):
        assert text in page, text


def test_no_picture_is_wider_than_the_page(report):
    page = report.run.report_html_path.read_text(encoding="utf-8")
    rules = re.findall(r"[^{}]*img\s*{([^}]*)}", page.partition("</style>")[0])
    assert rules == [" width: 100%; height: auto; display: block; "]


def test_every_number_in_report_html_stays_with_its_unit(report):
    page = re.sub(r"<(style|pre)>.*?</\1>", "", report.run.report_html_path.read_text(encoding="utf-8"), flags=re.S)
    cards = re.findall(r"<div><span>.*?</div>", page)
    assert len(cards) == 8
    for card in cards:
        assert " " not in re.search("<b>(.*?)</b>", card).group(1)


def test_columns_of_lengths_have_one_unit():
    unit = LengthUnit.of([0.0123, None, np.nan, -0.0871])
    assert [unit.text(v) for v in (0.0123, -0.0871)] == ["12.3\u00a0mm", "−87.1\u00a0mm"]
    assert {unit.text(None), unit.text(np.nan), unit.number(np.nan)} == {"unknown"}
    assert LengthUnit.of([0.0123, 0.2]).text(0.0123) == "12\u00a0mm"
    assert LengthUnit.of([0.0123, 2.5]).text(0.0123) == "0.012\u00a0m"
    assert length(-1e-9) == "0.0\u00a0mm"


# --- verdict ------------------------------------------------------------------------------------------------


def test_a_failed_gate_is_in_the_verdict_and_among_the_warnings(survey):
    facts = _facts(survey, plane_bed(survey, num=20), verdict=Verdict((MET, MISSED)))
    figures = figures_of(facts)
    assert figures.warnings == (MISSED.sentence,)
    assert json_of(figures)["verdict"] == {"passed": False, "gates": [asdict(MET), asdict(MISSED)]}


def test_the_verdict_stands_on_top_in_words_and_colour(report):
    page = render_page(replace(report.figures, verdict=Verdict((MET, MISSED))), [])
    assert page.index('class="verdict failed"') < page.index('class="cards"') < page.index("<h2>Pictures</h2>")
    assert "<strong>Failed</strong> 1 of 2 quality gates is not met." in page
    assert MISSED.sentence in page


@pytest.mark.parametrize(
    ("verdict", "warnings", "colour"),
    [
        (None, (), "unjudged"),
        (Verdict((MET,)), (), "passed"),
        (Verdict((MET,)), ("poses are old",), "doubtful"),
        (Verdict((MET, MISSED)), (MISSED.sentence,), "failed"),
    ],
)
def test_the_colour_of_a_verdict_is_that_of_its_gates_and_warnings(verdict, warnings, colour):
    assert headline(verdict, warnings).colour == colour


# --- pictures -----------------------------------------------------------------------------------------------


def test_all_pictures_are_drawn_and_are_whole(report):
    paths = sorted(report.run.pictures_path.iterdir())
    errors = "error error_bands error_depth error_histogram"
    names = f"completeness depth {errors} histograms orthophoto plan profile std view views"
    assert [path.name for path in paths] == [f"{name}.png" for name in names.split()]
    # There is no adjustment, which has three.
    assert report.num_steps == len(paths) == NUM_STEPS - 3
    for path in paths:
        with Image.open(path) as image:
            assert np.asarray(image.convert("L")).std() > 5.0, path  # neither black nor white


@pytest.mark.parametrize("kind", ["dry", "empty", "one point", "strip in degrees", "tilted water"])
def test_every_kind_of_bed_gets_a_report(survey, dry_survey, tmp_path, kind):
    if kind == "dry":
        survey = dry_survey
    if kind == "strip in degrees":
        frame = LocalFrame(CRS("EPSG:4979"), (10.16, 46.89, 2105.0))
        survey = replace(survey, frame=frame, bounds=None)
    if kind == "tilted water":
        survey = replace(survey, water=replace(survey.water, slope_x=0.01, slope_y=-0.02))
    bed = plane_bed(survey, num=40)
    keep = {
        "empty": np.zeros(len(bed), bool),
        "one point": np.arange(len(bed)) == 7,
        "strip in degrees": np.abs(bed.xyz[:, 1]) < 0.06,
    }
    bed = bed[keep.get(kind, np.ones(len(bed), bool))]
    maps = [plane_depth_map(survey, 0)] if kind == "dry" else None
    with RunDir(tmp_path / "run") as run:
        figures = write_report(run.path, _facts(survey, bed, depth_maps=maps))
    assert figures.cloud.points == len(bed)
    assert (run.pictures_path / "plan.png").exists()
    assert (run.pictures_path / "depth.png").exists() == (len(bed) > 0)
    assert (run.pictures_path / "profile.png").exists() == (kind not in ("empty", "one point"))
    assert figures.verdict is None
    if kind == "dry":
        assert figures.water is None
        assert figures.cloud.depth_m is None
        assert "a dry survey" in run.report_html_path.read_text(encoding="utf-8")


# --- cells and light ----------------------------------------------------------------------------------------

UTM = CRS("EPSG:25832+5778")


def _grid_of(points, crs=UTM, cell_m=1.0) -> PlanGrid:
    return PlanGrid.over(np.asarray(points, dtype=np.float64), crs, cell_m=cell_m, max_cells=1000)


@pytest.fixture(scope="module")
def block():
    """20 by 10 m in UTM; each square metre has 10 by 10 points in its north-western 0.81 by 0.81 m."""
    along = (np.arange(20)[:, None] + 0.09 * np.arange(10)).ravel()
    e, n = np.meshgrid(589000.0 + along, 5194710.0 - along[:100])
    return np.column_stack([e.ravel(), n.ravel(), np.zeros(e.size)])


def test_cells_hold_the_mean_of_their_points_from_north_to_south(block):
    grid = _grid_of(block)
    assert grid.shape == (10, 20)
    np.testing.assert_array_equal(grid.count(), np.full(grid.shape, 100))
    north, east = grid.mean(block[:, 1]), grid.mean(block[:, 0])
    np.testing.assert_allclose(north, np.tile(5194709.595 - np.arange(10)[:, None], (1, 20)), atol=1e-6)
    np.testing.assert_allclose(east, np.tile(589000.405 + np.arange(20), (10, 1)), atol=1e-6)
    assert grid.extent == pytest.approx((589000.0, 589020.0, 5194700.0, 5194710.0))


def test_the_highest_point_of_a_cell_is_on_top(block):
    rng = np.random.default_rng(3)
    height = rng.permutation(len(block)).astype(np.float64)
    grid = _grid_of(block)
    expected = [height[grid.index == cell].max() for cell in range(200)]
    np.testing.assert_array_equal(grid.highest(height, height).ravel(), expected)


def test_values_that_are_nan_and_points_left_out_do_not_count(block):
    values = np.where(block[:, 0] < 589010.0, np.nan, 1.0)
    grid = _grid_of(block)
    mean = grid.mean(values, block[:, 1] <= 5194705.0)
    assert np.isnan(mean[:, :10]).all()
    assert np.isnan(mean[:5]).all()
    np.testing.assert_array_equal(mean[5:, 10:], 1.0)


def test_strays_do_not_shrink_the_picture(block):
    strays = np.array([[650000.0, 5194705.0, 0.0], [589010.0, 5100000.0, 0.0]])
    grid = _grid_of(np.vstack([block, strays]))
    # A twentieth more to the side where a stray lies, in each direction.
    assert grid.shape == (11, 21)
    np.testing.assert_array_equal(grid.index[-2:], -1)
    assert (grid.index[:-2] >= 0).all()


def test_cells_grow_where_points_are_few_or_the_area_is_large(block):
    few = block[np.random.default_rng(2).choice(len(block), 100, replace=False)]
    # Three points a cell; the outermost of 100 points leave 2 % of each side uncovered.
    assert _grid_of(few).cell_m == pytest.approx(np.sqrt(3.0 * 20.0 * 10.0 / 100), rel=0.05)
    fine = PlanGrid.over(block, UTM, cell_m=0.2, max_cells=50)
    assert max(fine.shape) == 50


def test_cells_in_degrees_are_square_on_the_ground():
    # 60 degrees north: a degree of longitude is half as long as one of latitude.
    lon, lat = np.meshgrid(np.linspace(10.0, 10.002, 150), np.linspace(60.0, 60.001, 150))
    grid = _grid_of(np.column_stack([lon.ravel(), lat.ravel(), lat.ravel()]), CRS("EPSG:4979"), 5.0)
    assert grid.cell[0] / grid.cell[1] == pytest.approx(2.0, rel=1e-3)
    assert grid.shape == (23, 23)  # 0.001 degree is 111.2 m


def test_only_single_holes_are_closed_by_the_mean_around_them():
    raster = np.arange(49.0).reshape(7, 7)
    raster[1, 1] = raster[4:7, 4:7] = np.nan
    closed = without_pinholes(raster)
    assert closed[1, 1] == pytest.approx(8.0)  # the mean around a cell of a plane is its own value
    assert np.isnan(closed[5, 5])
    np.testing.assert_array_equal(closed[:4, 2:], raster[:4, 2:])


def test_light_comes_from_the_north_west():
    row, column = np.mgrid[0:30, 0:30].astype(np.float64)
    inner = (slice(5, -5), slice(5, -5))
    level = hillshade(np.zeros((30, 30)), 0.1)
    facing = hillshade(0.02 * (row + column), 0.1)  # rises to the south-east
    averted = hillshade(-0.02 * (row + column), 0.1)
    across = hillshade(0.02 * (row - column), 0.1)
    np.testing.assert_allclose(level, 0.5)
    assert facing[inner].min() > 0.6
    assert averted[inner].max() < 0.2
    # Light strikes such a slope at 60 degrees, not at 45: cos 60 degrees = 0.5.
    np.testing.assert_allclose(across[inner], 0.5 + 0.6 * (0.5 - np.sqrt(0.5)), atol=1e-6)


def test_unknown_cells_stay_unlit():
    height = np.random.default_rng(1).normal(size=(30, 30))
    height[:, 15:] = np.nan
    np.testing.assert_array_equal(hillshade(height, 0.1)[:, 15:], 0.5)


# --- baselines ----------------------------------------------------------------------------------------------


def test_straight_rays_and_their_corrections_stand_beside_what_was_measured(report):
    """The bed is a plane of 0.05 to 0.65 m depth; every view sees it through index 1.333."""
    by_name = {row.name: row for row in report.figures.baselines.rows}
    straight, times_n, dietrich, measured = by_name.values()
    depth = report.figures.cloud.depth_m.median
    assert [row.kind for row in by_name.values()] == ["predicted"] * 3 + ["measured"]
    # At nadir a quarter of the depth; more where rays are slanted.
    assert 0.25 < straight.median_m / depth < 0.5
    assert abs(dietrich.median_m) < abs(times_n.median_m) < straight.median_m
    assert measured.mean_m == pytest.approx(-RAISED_M, abs=LAS_BIAS_M)
    page = report.run.report_html_path.read_text(encoding="utf-8")
    assert "per-camera correction (Dietrich)" in page


@pytest.mark.parametrize(("field", "named"), [("solver", "solver"), ("slab", "trained slab")])
def test_the_sweep_alone_has_a_row_beside_what_refined_it(report, field, named):
    wet = DistanceStatistics(n_points=1, n_nan=0, mean_m=0.1, median_m=0.2, nmad_m=0.3)
    sweep = SimpleNamespace(figures=SimpleNamespace(wet=wet))
    facts = replace(report.facts, sweep_comparison=sweep, plan=replace(PLAN, field=field))
    rows = figures_of(facts).baselines.rows
    assert [row.name for row in rows[3:]] == ["sweep alone", f"this run: sweep and {named}"]
    assert rows[3].median_m == 0.2
    assert figures_of(replace(report.facts, comparison=None)).baselines is None


# --- profile ------------------------------------------------------------------------------------------------


def test_the_cut_runs_down_the_slope_of_the_bed(survey):
    """The bed of the small survey falls to the west alone."""
    cut = choose_cut(_facts(survey, plane_bed(survey)))
    along, across = cut.along_and_across(cut.ends)
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    np.testing.assert_allclose(along, [0.0, cut.length_m], atol=1e-9)
    # From edge to edge, in one of twelve directions.
    assert abs(cut.direction[0]) * cut.length_m == pytest.approx(14.0, rel=0.1)


def test_the_cut_of_a_bed_with_a_pit_goes_through_it(survey):
    bed = plane_bed(survey)
    in_pit = np.hypot(bed.xyz[:, 0] - 3.0, bed.xyz[:, 1] + 4.0) < 1.5
    bed = replace(bed, depth=np.where(in_pit, 5.0, 0.3).astype(bed.depth.dtype))
    _, across = choose_cut(_facts(survey, bed)).along_and_across(np.array([[3.0, -4.0]]))
    assert abs(across[0]) < 1.5


def test_the_medians_of_a_profile_skip_gaps():
    x, y = _medians(np.array([0.1, 0.2, 0.3, 2.4, np.nan]), np.array([5.0, 7.0, 6.0, 1.0, np.nan]), 1.0)
    np.testing.assert_array_equal(x, [0.5, 1.5, 2.5])
    np.testing.assert_array_equal(y, [6.0, np.nan, 1.0])


def test_a_handful_of_points_gets_no_profile(survey):
    bed = plane_bed(survey)
    few = _facts(survey, bed[np.arange(len(bed)) % (len(bed) // 33) == 0])
    assert not has_profile(few, choose_cut(few))
    all_of_it = _facts(survey, bed)
    assert has_profile(all_of_it, choose_cut(all_of_it))


def test_a_profile_of_a_wet_survey_shows_the_level_even_over_a_dry_bed(survey, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(profile, "save", lambda figure, _path: drawn.append(figure.axes[0]))
    bed = plane_bed(survey)
    level = survey.config.water.level_m
    facts = _facts(survey, bed)
    raised = np.array([0.0, 0.0, level + 3.0 - facts.points_crs[:, 2].min()])
    facts = replace(facts, points_crs=facts.points_crs + raised)
    draw_profile(tmp_path / "profile.png", facts, choose_cut(facts))
    low, high = drawn[0].get_ylim()
    assert low < level < level + 3.0 < high
    assert "water" in drawn[0].get_legend_handles_labels()[1]


@pytest.mark.parametrize(("value", "text"), [(0.123, "0.12"), (1.0, "1"), (1.849, "1.8"), (18.4, "18"), (183.0, "180")])
def test_a_factor_has_two_digits_and_no_exponent(value, text):
    assert two_digits(value) == text
