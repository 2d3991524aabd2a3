"""Tables with named columns in text files: comma, semicolon or tab between the values, every error with its line.

The first line that is neither empty nor a comment (# or //) decides the separator: a tab if it has one, else a
semicolon, else a comma. Unless that is a comma, a comma in a number is the decimal one.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from survey.errors import SurveyError
from survey.files.json_values import LARGEST

_SPACE = " "
# What the csv module of Python takes as one value.
_LONGEST_LINE = 100_000
_QUOTED = re.compile(r'"[^"]*"')


@dataclass(frozen=True)
class Row:
    """Row of a table."""

    where: str  # Path and line number, for messages
    # dict of str to str: texts of the requested columns, by name; of optional ones only those that the table has
    cells: dict[str, str]
    decimal: str  # "." or ","
    error: type[SurveyError]  # what is raised

    def text(self, name: str) -> str:
        """The text in a column.

        Raises
        ------
        SurveyError
            If it is empty.
        """
        if not self.cells[name]:
            raise self.error(f"{self.where}: {name} is empty, expected a text; give it or remove the line")
        return self.cells[name]

    def number(self, name: str, *, default: float | None = None) -> float:
        """The finite number in a column; `default` where the table does not have the column or the cell is empty.

        Raises
        ------
        SurveyError
            If there is no such number.
        """
        text = self.cells.get(name, "")
        if not text and default is not None:
            return default
        value = number_of(text, self.decimal)
        if not abs(value) <= LARGEST:
            raise self.error(
                f"{self.where}: {name} is {shortened(text) or 'empty'}, expected a finite number of at most "
                f"{LARGEST:g} in size; correct it or remove the line"
            )
        return value


def read_table(
    path: Path,
    columns: Sequence[str],
    *,
    optional: Sequence[str] = (),
    header: bool = True,
    synonyms: Mapping[str, str] | None = None,
    error: type[SurveyError] = SurveyError,
) -> list[Row]:
    """Rows of a table with the named columns, in any order, with any others between them.

    Parameters
    ----------
    path : Path
        In UTF-8, with or without a byte order mark.
    columns : names, lower case
        That the table must have; upper and lower case count alike in the file.
    optional : names, lower case
        That it may have.
    header : bool
        Whether the first line must name the columns; if not, values may be in the order of `columns` and
        `optional`, after a first line of other words or none.
    synonyms : mapping of names, lower case, to those of columns, optional
        Other names that a file may have. The last comment before the first line may name the columns too.
    error : type
        What is raised.

    Raises
    ------
    SurveyError
        If the file cannot be read, a column is missing, or a line has too few values or a quote without an end.
    """
    title, lines = _title_and_lines(path, error)
    delimiter = _delimiter(lines[0][1]) if lines else ","
    decimal = "." if delimiter in (",", _SPACE) else ","
    rows = [(number, _cells(f"{path}, line {number}", line, delimiter, error)) for number, line in lines]
    names = _names(rows[0][1], synonyms) if rows else []
    if synonyms is not None and title is not None and not set(columns) <= set(names):
        of_title = _names(_cells(str(path), title, delimiter, error), synonyms)
        if set(columns) <= set(of_title):
            rows, names = [(0, []), *rows], of_title
    missing = [name for name in columns if name not in names]
    if missing and header:
        raise error(
            f"{path}: the first line has no column {', '.join(missing)}; expected {','.join(columns)}, found "
            f"{shortened(','.join(names)) or 'nothing'}"
        )
    if missing:
        place = {name: i for i, name in enumerate((*columns, *optional))}
    else:
        place = {name: names.index(name) for name in (*columns, *optional) if name in names}
    begins_with_values = missing and rows and any(math.isfinite(number_of(cell, decimal)) for cell in rows[0][1])
    needed = 1 + max(place[name] for name in columns)
    found = []
    for number, cells in rows if begins_with_values else rows[1:]:
        where = f"{path}, line {number}"
        if len(cells) < needed:
            raise error(f"{where}: {len(cells)} values were found, expected {needed}; complete the line")
        texts = {name: cells[i] for name, i in place.items() if i < len(cells)}
        found.append(Row(where, texts, decimal, error))
    return found


def column_names(path: Path, synonyms: Mapping[str, str] | None = None) -> list[str]:
    """Names of the columns of a table, lower case; none if the file is not text.

    With synonyms those in the last comment before the first line too, as `read_table` takes them.
    """
    texts = []
    try:
        for _, line in text_lines(path, SurveyError):
            if _is_comment(line):
                texts = [] if synonyms is None else [_bare(line)]
            elif not _is_empty(line):
                texts.append(line)
                break
        return [name for text in texts for name in _names(_cells("", text, _delimiter(text), SurveyError), synonyms)]
    except SurveyError:
        return []


def first_cells(path: Path, error: type[SurveyError]) -> list[str]:
    """Cells of the first line of a table, or of the comment before it where that has as many; lower case."""
    title, lines = _title_and_lines(path, error)
    if not lines:
        return []
    cells = [cell.casefold() for cell in _cells(str(path), lines[0][1], _delimiter(lines[0][1]), error)]
    if title is not None and any(math.isfinite(number_of(cell, ",")) for cell in cells):
        named = [cell.casefold() for cell in _cells(str(path), title, _delimiter(title), error)]
        return named if len(named) >= len(cells) > 1 else cells
    return cells


def text_lines(path: Path, error: type[SurveyError]) -> Iterator[tuple[int, str]]:
    """Numbers and texts of all lines of a file in UTF-8, with or without a byte order mark.

    Raises
    ------
    SurveyError
        If the file cannot be read or is not UTF-8.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, start=1):
                yield number, line.rstrip("\r\n")
    except UnicodeDecodeError as problem:
        raise error(f"{path} is not UTF-8 ({problem.reason}); save the table as UTF-8") from problem
    except OSError as problem:
        raise error(f"{path} cannot be read ({problem.strerror}); correct its name or its permissions") from problem


def shortened(text: str) -> str:
    """A text of a file for a message, on one line and not longer than that."""
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "..."


def _title_and_lines(path: Path, error: type[SurveyError]) -> tuple[str | None, list[tuple[int, str]]]:
    """The last comment before the lines, without its mark; numbers and texts of those neither empty nor comments."""
    title: str | None = None
    lines: list[tuple[int, str]] = []
    for number, line in text_lines(path, error):
        if _is_comment(line):
            title = title if lines else _bare(line)
        elif not _is_empty(line):
            lines.append((number, line))
    return title, lines


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "//"))


def _bare(comment: str) -> str:
    return comment.lstrip().lstrip("#/").lstrip()


def _is_empty(line: str) -> bool:
    return not line.strip(" \t,;")


def _names(cells: Sequence[str], synonyms: Mapping[str, str] | None) -> list[str]:
    names = [cell.casefold() for cell in cells]
    return names if synonyms is None else [synonyms.get(name, name) for name in names]


def _delimiter(line: str) -> str:
    bare = _QUOTED.sub("", line)
    found = next((mark for mark in "\t;," if mark in bare), None)
    return found or (_SPACE if len(bare.split()) > 1 else ",")


def _cells(where: str, line: str, delimiter: str, error: type[SurveyError]) -> list[str]:
    if len(line) > _LONGEST_LINE:
        raise error(f"{where}: the line has {len(line)} characters, expected a line of a table; correct the file")
    try:
        if delimiter == _SPACE:
            line = line.strip()
        cells = next(csv.reader([line], delimiter=delimiter, strict=True, skipinitialspace=delimiter == _SPACE))
        return [cell.strip() for cell in cells if delimiter != _SPACE or cell]
    except csv.Error as problem:
        raise error(f"{where}: {problem}; expected a closing quote on the same line") from problem


def number_of(text: str, decimal: str = ".") -> float:
    """A number; NaN where the text is none. With a decimal comma, a point is good too, but not both.

    Python reads "100_0001", the name of a photograph, as a number.
    """
    if "_" in text:
        return math.nan
    if decimal == "," and "." not in text:
        text = text.replace(",", ".", 1)
    try:
        return float(text)
    except ValueError:
        return math.nan
