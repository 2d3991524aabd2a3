"""`bathynerf simulate`: the options of `survey.simulate.staging.simulate`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.faults import require_address_space
from survey.commands.options import KEPT, Quiet, Verbose

EXAMPLES = """
    bathynerf simulate cove.toml -o cove --preview
    bathynerf simulate cove.toml -o plan --flight-only
"""


class Mode(StrEnum):
    """Tracing of light."""

    direct = "direct"
    physical = "physical"


def run(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file in TOML (docs/simulation.md).")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="SURVEY", help="Survey folder to write.")],
    mode: Annotated[
        Mode | None, typer.Option(metavar="|".join(Mode), help="Overrides the mode of the scene file.")
    ] = None,
    flight_only: Annotated[bool, typer.Option("--flight-only", help="Write cameras.csv and flight.png only.")] = False,
    preview: Annotated[bool, typer.Option("--preview", help="One ray per pixel.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Start again even if the survey exists.")] = False,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Simulate a survey of a known scene: photographs, poses and ground truth."""
    with command(verbose, quiet, output, stopped=KEPT) as results:
        require_address_space()
        from survey.simulate.staging.simulate import simulate, simulate_flight

        if flight_only:
            simulate_flight(scene, output)
            results.line(output / "cameras.csv")
            results.line(output / "flight.png")
        else:
            simulate(scene, output, mode=mode.value if mode else None, preview=preview, again=again)
            results.line(output)
