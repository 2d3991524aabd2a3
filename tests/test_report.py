"""The figures of a report, their sources, and the files that hold them, which need nothing else."""

import json
import re
from dataclasses import asdict, replace

import numpy as np
import pytest
from small_bed import SLOPE, SPACING_M, plane_bed
from small_report import CURVATURE_M, LAS_BIAS_M, LAS_STD_M, MET, MISSED, RAISED_M, facts_of
from small_survey import TOML, small_survey

from evaluation import iho_s44
from survey.display.quantities import LengthUnit, length
from survey.folder.survey import load_survey
from survey.report.facts import RunVerdict, dry_warnings
from survey.report.figures import figures_of, json_of
from survey.report.page import cards, headline, render_page


def test_the_figures_of_a_plane_are_those_of_its_geometry(plane_report):
    cloud, bed = plane_report.figures["cloud"], plane_report.facts.bed
    assert (cloud["points"], cloud["points_wet"] + cloud["points_dry"]) == (len(bed), len(bed))
    # Wet where SLOPE * x < 0.3, i.e. 134 of 140 columns (-6.95 to 6.35 m).
    assert cloud["points_wet"] == 134 * 140
    # One point per SPACING_M squared; the 56 cells of 0.25 m along a side are covered whole.
    assert cloud["covered_area_m2"] == pytest.approx((56 * 0.25) ** 2)
    assert cloud["density_per_m2"] == pytest.approx(1.0 / SPACING_M**2)
    # Depths run evenly between the two ends.
    low, high = 0.3 - SLOPE * 6.35, 0.3 + SLOPE * 6.95
    assert cloud["depth_m"]["min"] == pytest.approx(low, abs=CURVATURE_M)
    assert cloud["depth_m"]["max"] == pytest.approx(high, abs=CURVATURE_M)
    assert cloud["depth_m"]["median"] == pytest.approx(0.5 * (low + high), abs=SLOPE * SPACING_M)
    # Evenly from 5 to 15 mm.
    assert cloud["std_m"]["median"] == pytest.approx(0.010, abs=1e-6)
    assert cloud["std_m"]["p95"] == pytest.approx(0.0145, abs=1e-6)
    assert list(cloud["views_per_point"].values()) == [2.0, 4.0, pytest.approx(4.0), 6.0]
    assert cloud["incidence_deg"]["max"] == pytest.approx(np.degrees(0.5), abs=1e-5)


def test_a_bed_that_lies_above_the_water_all_over_is_a_warning(shallow_survey):
    (warning,) = figures_of(facts_of(shallow_survey, plane_bed(shallow_survey, num=20, depth_m=-4.0)))["warnings"]
    # The lowest of 20 columns, SPACING_M apart.
    assert (
        f"above the water, whose level is 2105.00\u00a0m: the lowest point by {4.0 - 9.5 * SPACING_M * SLOPE:.2f}"
        in (warning)
    )
    assert "vertical datum" in warning
    assert figures_of(facts_of(shallow_survey, plane_bed(shallow_survey, num=20)))["warnings"] == []
    water = replace(shallow_survey.config, water=None)
    dry = replace(shallow_survey, water=None, config=water)
    assert dry_warnings(dry, plane_bed(dry, num=20)) == []


def test_survey_and_water_say_where_they_come_from(plane_report):
    survey, water = plane_report.figures["survey"], plane_report.figures["water"]
    assert survey["crs"]["code"] == "EPSG:25832+5778"
    assert (survey["views_used"], survey["views_left_out"]) == (4, 0)
    assert survey["bounds"] == (589006, 5194730, 589019, 5194742)
    assert (water["level_m"], water["refractive_index"]) == (2105.0, 1.333)
    assert water["refractive_index_from"] == "survey.toml"
    assert plane_report.figures["timings_s"]["total"] == pytest.approx(65.2)
    assert plane_report.figures["versions"] == {"bathynerf": "0.1.0"}


def test_an_assumed_index_and_an_image_left_out_are_told(tmp_path):
    toml = TOML.replace("refractive_index = 1.333\n", "")
    folder = small_survey(tmp_path / "small", toml=toml)
    (folder / "images" / "9999.jpg").write_bytes((folder / "images" / "0000.jpg").read_bytes())
    survey = load_survey(folder)
    figures = figures_of(facts_of(survey, plane_bed(survey, num=20)))
    assert re.match(r"assumed: refractive_index = 1\.33\d+, fresh water", figures["water"]["refractive_index_from"])
    assert figures["survey"]["views_left_out"] == 1
    assert "9999.jpg" in figures["warnings"][0]


def test_the_comparison_is_that_of_the_cloud_with_the_raised_plane(plane_report):
    comparison = plane_report.figures["comparison"]
    # The distance to a plane is along its normal; the cloud lies below it.
    assert comparison.distances.mean_m == pytest.approx(-RAISED_M / np.hypot(1.0, SLOPE), abs=LAS_BIAS_M)
    assert comparison.distances.std_m == pytest.approx(LAS_STD_M, rel=0.1)
    assert comparison.distances.n_points + comparison.n_cropped == len(plane_report.facts.bed)


def test_vertical_uncertainty_is_that_of_the_comparison(plane_report):
    iho = plane_report.figures["comparison"].uncertainty.iho
    # The bed lies 4 mm under the reference everywhere, and LAS rounds to half a millimetre.
    assert iho.error_95_m == pytest.approx(RAISED_M, abs=0.6e-3)
    assert all(order.meets_tvu for order in iho.orders)


def test_the_card_claims_an_order_only_where_every_depth_meets_it(plane_report):
    def card(errors, depth):
        comparison = plane_report.figures["comparison"]
        uncertainty = replace(comparison.uncertainty, iho=iho_s44(errors, depth))
        figures = plane_report.figures | {"comparison": replace(comparison, uncertainty=uncertainty)}
        return next(card for card in cards(figures) if card.label.startswith("IHO"))

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


def test_without_a_reference_orders_are_said_to_be_stated_alone(shallow_survey):
    figures = figures_of(facts_of(shallow_survey, plane_bed(shallow_survey, num=20)))
    assert figures["comparison"] is None
    assert json_of(figures)["iho_s44"] is None
    page = render_page(figures, [])
    assert "Vertical uncertainty (IHO S-44)" not in page
    assert "IHO S-44, vertical, stated" in page
    assert "nothing is compared" in page


def test_a_failed_gate_is_in_the_verdict_and_among_the_warnings(shallow_survey):
    facts = facts_of(shallow_survey, plane_bed(shallow_survey, num=20), verdict=RunVerdict((MET, MISSED)))
    figures = figures_of(facts)
    assert figures["warnings"] == [MISSED.sentence]
    assert json_of(figures)["verdict"] == {"passed": False, "gates": [asdict(MET), asdict(MISSED)]}


@pytest.mark.parametrize(
    ("verdict", "warnings", "colour"),
    [
        (None, (), "unjudged"),
        (RunVerdict((MET,)), (), "passed"),
        (RunVerdict((MET,)), ("poses are old",), "doubtful"),
        (RunVerdict((MET, MISSED)), (MISSED.sentence,), "failed"),
    ],
)
def test_the_colour_of_a_verdict_is_that_of_its_gates_and_warnings(verdict, warnings, colour):
    assert headline(verdict, warnings).colour == colour


def test_a_draft_is_for_a_first_look_and_says_what_makes_a_cloud_for_use():
    verdict = RunVerdict((MET, MISSED))
    found = headline(verdict, (), "bathynerf process s --quality draft")
    assert (found.colour, found.word) == ("doubtful", "Draft")
    assert "1 of 2 quality gates is not met. bathynerf process s --quality standard makes one." in found.sentence
    assert "o not use" not in found.sentence


def test_report_json_holds_exactly_the_figures(plane_report):
    assert json.loads(plane_report.run.report_json_path.read_text(encoding="utf-8")) == json_of(plane_report.figures)


def test_report_json_keeps_its_names(plane_report):
    """Scripts read it by these names."""
    found = json_of(plane_report.figures)
    assert {name: list(found[name]) for name in ("verdict", "survey", "water", "plan", "cloud")} == {
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
    }  # fmt: skip
    assert list(found) == [
        "verdict", "survey", "taken", "water", "plan", "cloud", "comparison", "iho_s44", "checkpoints", "height_std_m",
        "stated", "coverage", "waves", "adjustment", "photographs", "photographs_left_out",
        "timings_s", "versions", "settings", "assumptions", "warnings",
    ]  # fmt: skip
    assert list(found["verdict"]["gates"][0]) == ["name", "value", "limit", "unit", "passed", "sentence"]
    assert list(found["survey"]["crs"]) == ["name", "code", "unit", "height_unit"]
    assert list(found["plan"]["decisions"][0]) == ["name", "choice", "reason"]
    cloud = found["cloud"]
    assert list(cloud["extent"]) == ["low", "high"]
    assert list(cloud["depth_m"]) == ["min", "median", "p95", "max"]
    assert list(cloud["std_m"]) == ["median", "p95"]
    assert list(cloud["views_per_point"]) == ["min", "median", "mean", "max"]
    assert list(cloud["incidence_deg"]) == ["median", "p95", "max"]
    assert found["iho_s44"] == found["comparison"]["iho_s44"]
    assert found["timings_s"] == {"sweep": 61.2, "bed": 4.0, "total": pytest.approx(65.2)}


def test_report_html_loads_nothing_and_runs_nothing(plane_report):
    page = plane_report.run.report_html_path.read_text(encoding="utf-8")
    assert "<script" not in page
    assert not re.search(r"""(src|href)=["'](?!data:|#)|url\(|@import|https?:""", page)
    assert page.count('src="data:image/png;base64,') == len(list(plane_report.run.pictures_path.glob("*.png")))


def test_report_html_shows_the_figures_of_report_json(plane_report):
    page = plane_report.run.report_html_path.read_text(encoding="utf-8")
    cloud, distances = plane_report.figures["cloud"], plane_report.figures["comparison"].distances
    for text in (
        "small &amp; &lt;shallow&gt;",
        "water of index 1.3330 &lt;here&gt;",
        "EPSG:25832+5778",
        "19\u202f600",
        f"{cloud['depth_m']['median']:.2f}\u00a0m",
        f"{1000 * cloud['std_m']['median']:.1f}\u00a0mm",
        f"{1000 * distances.mean_inner90_m:.1f}".replace("-", "−"),
        f"±\u00a0{1000 * distances.std_inner90_m:.1f}\u00a0mm",
        "<td>sweep</td>",
        "1 min 01 s</td>",
        "meets the TVU",
        "a doubt of the plan",
        "quality = &#34;standard&#34;",
    ):
        assert text in page, text


def test_method_and_limitations_come_before_the_pictures(plane_report):
    page = plane_report.run.report_html_path.read_text(encoding="utf-8")
    heads = re.findall(r"<h2>(.*?)</h2>", page)
    assert heads[:3] == ["Method", "Limitations", "The bed"]
    assert "bent by Snell&#39;s law" in page


def test_no_picture_is_wider_than_the_page(plane_report):
    page = plane_report.run.report_html_path.read_text(encoding="utf-8")
    rules = re.findall(r"[^{}]*img\s*{([^}]*)}", page.partition("</style>")[0])
    assert rules == [
        " width: 100%; height: auto; display: block; ",
        " max-height: 76mm; width: auto; max-width: 100%; ",
    ]


def test_every_number_in_report_html_stays_with_its_unit(plane_report):
    page = re.sub(
        r"<(style|pre)>.*?</\1>", "", plane_report.run.report_html_path.read_text(encoding="utf-8"), flags=re.S
    )
    cards = re.findall(r"<div><span>.*?</div>", page)
    assert len(cards) == 7
    for card in cards:
        assert " " not in re.search("<b>(.*?)</b>", card).group(1)


def test_columns_of_lengths_have_one_unit():
    unit = LengthUnit.of([0.0123, None, np.nan, -0.0871])
    assert [unit.text(v) for v in (0.0123, -0.0871)] == ["12.3\u00a0mm", "−87.1\u00a0mm"]
    assert {unit.text(None), unit.text(np.nan), unit.number(np.nan)} == {"unknown"}
    assert LengthUnit.of([0.0123, 0.2]).text(0.0123) == "12\u00a0mm"
    assert LengthUnit.of([0.0123, 2.5]).text(0.0123) == "0.012\u00a0m"
    assert length(-1e-9) == "0.0\u00a0mm"


def test_the_verdict_stands_on_top_in_words_and_colour(plane_report):
    page = render_page(plane_report.figures | {"verdict": RunVerdict((MET, MISSED))}, [])
    assert page.index('class="verdict failed"') < page.index('class="cards"') < page.index("<h2>Point cloud</h2>")
    assert "<strong>Failed</strong> 1 of 2 quality gates is not met." in page
    assert MISSED.sentence in page
