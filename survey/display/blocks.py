"""Parts of a section of report.html, or of a text in a terminal: texts and tables, formatted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
    """A list of sentences."""

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
