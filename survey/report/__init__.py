"""The report of a run: one set of figures, for machines as report.json and for people as report.html."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from geo.files import write_text
from survey.files.json_values import write_json
from survey.report.facts import ReportFacts
from survey.report.figures import ReportFigures, figures_of, json_of
from survey.report.page import render_page
from survey.report.pictures import draw_pictures

__all__ = ["NUM_STEPS", "ReportFacts", "write_report"]

# How often `write_report` calls back, at most: once for each picture.
NUM_STEPS = 19


def write_report(folder: Path, facts: ReportFacts, advance: Callable[[], None] = lambda: None) -> ReportFigures:
    """Write pictures/, report.json and report.html into the folder of a run; each file is written whole or not at all.

    `advance` is called after each picture. Returns what the page and report.json show.
    """
    (folder / "pictures").mkdir(exist_ok=True)
    figures = figures_of(facts)
    pictures = []
    for picture in draw_pictures(folder / "pictures", facts):
        pictures.append(picture)
        advance()
    page = render_page(figures, pictures)
    write_json(folder / "report.json", json_of(figures))
    write_text(folder / "report.html", page)
    return figures
