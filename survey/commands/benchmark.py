"""`bathynerf benchmark`: the options and results of `survey.benchmark`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, Verbose, grouped
from survey.words import Device, Quality

EXAMPLES = """
    bathynerf benchmark my_survey -o out
    bathynerf benchmark --drawn 2,oblique,20 --method full
    bathynerf benchmark my_survey --repeats 5 \\
        --against before/results.json
"""
FOLDER = Path("benchmark")
_measured = partial(typer.Option, rich_help_panel="What is measured")


@dataclass(frozen=True)
class RunOptions:
    """Options of the surveys and runs."""

    drawn: Annotated[
        list[str] | None,
        _measured(metavar="D,P,N", help="Simulate a survey: depth [m], nadir or oblique, images; or all. Repeatable."),
    ] = None
    method: Annotated[
        list[str] | None,
        _measured(metavar="NAME", help="full, sweep, mdw, straight, times_index, per_camera; default: all."),
    ] = None
    quality: Annotated[
        list[Quality] | None,
        _measured(metavar="|".join(Quality), help="Repeatable; default: all."),
    ] = None
    poses: Annotated[list[str] | None, _measured(metavar="given|images", help="Repeatable; default: given.")] = None
    device: Annotated[
        list[Device] | None, _measured(metavar="|".join(Device), help="Repeatable; default: all that are present.")
    ] = None
    repeats: Annotated[int, _measured(metavar="N", help="Rounds; times are medians.")] = 1


@grouped
def run(
    surveys: Annotated[
        list[Path] | None, typer.Argument(metavar="SURVEY", help="Survey folders with reference.ply.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for all results.")] = FOLDER,
    measured: RunOptions = RunOptions(),
    against: Annotated[
        Path | None, typer.Option(metavar="FILE", help="An earlier results.json: list what has changed.")
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
            methods=tuple(measured.method or METHODS),
            qualities=tuple(choice.value for choice in measured.quality or Quality),
            poses=tuple(measured.poses or ("given",)),
            devices=tuple(choice.value for choice in measured.device or ()) or present_devices(),
            repeats=measured.repeats,
        )
        found = benchmark(surveys or [], output, drawn=measured.drawn or [], settings=settings)
        for line in table(found) + ([] if earlier is None else ["", *comparison(found, earlier)]):
            results.line(line)
        results.line(output / RESULTS)
        results.line(output / FRONT)
