"""Pages of help: names that read as they are typed, and options in panels by purpose."""

from __future__ import annotations

from collections import Counter
from typing import Any

from typer.core import TyperCommand

# Of options without a panel: alone on a page, and after panels.
_ALL, _REST = "Options", "Other options"
_ARGUMENTS = "Arguments"


class Page(TyperCommand):
    """A verb whose help has a panel for each ``rich_help_panel`` of its options, as plain text."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Usage as of Typer, with arguments by their placeholder alone: SURVEY, not {SURVEY}."""
        return [self.options_metavar or "", *(_usage(param) for param in _arguments(self.get_params(ctx)))]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options, those of one purpose together; a single one is no panel."""
        rows = [(_panel(param), row) for param in self.get_params(ctx) if (row := _row(param, ctx)) is not None]
        sizes = Counter(panel for panel, _ in rows)
        panels: dict[str, list[tuple[str, str]]] = {}
        for panel, row in rows:
            panels.setdefault(panel if sizes[panel] > 1 or panel == _ARGUMENTS else _ALL, []).append(row)
        rest = panels.pop(_ALL)
        for name, rows_of_it in (*panels.items(), (_REST if panels.keys() - {_ARGUMENTS} else _ALL, rest)):
            with formatter.section(name):
                formatter.write_dl(rows_of_it)


def _panel(param: Any) -> str:
    if param.param_type_name == "argument":
        return _ARGUMENTS
    return getattr(param, "rich_help_panel", None) or _ALL


def _row(param: Any, ctx: Any) -> tuple[str, str] | None:
    """Row of the help on a parameter; None of a hidden one."""
    record = param.get_help_record(ctx)
    return (param.metavar, record[1]) if record is not None and _panel(param) == _ARGUMENTS else record


def _arguments(params: list[Any]) -> list[Any]:
    return [param for param in params if _panel(param) == _ARGUMENTS]


def _usage(param: Any) -> str:
    """An argument as the line of usage has it."""
    name = param.metavar if param.required else f"[{param.metavar}]"
    return name if param.nargs == 1 else f"{name}..."
