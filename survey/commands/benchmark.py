"""`bathynerf benchmark`: the options and results of `survey.benchmark`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, Verbose, words_of
from survey.words import Device, Quality

EXAMPLES = """
    bathynerf benchmark my_survey -o out
    bathynerf benchmark --drawn 2,oblique,20 --method full
    bathynerf benchmark my_survey --repeats 5 \\
        --against before/results.json
"""
FOLDER = Path("benchmark")


def run(
    surveys: Annotated[
        list[Path] | None, typer.Argument(metavar="SURVEY", help="Survey folders with reference.ply.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for all results.")] = FOLDER,
    drawn: Annotated[
        list[str] | None,
        typer.Option(
            metavar="D,P,N",
            help="Also draw one: depth [m], nadir or oblique, images; or all. Repeatable.",
            rich_help_panel="What is measured",
        ),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="full, sweep, slab, straight, times_index, per_camera; default: all.",
            rich_help_panel="What is measured",
        ),
    ] = None,
    quality: Annotated[
        list[Quality] | None,
        typer.Option(metavar=words_of(Quality), help="Repeatable; default: all.", rich_help_panel="What is measured"),
    ] = None,
    poses: Annotated[
        list[str] | None,
        typer.Option(metavar="given|images", help="Repeatable; default: given.", rich_help_panel="What is measured"),
    ] = None,
    device: Annotated[
        list[Device] | None,
        typer.Option(
            metavar=words_of(Device),
            help="Repeatable; default: all that are present.",
            rich_help_panel="What is measured",
        ),
    ] = None,
    repeats: Annotated[
        int,
        typer.Option(
            metavar="N", help="Rounds; times get intervals from three on.", rich_help_panel="What is measured"
        ),
    ] = 1,
    against: Annotated[
        Path | None, typer.Option(metavar="FILE", help="An earlier results.json: say what became better or worse.")
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Measure run time against error, for the whole pipeline and for baselines."""
    with command(verbose, quiet, output) as results:
        from survey.benchmark.benchmark import FRONT, RESULTS, Settings, benchmark, present_devices
        from survey.benchmark.records import METHODS, read_results
        from survey.benchmark.text import comparison, table

        # Read before hours are spent.
        earlier = None if against is None else read_results(against)
        settings = Settings(
            methods=tuple(method or METHODS),
            qualities=tuple(choice.value for choice in quality or Quality),
            poses=tuple(poses or ("given",)),
            devices=tuple(choice.value for choice in device or ()) or present_devices(),
            repeats=repeats,
        )
        found = benchmark(surveys or [], output, drawn=drawn or [], settings=settings)
        for line in table(found) + ([] if earlier is None else ["", *comparison(found, earlier)]):
            results.line(line)
        results.line(output / RESULTS)
        results.line(output / FRONT)
