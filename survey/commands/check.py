"""`bathynerf check`: prints the findings of `survey.plan.check`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from survey.commands.console import ConsoleResults, command
from survey.commands.faults import address_space_shortage, require_address_space
from survey.commands.options import Quiet, Verbose, grouped
from survey.errors import FILE_NAME, SurveyError
from survey.settings.tables import PlanOptions, ProcessConfig

if TYPE_CHECKING:
    from survey.plan.check import CheckSection

EXAMPLES = """
    bathynerf check my_survey
    bathynerf check my_survey --quality fine
    bathynerf check my_survey --target-std 0.02
    bathynerf check my_survey --deep --json found.json
    bathynerf check flight.toml --wind 5
"""


@grouped
def run(
    survey: Annotated[
        Path,
        typer.Argument(
            metavar="SURVEY|PLAN", help="Folder with images and survey.toml, or the TOML of a planned flight."
        ),
    ],
    asked: PlanOptions = PlanOptions(),
    deep: Annotated[
        bool, typer.Option("--deep", help="Also test survey.toml against the photographs; takes minutes.")
    ] = False,
    wind: Annotated[
        float, typer.Option(min=0.0, max=20.0, metavar="M/S", help="Wind over the water, for the glitter of the sun.")
    ] = 3.0,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="JSON file for all that is printed.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Report what a survey has, what it lacks, and what process would do; or predict a planned flight.

    Also predicts the accuracy of a bed under still, clear water, and the effect of light and motion. Nothing is
    written. With --deep, poses, lens and water are adjusted to the photographs, and contradictions with survey.toml are
    reported. Options that are not given come from [process] in survey.toml, as for process.

    Before the flight: a plan has place, camera, height, overlaps and oblique views, or a file of poses, and the time
    (docs/check.md, examples/flight.toml).
    """
    with command(verbose, quiet, json or survey, reads=survey) as results:
        from survey.files.json_values import write_json

        require_json("--json", json, survey)
        sections_of = _sections_of_plan if is_plan(survey) else _sections
        shown = []
        for section in sections_of(survey, ProcessConfig(**asdict(asked)), wind, deep):
            show(results, section)
            shown.append(section)
        if json is not None:
            write_json(json, {"checked": survey, "sections": [as_dict(section) for section in shown]})


def is_plan(path: Path) -> bool:
    """Whether a path names a planned flight."""
    return path.suffix.lower() == ".toml"


def _sections(folder: Path, asked: ProcessConfig, wind: float, deep: bool) -> Iterator[CheckSection]:
    """Sections on contents and gaps of a survey, its light, its expected accuracy, and what an aim takes."""
    from survey.adjust.result.foreseen import foreseen_section
    from survey.init.draft import draft
    from survey.init.options import InitOptions
    from survey.plan.check import CheckSection, check_survey, require_processable
    from survey.plan.check_light import light_section
    from survey.plan.choices import choices_of
    from survey.progress import current
    from survey.run.aim import AimedPlan, plan_for_aim
    from survey.settings.config import SurveyConfig, parse_config, settings_of

    shortage = address_space_shortage()
    if shortage is not None:
        current().warn(shortage)
    config = settings_of(folder)
    chosen = choices_of(asked.over((config or SurveyConfig()).process))
    if folder.is_dir() and config is None:
        text = draft(folder, InitOptions())
        lines = tuple(("", line) for line in text.split("\n") if line)
        yield CheckSection(f"No {FILE_NAME}; init and process write", lines)
        config = parse_config(text)
    checked = require_processable(folder, chosen, config)
    aimed = AimedPlan(chosen)
    if checked.survey is not None:
        aimed = plan_for_aim(checked.survey, chosen, refuses=False)
    chosen = aimed.chosen
    yield from check_survey(folder, chosen=chosen, checked=checked, aim=aimed.decision, chooses_workers=True)
    yield light_section(checked, wind_m_s=wind)
    foreseen = None if checked.survey is None else foreseen_section(checked.survey, chosen=chosen)
    if foreseen is not None:
        yield foreseen
    if aimed.rows:
        yield CheckSection("Aim", aimed.rows)
    if deep:
        require_address_space()
        from survey.adjust.pose_check import deep_check

        yield from deep_check(folder, device=chosen.device)


def _sections_of_plan(path: Path, asked: ProcessConfig, wind: float, deep: bool) -> Iterator[CheckSection]:
    """Sections on the expected accuracy of a planned flight, and on what an aim takes."""
    from survey.plan.choices import choices_of

    if deep:
        raise SurveyError("--deep tests a survey against its photographs, and a plan has none; remove it")
    if asked.image_scale is not None:
        raise SurveyError("--image-scale is for photographs that are there, and a plan has none; remove it")
    from survey.plan.check import CheckSection
    from survey.run.aim import plan_for_aim
    from survey.simulate.staging.check_plan import check_plan, depth_of, flight_of, survey_of

    plan = flight_of(path)
    aimed = plan_for_aim(survey_of(plan), choices_of(asked), refuses=False, depth_m=depth_of(plan))
    yield from check_plan(path, chosen=aimed.chosen, wind_m_s=wind)
    if aimed.rows:
        yield CheckSection("Aim", aimed.rows)


def show(results: ConsoleResults, section: CheckSection) -> None:
    """Print a section."""
    rows = [(f"  {label}" if label else "  -", text) for label, text in section.rows]
    results.columns(section.title, rows)


def as_dict(section: CheckSection) -> dict:
    """The section as ``--json`` holds it."""
    rows = [{"label": label, "text": text} for label, text in section.rows]
    return {"title": section.title, "rows": rows, **({} if section.numbers is None else {"numbers": section.numbers})}


def require_json(option: str, path: Path | None, survey: Path) -> None:
    """Raise OutputError where a JSON file cannot be written, or would overwrite an input."""
    if path is None:
        return
    from survey.files.outputs import ReadFiles, is_json, require_file
    from survey.folder.found import survey_inputs

    read = ReadFiles.of(survey) if is_plan(survey) else survey_inputs(survey)
    require_file(option, path, read, kind="a JSON file", is_of_kind=is_json)
