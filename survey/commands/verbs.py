"""The verbs of `bathynerf`, each in its own file of the same name.

A verb's file has its options and prints its results; what it computes is elsewhere, and imported when it runs.
"""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, cast

import typer
from typer.core import TyperGroup

from survey.commands import (
    benchmark,
    change,
    check,
    compare,
    export,
    field,
    init,
    mark,
    process,
    profile,
    render,
    simulate,
    view,
    waterline,
)  # fmt: skip
from survey.commands.console import BEFORE_VERB
from survey.commands.faults import BAD_INPUT
from survey.commands.options import Quiet, Verbose
from survey.commands.pages import Page
from survey.commands.streams import say_error

# In the order of `bathynerf --help`.
VERBS = (
    init, check, mark, process, waterline, view, export, render, field, compare, change, profile, simulate, benchmark
)  # fmt: skip

_EPILOG = """\b
Exit codes:
  0    done
  1    a bug in bathynerf; -v shows where
  2    a problem with the input, options, disk or memory
  3    done, but the result failed a quality gate
  130  stopped by Ctrl-C
  141  standard output was closed (broken pipe)

\b
Examples:
  bathynerf init my_survey
  bathynerf check my_survey
  bathynerf process my_survey
"""

# Of missing and unknown arguments too; Typer names only this kind of it.
_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__base__)


class _Verbs(TyperGroup):
    """The verbs, whose usage errors have the form of all other errors: one sentence."""

    def make_context(self, *args, **options):
        """Context as of Typer, with the arguments of `bathynerf` itself."""
        with _in_one_sentence():
            return super().make_context(*args, **options)

    def invoke(self, ctx):
        """Invoke as Typer does, with the arguments of a verb."""
        with _in_one_sentence():
            return super().invoke(ctx)


@contextmanager
def _in_one_sentence() -> Iterator[None]:
    try:
        yield
    except _UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            raise
        text = error.format_message().replace("Value error, ", "").rstrip(".")
        say_error(f"{text[:1].lower()}{text[1:]}; --help lists what is known")
        raise typer.Exit(BAD_INPUT) from error


# Plain help: rich treats [m] as markup and breaks words in narrow columns.
app = typer.Typer(
    cls=_Verbs,
    help="Drone photographs of shallow water become a georeferenced point cloud of the bed.",
    epilog=_EPILOG,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _root(
    ctx: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    if version:
        import importlib.metadata

        typer.echo(f"bathynerf {importlib.metadata.version('bathynerf')}")
        raise typer.Exit(0)
    BEFORE_VERB.set(verbose - quiet)
    if ctx.invoked_subcommand is None:
        typer.echo(ctx.get_help())


def _add(verb) -> None:
    name = verb.__name__.rpartition(".")[2]
    summary = inspect.cleandoc(verb.run.__doc__).partition("\n\n")[0]
    examples = textwrap.indent(textwrap.dedent(verb.EXAMPLES).strip(), "  ")
    app.command(name, cls=Page, short_help=summary, epilog=f"\b\nExamples:\n{examples}\n")(verb.run)


for _verb in VERBS:
    _add(_verb)
