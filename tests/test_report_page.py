"""The files of a report: names that scripts read, and a page that needs nothing else and shows the same figures."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from small_report import MET, MISSED

from survey.display.quantities import LengthUnit, length
from survey.report.facts import RunVerdict
from survey.report.figures import json_of
from survey.report.page import render_page


def test_report_json_holds_exactly_the_figures(plane_report):
    assert json.loads(plane_report.run.report_json_path.read_text(encoding="utf-8")) == json_of(plane_report.figures)


def test_report_json_keeps_its_names(plane_report):
    """Scripts read it by these names."""
    found = json_of(plane_report.figures)
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
        "verdict", "survey", "taken", "water", "plan", "cloud", "comparison", "iho_s44", "checkpoints", "height_std_m",
        "stated", "coverage", "waves", "adjustment", "baselines", "photographs", "photographs_left_out", "timings_s",
        "versions", "settings", "assumptions", "warnings",
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
    assert heads[:3] == ["Method", "Limitations", "Pictures"]
    assert "bent by Snell&#39;s law" in page


def test_no_picture_is_wider_than_the_page(plane_report):
    page = plane_report.run.report_html_path.read_text(encoding="utf-8")
    rules = re.findall(r"[^{}]*img\s*{([^}]*)}", page.partition("</style>")[0])
    assert rules == [" width: 100%; height: auto; display: block; "]


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
    assert page.index('class="verdict failed"') < page.index('class="cards"') < page.index("<h2>Pictures</h2>")
    assert "<strong>Failed</strong> 1 of 2 quality gates is not met." in page
    assert MISSED.sentence in page
