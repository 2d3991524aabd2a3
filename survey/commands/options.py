"""Arguments and options that several verbs share, also as records."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from dataclasses import Field, fields, is_dataclass, replace
from enum import Enum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from survey.escaping import printable
from survey.files.toml_table import ONE_OF, OPTION, Option
from survey.init.options import InitOptions
from survey.settings.tables import HOW
from survey.words import COMPARED, Device, wrap_for

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

    def ask(question: str) -> str:
        return typer.prompt(wrap_for(printable(question), sys.stderr), default="", show_default=False, err=True)

    return replace(told, ask=ask if sys.stdin.isatty() and sys.stderr.isatty() else None, needs_level=needs_level)


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Decorator of a command: each parameter whose type is a dataclass becomes options, one for each field that is one.

    These are fields that `survey.files.toml_table.option` makes, and those of the type ``Annotated[..., Option(...)]``.
    Their defaults are those of the record that is the parameter's default.
    """
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
        records = {
            name: group(**{option: _frozen(given.pop(option)) for option in offered[name]})
            for name, group in groups.items()
        }
        command(**given, **records)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


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
