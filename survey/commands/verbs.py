"""The verbs of `bathynerf` as one program, with its help and its usage errors.

A verb has its options and prints its results; what it computes is elsewhere, and imported when it runs.
"""

from __future__ import annotations

import inspect
import textwrap
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, cast

import typer
from typer.core import TyperCommand, TyperGroup

from survey.commands import compute, prepare, results
from survey.commands.console import BEFORE_VERB, Quiet, Verbose
from survey.commands.faults import BAD_INPUT, say_error

# Titles of the options without a panel: where there are no panels, and after panels.
_ALL, _REST = "Options", "Other options"
_ARGUMENTS = "Arguments"
# In the order of `bathynerf --help`.
VERBS = (
    prepare.init, prepare.check, prepare.mark, compute.process, compute.waterline, results.view, results.export,
    results.render, compute.field, results.compare, results.change, results.profile, prepare.simulate,
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

# The base class also covers missing and unknown arguments; Typer exports only BadParameter.
_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__base__)


class Page(TyperCommand):
    """A verb whose help has a panel for each ``rich_help_panel`` of its options, as plain text."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Typer's usage line, with arguments by their placeholder alone: SURVEY, not {SURVEY}."""
        arguments = [param for param in self.get_params(ctx) if _panel(param) == _ARGUMENTS]
        names = [(f"{param.metavar}" if param.required else f"[{param.metavar}]", param.nargs) for param in arguments]
        return [self.options_metavar or "", *(name if nargs == 1 else f"{name}..." for name, nargs in names)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options in panels by purpose; a single option gets no panel."""
        rows = [(_panel(param), row) for param in self.get_params(ctx) if (row := _row(param, ctx)) is not None]
        sizes = Counter(panel for panel, _ in rows)
        panels: dict[str, list[tuple[str, str]]] = {}
        for panel, row in rows:
            panels.setdefault(panel if sizes[panel] > 1 or panel == _ARGUMENTS else _ALL, []).append(row)
        single_options = panels.pop(_ALL)
        for name, rows_of_it in (*panels.items(), (_REST if panels.keys() - {_ARGUMENTS} else _ALL, single_options)):
            with formatter.section(name):
                formatter.write_dl(rows_of_it)


def _panel(param: Any) -> str:
    if param.param_type_name == "argument":
        return _ARGUMENTS
    return getattr(param, "rich_help_panel", None) or _ALL


def _row(param: Any, ctx: Any) -> tuple[str, str] | None:
    """Row of the help on a parameter; None for a hidden one."""
    record = param.get_help_record(ctx)
    return (param.metavar, record[1]) if record is not None and _panel(param) == _ARGUMENTS else record


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
        say_error(f"{text[:1].lower()}{text[1:]}; see --help")
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


for _verb in VERBS:
    _summary = inspect.cleandoc(_verb.__doc__ or "").partition("\n\n")[0]
    _examples = textwrap.indent(vars(_verb)["examples"], "  ")
    app.command(_verb.__name__, cls=Page, short_help=_summary, epilog=f"\b\nExamples:\n{_examples}\n")(_verb)
