"""The verbs before a run: init, check, mark and simulate."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from survey.commands.console import KEPT, Quiet, SurveyFolder, Verbose, asking, command, verb
from survey.errors import FILE_NAME, SurveyError
from survey.settings.tables import InitOptions, PlanOptions, ProcessConfig

if TYPE_CHECKING:
    from survey.plan.check import CheckSection


@verb("""
    bathynerf init my_survey
    bathynerf init my_survey --level 12.34
    bathynerf init my_survey --crs EPSG:25832+7837 --schema
""")
def init(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder with photographs, in images/, DCIM/ or itself.")
    ],
    told: InitOptions = InitOptions(),
    schema: Annotated[
        bool, typer.Option("--schema", help="Also write survey.schema.json, so that editors complete and check keys.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace survey.toml.")] = False,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Write survey.toml from what a folder of photographs holds.

    Photographs, poses, control and water levels are found by their names; values that are uncertain get a comment. On a
    terminal it asks for what no file states. process does the same where there is no survey.toml.
    """
    with command(verbose, quiet, folder, reads=folder) as results:
        from survey.init.draft import SCHEMA_LINE, write_schema, write_settings
        from survey.progress import current

        options, toml = asking(told, needs_level=False), folder / FILE_NAME
        if schema:
            results.line(write_schema(folder))
            if toml.exists() and not force:
                current().note(f"{toml} is kept; editors find the schema by {SCHEMA_LINE.strip()} in its first line")
                return
        results.settings(write_settings(folder, options, force=force, names_schema=schema))


@verb("""
    bathynerf check my_survey
    bathynerf check my_survey --quality fine
    bathynerf check my_survey --target-std 0.02
    bathynerf check my_survey --deep --json found.json
    bathynerf check flight.toml --wind 5
""")
def check(
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
        from survey.files.paths import ReadFiles, is_json, require_file
        from survey.folder.found import survey_inputs

        is_plan = survey.suffix.lower() == ".toml"
        if json is not None:
            read = ReadFiles.of(survey) if is_plan else survey_inputs(survey)
            require_file("--json", json, read, kind="a JSON file", is_of_kind=is_json)
        shown = []
        for section in (_of_plan if is_plan else _of_survey)(survey, ProcessConfig(**asdict(asked)), wind, deep):
            results.columns(section.title, [(f"  {label or '-'}", text) for label, text in section.rows])
            numbers = {} if section.numbers is None else {"numbers": section.numbers}
            rows = [{"label": label, "text": text} for label, text in section.rows]
            shown.append({"title": section.title, "rows": rows, **numbers})
        if json is not None:
            write_json(json, {"checked": survey, "sections": shown})


def _of_survey(folder: Path, asked: ProcessConfig, wind: float, deep: bool) -> Iterator[CheckSection]:
    """Sections on contents and gaps of a survey, its light, its expected accuracy, and what an aim takes."""
    from survey.adjust.result.foreseen import foreseen_section
    from survey.init.draft import draft
    from survey.plan.check import CheckSection, check_survey, require_processable
    from survey.plan.choices import choices_of
    from survey.plan.light import light_section
    from survey.run.aim import AimedPlan, plan_for_aim
    from survey.settings.config import SurveyConfig, parse_config, settings_of

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
        from survey.adjust.pose_check import deep_check

        yield from deep_check(folder, device=chosen.device)


def _of_plan(path: Path, asked: ProcessConfig, wind: float, deep: bool) -> Iterator[CheckSection]:
    """Sections on the expected accuracy of a planned flight, and on what an aim takes."""
    from survey.plan.check import CheckSection
    from survey.plan.choices import choices_of
    from survey.run.aim import plan_for_aim
    from survey.simulate.check_plan import check_plan, depth_of, flight_of, survey_of

    if deep:
        raise SurveyError("--deep tests a survey against its photographs, and a plan has none; remove it")
    if asked.image_scale is not None:
        raise SurveyError("--image-scale is for photographs that are there, and a plan has none; remove it")
    plan = flight_of(path)
    aimed = plan_for_aim(survey_of(plan), choices_of(asked), refuses=False, depth_m=depth_of(plan))
    yield from check_plan(path, chosen=aimed.chosen, wind_m_s=wind)
    if aimed.rows:
        yield CheckSection("Aim", aimed.rows)


@verb("""
    bathynerf mark my_survey
    bathynerf mark my_survey --points gcps.csv
    bathynerf mark my_survey --port 8765 --no-browser
""")
def mark(
    survey: SurveyFolder,
    points: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Control points, in addition to those in survey.toml.")
    ] = None,
    poses_of: Annotated[
        Path | None, typer.Option("--run", metavar="RUN", help="Predict positions by the poses of this run.")
    ] = None,
    host: Annotated[str, typer.Option(metavar="NAME", help="Where to listen.")] = "localhost",
    port: Annotated[
        int, typer.Option(min=0, max=65535, metavar="PORT", show_default=False, help="Default: any free port.")
    ] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Mark control points and the waterline in the photographs, in a browser.

    Every click is saved in gcp_list.txt or clicks.csv of the survey. Ctrl-C ends the server.
    """
    with command(verbose, quiet, survey, reads=survey) as results:
        from survey.folder.found import require_survey_folder
        from survey.marking.server import MarkingServer
        from survey.marking.session import MarkingSession

        require_survey_folder(survey)
        try:
            server = MarkingServer(None, host, port)
        except OSError as error:
            raise SurveyError(
                f"cannot listen at {host}, port {port} ({error.strerror}); name another --port or --host"
            ) from error
        with server:
            results.line(server.url)
            # Without a window to open the system may start a browser in the terminal.
            shown = [os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")]
            if not no_browser and (sys.platform in ("darwin", "win32") or any(shown)):
                webbrowser.open(server.url)
            (thread := threading.Thread(target=server.serve_forever, daemon=True)).start()
            try:
                server.show(session := MarkingSession(survey, run=poses_of, points=points))
                with suppress(KeyboardInterrupt):
                    # Windows sees Ctrl-C between waits only.
                    while thread.is_alive():
                        thread.join(0.5)
            finally:
                server.shutdown()
        for path in (session.store.control_path, session.store.clicks_path):
            if path.is_file():
                results.line(path)
        for line in session.store.settings():
            results.line(f"in survey.toml: {line}")


class Mode(StrEnum):
    """Tracing of light."""

    direct = "direct"
    physical = "physical"


@verb("""
    bathynerf simulate cove.toml -o cove --preview
    bathynerf simulate cove.toml -o plan --flight-only
""")
def simulate(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file in TOML (docs/simulation.md).")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="SURVEY", help="Survey folder to write.")],
    mode: Annotated[
        Mode | None, typer.Option(metavar="|".join(Mode), help="Overrides the mode of the scene file.")
    ] = None,
    flight_only: Annotated[bool, typer.Option("--flight-only", help="Write cameras.csv only.")] = False,
    preview: Annotated[bool, typer.Option("--preview", help="One ray per pixel.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Start again even if the survey exists.")] = False,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Simulate a survey of a known scene: photographs, poses and ground truth."""
    with command(verbose, quiet, output, stopped=KEPT) as results:
        from survey.simulate.simulate import simulate, simulate_flight

        if flight_only:
            simulate_flight(scene, output)
            results.line(output / "cameras.csv")
        else:
            simulate(scene, output, mode=mode.value if mode else None, preview=preview, again=again)
            results.line(output)
