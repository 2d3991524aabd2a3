"""Parts of a section of report.html, of a text in a terminal, or of a notebook: texts, tables, pictures."""

import base64
import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import ClassVar


@dataclass(frozen=True)
class Text:
    """A paragraph; ``is_soft``: printed in grey."""

    kind: ClassVar[str] = "text"
    text: str
    is_soft: bool = False


@dataclass(frozen=True)
class Rows:
    """Labels with a text each."""

    kind: ClassVar[str] = "rows"
    rows: list[tuple[str, str]]


@dataclass(frozen=True)
class Table:
    """A table with a header row; all but the first ``num_texts`` columns hold numbers."""

    kind: ClassVar[str] = "table"
    titles: tuple[str, ...]  # With the unit of the column
    rows: Sequence[tuple[str, ...]]  # sequence of tuple of str
    num_texts: int = 1
    heading: str = ""


@dataclass(frozen=True)
class Folded:
    """A long table that opens on a click."""

    kind: ClassVar[str] = "folded"
    summary: str
    table: Table
    is_open: bool


@dataclass(frozen=True)
class Sentences:
    kind: ClassVar[str] = "sentences"
    sentences: Sequence[str]


Block = Text | Rows | Table | Folded | Sentences


@dataclass(frozen=True)
class Section:
    """A part of the page with a title."""

    title: str
    blocks: list[Block]


def aligned(titles: Sequence[str], rows: Sequence[Sequence[str]], num_texts: int = 1) -> list[str]:
    """A table as lines of columns, long titles on several; all columns but the first ``num_texts`` end alike."""
    heads = []
    for title, *cells in zip(titles, *rows, strict=True):
        width = max(map(len, [*cells, *title.split(" ")]))
        heads.append(wrap(title, max(width, 1), break_long_words=False))
    tall, padded = max(map(len, heads)), []
    for number, (head, *cells) in enumerate(zip(heads, *rows, strict=True)):
        column = [*[""] * (tall - len(head)), *head, *cells]
        width = max(map(len, column))
        padded.append([cell.ljust(width) if number < num_texts else cell.rjust(width) for cell in column])
    return ["  ".join(line).rstrip() for line in zip(*padded, strict=True)]


def table_html(rows: Iterable[tuple[str, object]]) -> str:
    """A table of labels and values."""
    lines = (
        f"<tr><th style='text-align: left'>{html.escape(label)}</th>"
        f"<td style='text-align: left'>{html.escape(str(value))}</td></tr>"
        for label, value in rows
    )
    return f"<table>{''.join(lines)}</table>"


def picture_html(path: Path) -> str:
    """A PNG, inside the page."""
    return f'<img alt="{html.escape(path.stem)}" style="max-width: 40em" src="{png_data(path)}">'


def png_data(path: Path) -> str:
    """A PNG as a URL that holds it."""
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"
