"""`bathynerf init`: the options of `survey.init.draft`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, Verbose, asking, grouped
from survey.errors import FILE_NAME
from survey.init.options import InitOptions

EXAMPLES = """
    bathynerf init my_survey
    bathynerf init my_survey --level 12.34
    bathynerf init my_survey --crs EPSG:25832+7837 --schema
"""


@grouped
def run(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder with photographs, in images/, DCIM/ or itself.")
    ],
    told: InitOptions = InitOptions(),
    schema: Annotated[
        bool, typer.Option("--schema", help="Also write survey.schema.json, by which editors complete and check keys.")
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
