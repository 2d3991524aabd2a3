"""A command on the console: its options, its results on standard output, its progress and errors on standard error."""

import inspect
import sys
import textwrap
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import Field, fields, is_dataclass, replace
from enum import Enum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from survey.commands.faults import STANDARD_OUTPUT, disk_error, fault_of, say_error
from survey.display.blocks import Rows, Section, Sentences, Table, Text, aligned
from survey.files.toml_table import ONE_OF, OPTION, Option
from survey.settings.tables import HOW, InitOptions
from survey.words import COMPARED, Device, printable, wrap_for

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

    -v and -q were given so often after the verb. A disk error that names no file names the place; ``stopped`` is the
    sentence on unfinished work after Ctrl-C, if that folder exists by then; ``reads`` is the first input, announced at
    once, since loading libraries takes seconds.
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


# After Ctrl-C, for verbs that resume.
KEPT = "finished work is kept, and the same command resumes from there"

SurveyFolder = Annotated[Path, typer.Argument(metavar="SURVEY", help="Folder with images and survey.toml.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder written by process.")]
DeviceOption = Annotated[Device, typer.Option(metavar="|".join(Device), help="Where to compute.", rich_help_panel=HOW)]
Visible = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Points of the reference that cameras see.", rich_help_panel=COMPARED),
]
Verbose = Annotated[
    int, typer.Option("-v", "--verbose", count=True, show_default=False, help="More details, and tracebacks.")
]
Quiet = Annotated[
    int, typer.Option("-q", "--quiet", count=True, show_default=False, help="Results without progress; -qq: no output.")
]


def asking(told: InitOptions, *, needs_level: bool) -> InitOptions:
    """These options, and a person at the terminal to be asked for others, if there is one."""

    def ask(question: str, read: Callable[[str], Any]) -> Any:
        lines = [wrap_for(printable(line), sys.stderr) for line in question.split("\n")]
        while True:
            try:
                return read(typer.prompt("\n".join(lines), default="", show_default=False, err=True).strip())
            except typer.Abort as error:
                # Ctrl-C or Ctrl-D at the question.
                raise KeyboardInterrupt from error
            except ValueError as error:
                say_error(str(error))

    return replace(told, ask=ask if sys.stdin.isatty() and sys.stderr.isatty() else None, needs_level=needs_level)


def verb(examples: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator of a verb, with examples for its help: each parameter that is a record becomes options, one a field.

    These are fields that `survey.files.toml_table.option` makes, and those of the type ``Annotated[..., Option(...)]``.
    Their defaults are those of the record that is the parameter's default.
    """

    def made(command: Callable[..., None]) -> Callable[..., None]:
        run = _with_options_of_records(command)
        vars(run)["examples"] = textwrap.dedent(examples).strip()
        return run

    return made


def _with_options_of_records(command: Callable[..., None]) -> Callable[..., None]:
    hints = get_type_hints(command, include_extras=True)
    groups = {name: hint for name, hint in hints.items() if is_dataclass(hint) and isinstance(hint, type)}
    offered = {name: _offered(group) for name, group in groups.items()}
    parameters = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name not in groups:
            parameters.append(parameter.replace(annotation=hints[name]))
            continue
        parameters += [
            parameter.replace(name=option, default=getattr(parameter.default, option), annotation=annotation)
            for option, annotation in offered[name].items()
        ]

    @wraps(command)
    def run(**given: Any) -> None:
        # Options that are given several times come as lists.
        given = {option: tuple(value) if isinstance(value, list) else value for option, value in given.items()}
        records = {
            name: group(**{option: given.pop(option) for option in offered[name]}) for name, group in groups.items()
        }
        command(**given, **records)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _offered(group: type) -> dict[str, Any]:
    """The fields of a record that are options, with their types as Typer reads them."""
    hints = get_type_hints(group, include_extras=True)
    return {
        field.name: _annotated(field, hints[field.name]) if OPTION in field.metadata else hints[field.name]
        for field in fields(group)
        if OPTION in field.metadata or get_origin(hints[field.name]) is Annotated
    }


def _annotated(field: Field, hint: Any) -> Any:
    """The type of an option; words of an enumeration are of its type."""
    made: Option = field.metadata[OPTION]
    words = field.metadata[ONE_OF]
    if words and isinstance(words[0], Enum):
        hint = type(words[0]) | None
    if get_origin(hint) is tuple and get_args(hint)[-1] is Ellipsis:
        hint = list[get_args(hint)[0]]  # type: ignore[misc]
    names = () if made.name is None else (made.name,)
    shown = field.default is not None
    return Annotated[
        hint,
        typer.Option(*names, metavar=made.metavar, help=made.help, rich_help_panel=made.panel, show_default=shown),
    ]
