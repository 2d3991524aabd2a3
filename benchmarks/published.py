"""Tables of benchmarks in a page of the documentation, between two marks, so that a command can write them anew."""

from __future__ import annotations

from pathlib import Path


def marks(name: str) -> tuple[str, str]:
    """The lines between which a table of this name stands."""
    return f"<!-- {name}: begin -->", f"<!-- {name}: end -->"


def publish(page: Path, name: str, lines: list[str]) -> None:
    """Write lines of Markdown between the marks of a page; the rest of it stays.

    Raises
    ------
    SystemExit
        If the page has no such marks.
    """
    (begin, end), text = marks(name), page.read_text(encoding="utf-8")
    head, found, rest = text.partition(begin)
    _, ended, tail = rest.partition(end)
    if not (found and ended):
        raise SystemExit(f"{page} has no lines {begin} and {end}, between which the table is written; add them")
    page.write_text("\n".join([f"{head}{begin}", "", *lines, "", f"{end}{tail}"]), encoding="utf-8")
