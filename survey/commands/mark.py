"""`bathynerf mark`: the options of `survey.marking`, and a server until Ctrl-C."""

from __future__ import annotations

import os
import sys
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, SurveyFolder, Verbose

EXAMPLES = """
    bathynerf mark my_survey
    bathynerf mark my_survey --points gcps.csv
    bathynerf mark my_survey --port 8765 --no-browser
"""


def run(
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
    with command(verbose, quiet, survey) as results:
        from survey.errors import SurveyError
        from survey.marking.server import MarkingServer
        from survey.marking.session import MarkingSession

        session = MarkingSession(survey, run=poses_of, points=points)
        try:
            server = MarkingServer(session, host, port)
        except OSError as error:
            raise SurveyError(
                f"cannot listen at {host}, port {port} ({error.strerror}); name another --port or --host"
            ) from error
        with server:
            results.line(server.url)
            # Without a window to open the system may start a browser in the terminal.
            shown = [os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")]
            has_display = sys.platform in ("darwin", "win32") or any(shown)
            if not no_browser and has_display:
                webbrowser.open(server.url)
            with suppress(KeyboardInterrupt):
                server.serve_forever()
        for path in (session.store.control_path, session.store.clicks_path):
            if path.is_file():
                results.line(path)
        for line in session.store.settings():
            results.line(f"in survey.toml: {line}")
