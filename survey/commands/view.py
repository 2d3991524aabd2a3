"""`bathynerf view`: the options of `survey.viewer`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, Verbose
from survey.errors import SurveyError

_served = partial(typer.Option, rich_help_panel="Where it is served")
EXAMPLES = """
    bathynerf view my_survey
    bathynerf view RUN --reference lidar.ply --port 9000
    bathynerf view RUN --field mdw
    bathynerf view RUN --export view.html
"""


def run(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, survey folder, or that of a trained field.")],
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Reference surface to show: mesh, GeoTIFF or points.")
    ] = None,
    field: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Field trained by bathynerf field, to render from anywhere.")
    ] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write one HTML file that opens without a server, and end.")
    ] = None,
    host: Annotated[
        str, _served(metavar="HOST", help="Address to listen on; 0.0.0.0: for other machines too.")
    ] = "localhost",
    port: Annotated[
        int, _served(metavar="PORT", help="Port; the next free one if it is taken.", min=1, max=65535)
    ] = 8080,
    survey: Annotated[
        str | None, typer.Option(metavar="DIR", help="Survey folder, if it was moved since the run.")
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """View and edit a run, or a trained field, in the browser: cloud, water and photographs (extra viewer).

    Ctrl-C ends it. From another machine: ssh -L 8080:localhost:8080 HOST.
    """
    with command(verbose, quiet, run, reads=run) as results:
        from survey.run.folder import run_in
        from survey.viewer.session import ViewOptions, export_page, serve
        from survey.volume.folder import is_field, run_of

        if is_field(run):
            run, field = run_of(run), run
        run = run_in(run)
        if export is not None and field is not None:
            raise SurveyError("a field is rendered by the server; leave out --field or --export")
        options = ViewOptions(survey=survey, reference=reference, field=field, host=host, port=port)
        if export is not None:
            export_page(run, export, options)
            results.line(export)
            return
        serve(run, options, results.line)
