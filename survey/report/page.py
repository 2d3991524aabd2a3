"""report.html: the figures of a report as one page without further files, for screen and paper."""

from __future__ import annotations

import base64
from functools import cache
from pathlib import Path

import jinja2

from survey.compare.tables import comparison as comparison_blocks
from survey.compare.tables import iho_s44
from survey.display import palette
from survey.display.blocks import Block, Rows, Section, Sentences
from survey.display.quantities import LengthUnit, typeset
from survey.report import adjustment_tables, checkpoints, photographs, tables
from survey.report.figures import ReportFigures
from survey.report.headline import cards, coverage, headline, limitations, method
from survey.report.raster import Picture
from survey.settings.config import settings_text
from survey.words import Quality

# Headings of the pictures with the names of their files.
_GROUPS = (
    ("The bed", ("depth", "orthophoto", "profile")),
    ("Uncertainty and coverage", ("unseen", "views", "std", "histograms")),
    ("Comparison with the reference", ("error", "completeness", "error_histogram", "error_depth", "error_bands")),
    ("Residuals of the adjustment", ("parts", "control", "residuals_ground", "residuals_image", "correlation")),
    ("Waves", ("waves",)),
    ("Flight", ("view", "plan")),
)
# These show several things side by side and take the whole width.
_WIDE = ("view", "profile", "error_bands")


def render_page(figures: ReportFigures, pictures: list[Picture]) -> str:
    """The page, with the files of the pictures in it: HTML without scripts and without anything to load."""
    unit = LengthUnit.of_heights()
    kept = "tolerances, bands of depth and limits of S-44 are in metres, as they say"
    units = [] if unit.name == "m" else [("lengths", f"in feet of {1.0 / unit.per_metre:.10g} m; {kept}")]
    draft_command = figures.settings.get("command") if figures.plan.quality == Quality.draft else None
    return _template().render(
        palette=palette,
        survey=figures.survey,
        head=Rows([*photographs.taken_rows(figures.taken), *units]),
        verdict=headline(figures.verdict, figures.warnings, draft_command),
        cards=list(cards(figures)),
        num_warnings=len(figures.warnings),
        first_sections=[Section("Method", method(figures)), Section("Limitations", limitations(figures))],
        groups=_grouped(pictures),
        sections=[section for section in _sections(figures) if section.blocks],
        settings=settings_text(figures.settings),
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
    environment.filters["typeset"] = typeset
    return environment.get_template("page.html")


def _sections(figures: ReportFigures) -> list[Section]:
    """The parts of the page after the pictures, in their order; some may be empty."""
    comparison, survey = figures.comparison, figures.survey
    uncertainty = None if comparison is None else comparison.uncertainty
    return [
        Section("Coverage of the water", coverage(figures)),
        Section("Comparison with the reference", comparison_blocks(comparison)),
        Section("Waves", tables.waves(figures.waves)),
        Section("Check points", tables.checkpoints(figures.checkpoints)),
        Section("Vertical uncertainty (IHO S-44)", iho_s44(uncertainty)),
        Section("Stated uncertainty of the cloud", checkpoints.table(figures.stated)),
        Section("Adjustment", adjustment_tables.adjustment(figures.adjustment)),
        Section("Baselines: refraction ignored or approximated", tables.baselines(figures.baselines)),
        Section("Point cloud", tables.cloud(figures.cloud, survey.crs)),
        Section("Survey and water", tables.survey(survey, figures.water, figures.plan)),
        Section("Photographs", photographs.table(figures.photographs, figures.left_out)),
        Section("Processing decisions", tables.decisions(figures.plan.decisions)),
        Section("Assumptions", _listed(figures.assumptions)),
        Section("Warnings", _listed(figures.warnings)),
        Section("Run time", tables.timings(figures.timings_s, figures.total_s)),
        Section("Software versions", [Rows(list(figures.versions.items()))] if figures.versions else []),
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
