"""A command on the console: its results on standard output, its progress and its errors on standard error."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

import typer

from survey.commands.faults import STANDARD_OUTPUT, disk_error, fault_of, say_error
from survey.display.blocks import Rows, Section, Sentences, Table, Text, aligned
from survey.escaping import printable
from survey.words import wrap_for

# One -q silences the progress, two silence the results as well.
_NO_RESULTS = -2
# Number of -v minus number of -q before the verb; they count like those after it.
BEFORE_VERB: ContextVar[int] = ContextVar("before_verb", default=0)


class Ended(typer.Exit):
    """Raised to exit after the error has been printed."""


class ConsoleResults:
    """Standard output, for results: numbers, verdicts and the paths of written files."""

    def __init__(self, *, is_silent: bool):
        self._is_silent = is_silent

    def line(self, text: str | Path, *, bold: bool = False, label: str | None = None, indent: str = "  ") -> None:
        """Print a line; behind a label it is wrapped to the terminal, with an indent of the lines that follow."""
        if self._is_silent:
            return
        shown = printable(str(text), most=None)
        try:
            typer.secho(shown if label is None else wrap_for(shown, sys.stdout, label=label, indent=indent), bold=bold)
        except BrokenPipeError:
            raise
        except OSError as error:
            from survey.errors import SurveyError

            raise SurveyError(disk_error(error, STANDARD_OUTPUT) or f"standard output is broken: {error}") from error

    def columns(self, title: str | None, rows: list[tuple[str, str]]) -> None:
        """Print labels and texts in two columns, wrapped to the terminal."""
        left = max((len(label) for label, _ in rows), default=0) + 2
        if title is not None:
            self.line(title, bold=True)
        for label, text in rows:
            self.line(text, label=label.ljust(left), indent=" " * left)

    def settings(self, path: Path, *, hides: tuple[str, ...] = ()) -> None:
        """Print the path of survey.toml and its lines, without empty ones and those that begin with what it hides."""
        self.line(path)
        for line in path.read_text(encoding="utf-8").splitlines():
            if line and not line.startswith(hides):
                self.line(line, label="  ", indent="      ")

    def section(self, section: Section) -> None:
        """Print the title, texts and tables of a section."""
        if section.title:
            self.line("")
            self.line(section.title, bold=True)
        for block in section.blocks:
            match block:
                case Rows(rows):
                    self.columns(None, rows)
                case Sentences(sentences):
                    self.columns("", [("note", sentence) for sentence in sentences])
                case Text(text):
                    self.line(text, label="")
                case Table(titles, rows, num_texts, heading):
                    self.line("")
                    for number, line in enumerate([*[heading] * bool(heading), *aligned(titles, rows, num_texts)]):
                        self.line(line, bold=bool(heading) and number == 0)


@contextmanager
def command(
    verbose: int, quiet: int, place: Path, *, stopped: str = "", reads: Path | None = None
) -> Iterator[ConsoleResults]:
    """The body of a verb: an error in it becomes one sentence on standard error and an exit code.

    Parameters
    ----------
    verbose, quiet : int
        How often -v and -q were given after the verb.
    place : Path
        Named when a disk error does not name a file.
    stopped : str
        Sentence on unfinished work after Ctrl-C, if the folder ``place`` exists by then.
    reads : Path, optional
        The first input, announced at once, since loading libraries takes seconds.
    """
    from survey.progress import Progress

    verbosity = verbose - quiet + BEFORE_VERB.get()
    with Progress(verbosity=verbosity) as progress:
        try:
            if reads is not None and reads.exists():
                progress.note(f"reading {reads}")
            yield ConsoleResults(is_silent=verbosity <= _NO_RESULTS)
            return
        except typer.Exit:
            raise
        except (Exception, KeyboardInterrupt) as error:
            fault = fault_of(error, place, stopped=stopped if place.is_dir() else "")
            trace = traceback.format_exc()
        if fault.message:
            # A full disk cannot take the log either; the message must still reach the user.
            with suppress(OSError):
                progress.log_only(f"error: {fault.message}\n{trace if fault.is_ours else ''}".rstrip())
    with suppress(OSError):
        if fault.is_ours and verbosity > 0:
            typer.echo("\n".join(printable(line) for line in trace.splitlines()), err=True)
        say_error(fault.message)
    raise Ended(fault.code)
