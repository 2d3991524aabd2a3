"""report.html: the figures of a report as one page that needs nothing else, for screen and paper."""

from __future__ import annotations

import base64
from functools import cache
from pathlib import Path

import jinja2

from survey.display import palette
from survey.display.quantities import LengthUnit
from survey.report import adjustment_tables, checkpoints, photographs, tables
from survey.report.blocks import Block, Rows, Section, Sentences
from survey.report.figures import ReportFigures
from survey.report.headline import cards, headline, limits, seen
from survey.report.raster import Picture

# Headings of the pictures with the names of their files.
_GROUPS = (
    ("The bed", ("depth", "orthophoto", "profile")),
    ("How sure it is", ("unseen", "views", "std", "histograms")),
    ("Against the reference", ("error", "completeness", "error_histogram", "error_depth", "error_bands")),
    ("What the adjustment left", ("parts", "control", "residuals_ground", "residuals_image", "correlation")),
    ("The flight", ("view", "plan")),
)
# These show several things side by side and take the whole width.
_WIDE = ("view", "profile", "error_bands")


def render_page(figures: ReportFigures, pictures: list[Picture]) -> str:
    """The page.

    Parameters
    ----------
    pictures : list of Picture
        Their files are put into the page.

    Returns
    -------
    str
        HTML without scripts and without anything to load.
    """
    return _template().render(
        palette=palette,
        survey=figures.survey,
        head_lines=[*photographs.head_lines(figures.taken), *_unit_line()],
        verdict=headline(figures.verdict, figures.warnings),
        cards=cards(figures),
        num_warnings=len(figures.warnings),
        groups=_grouped(pictures),
        sections=[section for section in _sections(figures) if section.blocks],
        settings=tables.settings(figures.settings),
        version=figures.versions.get("bathynerf", ""),
    )


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("survey.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html")


def _sections(figures: ReportFigures) -> list[Section]:
    """The parts of the page after the pictures, in their order; some may be empty."""
    comparison, survey = figures.comparison, figures.survey
    uncertainty = None if comparison is None else comparison.uncertainty
    return [
        Section("Limits", limits(figures)),
        Section("What was seen of the water", seen(figures)),
        Section("Against the reference", tables.comparison(comparison)),
        Section("At the check points", tables.checkpoints(figures.checkpoints)),
        Section("Vertical uncertainty (IHO S-44)", tables.iho_s44(uncertainty)),
        Section("Uncertainty as the cloud states it", checkpoints.table(figures.stated)),
        Section("Adjustment", adjustment_tables.adjustment(figures.adjustment)),
        Section("What refraction would cost if ignored", tables.baselines(figures.baselines)),
        Section("The cloud", tables.cloud(figures.cloud, survey.crs)),
        Section("Who, when, with what", photographs.taken_table(figures.taken)),
        Section("Survey and water", tables.survey(survey, figures.water, figures.plan)),
        Section("Photographs", photographs.table(figures.photographs, figures.left_out)),
        Section("What was done, and why", tables.decisions(figures.plan.decisions)),
        Section("Assumptions", _listed(figures.assumptions)),
        Section("Warnings", _listed(figures.warnings)),
        Section("Notes", _listed(figures.notes)),
        Section("Time", tables.timings(figures.timings_s, figures.total_s)),
        Section("Versions", [Rows(list(figures.versions.items()))] if figures.versions else []),
    ]


def _unit_line() -> list[str]:
    unit = LengthUnit.of_heights()
    if unit.name == "m":
        return []
    return [
        f"Lengths are in feet of {1.0 / unit.per_metre:.10g} m; tolerances, bands of depth and limits of S-44 are in "
        "metres, as they say."
    ]


def _listed(sentences: tuple[str, ...]) -> list[Block]:
    return [Sentences(sentences)] if sentences else []


def _grouped(pictures: list[Picture]) -> list[tuple[str, list[dict]]]:
    """Headings with their pictures, each with its file as text."""
    by_name = {picture.path.stem: picture for picture in pictures}
    unknown = sorted(by_name.keys() - {name for _, names in _GROUPS for name in names})
    if unknown:
        raise ValueError(f"the pictures {', '.join(unknown)} have no place in the report")
    groups = []
    for heading, names in _GROUPS:
        shown = [
            {
                "title": by_name[name].title,
                "caption": by_name[name].caption,
                "data": _base64(by_name[name].path),
                "is_wide": name in _WIDE,
            }
            for name in names
            if name in by_name
        ]
        if shown:
            groups.append((heading, shown))
    return groups


def _base64(file: Path) -> str:
    return base64.b64encode(file.read_bytes()).decode()
