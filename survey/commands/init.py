"""`bathynerf init`: the options of `survey.init.draft`."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, Verbose
from survey.errors import FILE_NAME
from survey.escaping import printable

EXAMPLES = """
    bathynerf init my_survey
    bathynerf init my_survey --level 12.34
    bathynerf init my_survey --crs EPSG:25832+7837 --schema
"""
_told = partial(typer.Option, rich_help_panel="Values that no file states")


def run(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder with photographs, in images/ or itself.")],
    level: Annotated[
        float | None, _told(metavar="M", help="Height of the water in the heights of the CRS [m].")
    ] = None,
    crs: Annotated[
        str | None, _told(metavar="CRS", help="Horizontal and vertical, e.g. EPSG:25832+7837; default: found.")
    ] = None,
    dry: Annotated[bool, _told("--dry", help="There is no water.")] = False,
    origin: Annotated[
        tuple[float, float, float] | None,
        _told(metavar="E N H", help="Zero point of poses in a local frame, in the CRS."),
    ] = None,
    schema: Annotated[
        bool, typer.Option("--schema", help="Also write survey.schema.json, by which editors complete and check keys.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace survey.toml.")] = False,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Write survey.toml from what a folder of photographs holds.

    Photographs, poses, control and water levels are found by their names; values that are uncertain get a comment. On a
    terminal it asks for what no file states.
    """
    with command(verbose, quiet, folder, reads=folder) as results:
        from survey.init.crs import Answers
        from survey.init.draft import SCHEMA_LINE, require_level_and_dry_apart, write_schema, write_settings
        from survey.progress import current

        answers = Answers(crs, level, dry, origin, _ask if sys.stdin.isatty() and sys.stderr.isatty() else None)
        require_level_and_dry_apart(answers)
        toml = folder / FILE_NAME
        if schema:
            results.line(write_schema(folder))
            if toml.exists() and not force:
                current().note(f"{toml} is kept; editors find the schema by {SCHEMA_LINE.strip()} in its first line")
                return
        path = write_settings(folder, answers, force=force, names_schema=schema)
        results.line(path)
        for line in path.read_text(encoding="utf-8").splitlines():
            results.line(f"  {line}")


def _ask(question: str) -> str:
    return typer.prompt(printable(question), default="", show_default=False, err=True)
