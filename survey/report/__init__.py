"""The report of a run: one set of figures, for machines as report.json and for people as report.html."""

from __future__ import annotations

import json
from collections.abc import Callable

from survey.report.facts import ReportFacts, figures_of
from survey.report.page import render_page
from survey.report.pictures import draw_pictures
from survey.run.folder import RunDir

__all__ = ["NUM_STEPS", "ReportFacts", "write_report"]

# How often `write_report` calls back, at most: once for each picture.
NUM_STEPS = 13


def write_report(run: RunDir, facts: ReportFacts, advance: Callable[[], None] = lambda: None) -> dict:
    """Write pictures, report.json and report.html of a run; each file is written whole or not at all.

    Parameters
    ----------
    run : RunDir
    facts : ReportFacts
    advance : callable
        Called after each picture.

    Returns
    -------
    dict
        The figures, as report.json has them.

    Raises
    ------
    SurveyError, GeoError
        If a file cannot be written, or the photograph that is shown cannot be read.
    """
    figures = figures_of(facts)
    pictures = draw_pictures(run.pictures_path, facts, advance)
    page = render_page(figures, pictures)
    run.write_text(run.report_json_path, json.dumps(figures, indent=2, ensure_ascii=False, allow_nan=False))
    run.write_text(run.report_html_path, page)
    return figures
