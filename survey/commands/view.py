"""`bathynerf view`: the options of `survey.viewer`."""

from __future__ import annotations

from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, RunFolder, Verbose

EXAMPLES = """
    bathynerf view my_survey/bathynerf
    bathynerf view RUN --port 9000
"""


def run(
    run: RunFolder,
    host: Annotated[
        str, typer.Option(metavar="HOST", help="Address to listen at; 0.0.0.0: for other machines too.")
    ] = "localhost",
    port: Annotated[
        int, typer.Option(metavar="PORT", help="Port; the next free one where it is taken.", min=1, max=65535)
    ] = 8080,
    survey: Annotated[
        str | None, typer.Option(metavar="DIR", help="Survey folder, if it was moved since the run.")
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Look at a run in the browser: cloud, water and photographs (extra viewer).

    Ctrl-C ends it. From another machine: ssh -L 8080:localhost:8080 HOST.
    """
    with command(verbose, quiet, run) as results:
        from survey.viewer.session import ViewOptions, open_session, wait

        session = open_session(run, ViewOptions(survey=survey, host=host, port=port))
        results.line(session.address)
        wait(session)
