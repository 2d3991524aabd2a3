"""`bathynerf check`: prints the findings of `survey.plan.check`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from survey import machine
from survey.commands.console import Results, command
from survey.commands.memory import address_space_shortage, require_address_space
from survey.commands.options import AIM, HOW, ImageScale, Quiet, TargetStd, TimeBudget, Verbose, words_of
from survey.errors import SurveyError
from survey.plan.choices import Choices, Device, Quality

if TYPE_CHECKING:
    from survey.plan.aim import Aim
    from survey.plan.check import Section

EXAMPLES = """
    bathynerf check my_survey
    bathynerf check my_survey --quality fine
    bathynerf check my_survey --target-std 0.02
    bathynerf check my_survey --deep
    bathynerf check flight.toml --wind 5
"""


def run(
    survey: Annotated[
        Path,
        typer.Argument(
            metavar="SURVEY|PLAN", help="Folder with images and survey.toml, or the TOML of a planned flight."
        ),
    ],
    quality: Annotated[
        Quality, typer.Option(metavar=words_of(Quality), help="Plan for this quality.", rich_help_panel=AIM)
    ] = Quality.standard,
    device: Annotated[
        Device, typer.Option(metavar=words_of(Device), help="Plan for this device.", rich_help_panel=HOW)
    ] = Device.auto,
    image_scale: ImageScale = None,
    target_std: TargetStd = None,
    time_budget: TimeBudget = None,
    deep: Annotated[
        bool, typer.Option("--deep", help="Also hold survey.toml against the photographs; takes minutes.")
    ] = False,
    wind: Annotated[
        float, typer.Option(min=0.0, max=20.0, metavar="M/S", help="Wind over the water, for the glitter of the sun.")
    ] = 3.0,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Report what a survey has, what it lacks, and what process would do; or what a planned flight promises.

    Also what the flight promises for a bed under still, clear water, and what light and motion take from it. Nothing is
    written. With --deep poses, lens and water are adjusted to the photographs, and where these contradict survey.toml
    it says so.

    Before the flight: a plan has place, camera, height, overlaps and oblique views, or a file of poses, and the time
    (docs/check.md, examples/flight.toml).
    """
    with command(verbose, quiet, survey) as results:
        from survey.plan.aim import aim_of

        aim = aim_of(target_std, time_budget, quality=None, field="auto", scale=image_scale)
        if survey.suffix.lower() == ".toml":
            if deep:
                raise SurveyError("--deep holds a survey against its photographs, and a plan has none; remove it")
            if image_scale is not None:
                raise SurveyError("--image-scale is for photographs that are there, and a plan has none; remove it")
            _check_plan(results, survey, quality, device, wind)
            if aim is not None:
                _check_aim_of_plan(results, survey, device, aim)
            return
        chosen = Choices(quality=quality.value, device=device.value, image_scale=image_scale)
        _check_survey(results, survey, chosen, aim, wind)
        if deep:
            _check_deep(results, survey, device)


def _check_survey(results: Results, folder: Path, chosen: Choices, aim: Aim | None, wind: float) -> None:
    """What a survey has and lacks, its light, what it promises, and what an aim would cost."""
    from survey.adjust.foreseen_text import foreseen_section
    from survey.plan.check import Section, check_survey, require_processable
    from survey.plan.check_light import light_section
    from survey.progress import current

    shortage = address_space_shortage()
    if shortage is not None:
        current().warn(shortage)
    checked = require_processable(folder)
    load = None if aim is None else machine.load()
    slowness = None if load is None else load.slowness
    for section in check_survey(folder, chosen=chosen, checked=checked, slowness=slowness):
        show(results, section)
    show(results, light_section(checked, wind_m_s=wind))
    foreseen = None if checked.survey is None else foreseen_section(checked.survey, chosen=chosen)
    if foreseen is not None:
        show(results, foreseen)
    if aim is not None and load is not None and checked.survey is not None:
        from survey.run.beginning import rows_of

        show(results, Section("Asked", rows_of(aim, checked.survey, Choices(device=chosen.device), load)))


def _check_deep(results: Results, folder: Path, device: Device) -> None:
    """What the photographs say of poses, lens and water."""
    require_address_space()
    from survey.adjust.deep_check import deep_check

    for section in deep_check(folder, device=device.value):
        show(results, section)


def _check_plan(results: Results, path: Path, quality: Quality, device: Device, wind: float) -> None:
    from survey.simulate.staging.check_plan import check_plan

    for section in check_plan(path, quality=quality.value, device=device.value, wind_m_s=wind):
        show(results, section)


def _check_aim_of_plan(results: Results, path: Path, device: Device, aim: Aim) -> None:
    """What an aim promises and costs of a planned flight."""
    from survey.plan.check import Section
    from survey.run.beginning import rows_of
    from survey.simulate.staging.check_plan import depth_of, flight_of, survey_of

    plan = flight_of(path)
    rows = rows_of(aim, survey_of(plan), Choices(device=device.value), machine.load(), depth_of(plan))
    show(results, Section("Asked", rows))


def show(results: Results, section: Section) -> None:
    """Print a section."""
    rows = [(f"  {label}" if label else "  -", text) for label, text in section.rows]
    results.columns(section.title, rows)
