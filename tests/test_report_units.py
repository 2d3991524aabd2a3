"""Feet in the report, the report as PDF, and what was seen of the water."""

import numpy as np
import pytest
from chromium import PROGRAM
from pyproj import CRS
from small_report import facts_of

from geo.errors import UnwritableFile
from geo.grid import Grid
from survey.display.quantities import (
    LengthUnit,
    area,
    density,
    distance,
    foot_m,
    height,
    length,
    lengths_in_feet,
    typeset,
    volume,
)
from survey.errors import ConfigError
from survey.export.pdf import print_page
from survey.report.figures import figures_of
from survey.report.page import render_page
from survey.report.seen_cells import SeenCells, coverage_of
from survey.settings.config import parse_config

FOOT = 0.3048
US_FOOT = 1200.0 / 3937.0


def test_lengths_are_feet_within_the_block_alone():
    with lengths_in_feet(FOOT):
        assert length(0.1 * FOOT) == "0.100\u00a0ft"
        assert height(12.0 * FOOT) == "12.00\u00a0ft"
        assert distance(70.0 * FOOT) == "70.0\u00a0ft"
        assert area(250.0 * FOOT**2) == "250\u00a0ft²"
        assert volume(250.0 * FOOT**3) == "250\u00a0ft³"
        assert density(20.0 / FOOT**2) == "20 per ft²"
        assert LengthUnit.of([20.0 * FOOT]).name == "ft"
    assert length(0.012) == "12.0\u00a0mm"


@pytest.mark.parametrize(
    ("units", "crs", "foot"),
    [
        (None, "EPSG:32632+5773", None),
        (None, "EPSG:2229+6360", US_FOOT),
        ("metres", "EPSG:2229+6360", None),
        ("feet", "EPSG:2229+6360", US_FOOT),
        ("feet", "EPSG:32632+5773", FOOT),
        (None, "EPSG:4979", None),
    ],
)
def test_feet_are_those_of_the_crs_unless_metres_are_asked_for(units, crs, foot):
    found = foot_m(units, CRS(crs))
    assert found == (foot if foot is None else pytest.approx(foot, rel=1e-12))


def test_other_units_are_refused():
    with pytest.raises(ConfigError, match="yards"):
        parse_config('[report]\nunits = "yards"')


def test_a_page_in_feet_has_the_figures_of_that_in_metres(plane_report):
    figures = plane_report.figures
    with lengths_in_feet(FOOT):
        page = render_page(figures, [])
    assert f"{figures['cloud']['depth_m']['median'] / FOOT:.2f}\u00a0ft" in page
    assert "in feet of 0.3048 m; tolerances, bands of depth and limits of S-44 are in metres" in page
    assert "true depth [ft]" in page
    assert "\u00a0mm" not in page.partition("Comparison with the reference")[0]


def test_water_and_what_hides_the_bed_add_up():
    depth = np.array([[2.0, 2.0, 3.0], [-1.0, 1.0, 1.0]])
    has_point = np.array([[True, False, True], [True, False, False]])
    views = np.array([[4, 3, 2], [5, 1, 0]])
    cells = SeenCells(Grid.northward_from(np.zeros(2), 0.5, depth.shape), has_point, views, np.zeros(depth.shape))
    found = coverage_of(cells, depth, 0.02)
    assert (found["ground_m2"], found["found_m2"], found["wet_m2"]) == (1.25, 0.75, 0.5)
    assert list(found["reasons_m2"].values()) == [0.25, 0.25]
    assert found["water_m3"] == 0.25 * 5.0
    assert found["water_std_m3"] == pytest.approx(0.01)
    assert coverage_of(cells, None, None).keys() == {"ground_m2", "found_m2", "reasons_m2"}


def test_limits_are_those_of_the_run(plane_report):
    survey, bed = plane_report.facts.survey, plane_report.facts.bed
    grid = Grid.northward_from(np.zeros(2), 10.0, (2, 2))
    cells = SeenCells(grid, np.eye(2, dtype=bool), np.full((2, 2), 3), np.zeros((2, 2)))
    coverage = coverage_of(cells, np.full((2, 2), 1.5), 0.03)
    figures = figures_of(facts_of(survey, bed)) | {"coverage": coverage}
    page = render_page(figures, [])
    assert "Nothing independent was measured with it" in page
    assert f"within {length(1.96 * figures['height_std_m'].whole)} of the truth in 95 of 100 cases" in page
    assert "300\u00a0m³ ± 6.0\u00a0m³" in page
    assert '>200\u00a0m²</td>\n<td class="number">50.0\u00a0%</td>' in page


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="no Chromium")
def test_the_report_as_pdf_is_whole(plane_report, tmp_path):
    html, path = tmp_path / "report.html", tmp_path / "report.pdf"
    html.write_text(render_page(plane_report.figures, []), encoding="utf-8")
    print_page(html, path)
    assert path.stat().st_size > 10_000


def test_without_a_browser_the_page_says_what_to_do(tmp_path):
    with pytest.raises(UnwritableFile, match="Chromium, Chrome or Edge"):
        print_page(tmp_path / "report.html", tmp_path / "report.pdf", browsers=(str(tmp_path / "none"),))
    broken = tmp_path / "chromium"
    broken.write_text("#!/bin/sh\necho no display >&2\nexit 1\n")
    broken.chmod(0o755)
    with pytest.raises(UnwritableFile, match="no display"):
        print_page(tmp_path / "report.html", tmp_path / "report.pdf", browsers=(str(broken),))


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("level_m found: -0.06 +- 0.01 m", "level_m found: −0.06 ± 0.01 m"),
        ("-9.2 to -0.1 m; 2026-11-29, IMG-12.jpg, UTC-5", "−9.2 to −0.1 m; 2026-11-29, IMG-12.jpg, UTC-5"),
    ],
)
def test_a_minus_of_a_page_is_no_hyphen(text, shown):
    assert typeset(text) == shown
