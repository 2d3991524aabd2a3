"""The table of photographs: which are used, which not, and why."""

from __future__ import annotations

from dataclasses import replace

from small_bed import plane_bed
from small_report import facts_of
from small_survey import write_image

from survey.display.blocks import Folded
from survey.report.figures import figures_of, json_of
from survey.report.page import render_page
from survey.report.photographs import PhotographFigures, table

GOOD = PhotographFigures("b.jpg", 0.01, 0.05)


def test_every_photograph_is_listed_with_its_use():
    photographs = (
        GOOD,
        PhotographFigures("a.jpg", 0.7, None),
        PhotographFigures("d.jpg", 0.0, 0.9, "blurred, or without texture"),
    )
    folded = table(photographs, ["c.jpg"])[-1]
    assert isinstance(folded, Folded)
    assert folded.summary == "All 4 photographs, 1 of them left out"
    assert folded.is_open
    assert [row[:2] for row in folded.table.rows] == [
        ("a.jpg", "little of it: more than half white"),
        ("b.jpg", "yes"),
        ("c.jpg", "left out: no pose"),
        ("d.jpg", "nothing of it: blurred, or without texture"),
    ]


def test_many_photographs_open_on_a_click_and_none_have_no_table():
    many = tuple(replace(GOOD, name=f"{i:03}.jpg") for i in range(100))
    assert not table(many)[-1].is_open
    assert table(()) == []


def test_photographs_without_a_pose_are_named_in_page_and_json(shallow_survey):
    write_image(shallow_survey.folder / "images" / "9999 & more.jpg")
    try:
        figures = figures_of(facts_of(shallow_survey, plane_bed(shallow_survey, num=20), photographs=(GOOD,)))
    finally:
        (shallow_survey.folder / "images" / "9999 & more.jpg").unlink()
    assert json_of(figures)["photographs_left_out"] == ["9999 & more.jpg"]
    assert figures["survey"]["views_left_out"] == 1
    page = render_page(figures, [])
    assert "<details open>" in page
    assert "9999 &amp; more.jpg" in page
