"""The entry point of the console command: from arguments to an exit code.

Nothing but the standard library is imported before Ctrl-C, closed streams and broken pipes are taken care of; the
verbs are in `survey.commands.verbs`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from survey.commands import streams
from survey.commands.faults import BAD_INPUT, BROKEN_PIPE, STANDARD_OUTPUT, fault_of, has, refusal_of


def main() -> None:
    """Run the verb that the arguments name, and exit with the code that says how it ended."""
    streams.open_closed()
    code = _run()
    error = streams.flush_all()
    if error is not None and code == 0:
        code = BROKEN_PIPE if isinstance(error, BrokenPipeError) else BAD_INPUT
        if code == BAD_INPUT:
            streams.say_error(refusal_of(error, STANDARD_OUTPUT))
    sys.exit(code)


def _run() -> int:
    try:
        from survey.commands.console import Ended
        from survey.commands.verbs import app

        app(prog_name="bathynerf")
        return 0
    except SystemExit as error:
        # Typer turns Ctrl-C and broken pipes outside of a verb, e.g. under --help, into exits without a sentence.
        if not has(error, KeyboardInterrupt, BrokenPipeError) or has(error, Ended):
            return error.code if isinstance(error.code, int) else 0
        fault = fault_of(error)
    except BaseException as error:
        # Outside of a verb nothing but the console is written to.
        fault = fault_of(error, Path(STANDARD_OUTPUT))
    streams.say_error(fault.message)
    return fault.code
