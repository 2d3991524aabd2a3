"""The entry point of the console command: from arguments to an exit code.

Nothing is imported before Ctrl-C, closed streams and broken pipes are taken care of; the verbs are in
`survey.commands.verbs`.
"""

import gc
import os
import signal
import sys
from contextlib import suppress

# Read by OpenBLAS when numpy is imported. Matrices are small here, and idle BLAS threads take cores from kernels and
# tiles. A number that the user has set is kept.
_THREADS_OF_ALGEBRA = "OPENBLAS_NUM_THREADS"


def main() -> None:
    """Run the command line and exit with its exit code."""
    os.environ.setdefault(_THREADS_OF_ALGEBRA, "1")
    # SIGTERM, which ends jobs of Slurm and containers, counts as Ctrl-C. Only the main thread may set signal handlers.
    with suppress(ValueError):
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = _run()
    except KeyboardInterrupt:
        # Ctrl-C before the command starts, or a second time.
        from survey.commands.faults import STOPPED as code
        from survey.commands.faults import say_error

        say_error("stopped")
    # Skip the garbage collection at exit, which would walk all remaining objects.
    gc.freeze()
    sys.exit(code)


def _run() -> int:
    from survey.commands import faults
    from survey.commands.faults import BAD_INPUT, BROKEN_PIPE, STANDARD_OUTPUT, disk_error

    faults.open_closed()
    code = _run_verb()
    error = faults.flush_all()
    if error is None or code != 0:
        return code
    if isinstance(error, BrokenPipeError):
        return BROKEN_PIPE
    faults.say_error(disk_error(error, STANDARD_OUTPUT) or f"{STANDARD_OUTPUT} is broken: {error}")
    return BAD_INPUT


def _run_verb() -> int:
    from pathlib import Path

    from survey.commands.faults import STANDARD_OUTPUT, fault_of, is_caused_by, say_error

    try:
        from survey.commands.console import Ended
        from survey.commands.verbs import app

        app(prog_name="bathynerf")
        return 0
    except SystemExit as error:
        # Typer turns Ctrl-C and broken pipes outside of a verb, e.g. under --help, into exits without a sentence.
        if not is_caused_by(error, KeyboardInterrupt, BrokenPipeError) or is_caused_by(error, Ended):
            return error.code if isinstance(error.code, int) else 0
        fault = fault_of(error)
    except BaseException as error:
        # Outside of a verb nothing but the console is written to.
        fault = fault_of(error, Path(STANDARD_OUTPUT))
    say_error(fault.message)
    return fault.code
