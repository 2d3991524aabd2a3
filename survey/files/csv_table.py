"""Tables with named columns in text files: comma, semicolon or tab between the values, every error with its line.

The first line that is neither empty nor a comment (#) decides the separator: a tab if it has one, else a
semicolon, else a comma. Unless that is a comma, a comma in a number is the decimal one.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from survey.errors import SurveyError

_QUOTED = re.compile(r'"[^"]*"')


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes
    ----------
    where : str
        Path and line number, for messages.
    cells : dict of str to str
        Texts of the requested columns, by name; of optional ones only those that the table has.
    decimal : "." or ","
    error : type
        What is raised.
    """

    where: str
    cells: dict[str, str]
    decimal: str
    error: type[SurveyError]

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
        value = _number(text, self.decimal)
        if not math.isfinite(value):
            raise self.error(
                f"{self.where}: {name} is {text or 'empty'}, expected a finite number; correct it or remove the line"
            )
        return value


def read_table(
    path: Path,
    columns: Sequence[str],
    *,
    optional: Sequence[str] = (),
    header: bool = True,
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
    error : type
        What is raised.

    Raises
    ------
    SurveyError
        If the file cannot be read, a column is missing, or a line has too few values or a quote without an end.
    """
    lines = list(_lines(path, error))
    delimiter = _delimiter(lines[0][1]) if lines else ","
    decimal = "." if delimiter == "," else ","
    rows = [(number, _cells(f"{path}, line {number}", line, delimiter, error)) for number, line in lines]
    names = [cell.casefold() for cell in rows[0][1]] if rows else []
    missing = [name for name in columns if name not in names]
    if missing and header:
        raise error(
            f"{path}: the first line has no column {', '.join(missing)}; expected {','.join(columns)}, found "
            f"{','.join(names) or 'nothing'}"
        )
    if missing:
        is_title = rows and not any(math.isfinite(_number(cell, decimal)) for cell in rows[0][1])
        rows = rows[1:] if is_title else rows
        place = {name: i for i, name in enumerate((*columns, *optional))}
    else:
        rows = rows[1:]
        place = {name: names.index(name) for name in (*columns, *optional) if name in names}
    needed = 1 + max(place[name] for name in columns)
    found = []
    for number, cells in rows:
        where = f"{path}, line {number}"
        if len(cells) < needed:
            raise error(f"{where}: {len(cells)} values were found, expected {needed}; complete the line")
        texts = {name: cells[i] for name, i in place.items() if i < len(cells)}
        found.append(Row(where, texts, decimal, error))
    return found


def column_names(path: Path) -> list[str]:
    """Names of the columns of a table, lower case; none if the file is not text."""
    try:
        first = next(_lines(path, SurveyError), None)
        return [] if first is None else [c.casefold() for c in _cells("", first[1], _delimiter(first[1]), SurveyError)]
    except SurveyError:
        return []


def _lines(path: Path, error: type[SurveyError]) -> Iterator[tuple[int, str]]:
    """Numbers and texts of the lines that are neither empty nor comments."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, start=1):
                if line.strip(" \t\r\n,;") and not line.lstrip().startswith("#"):
                    yield number, line.rstrip("\r\n")
    except UnicodeDecodeError as problem:
        raise error(f"{path} is not UTF-8 ({problem.reason}); save the table as UTF-8") from problem
    except OSError as problem:
        raise error(f"{path} cannot be read ({problem.strerror}); correct its name or its permissions") from problem


def _delimiter(line: str) -> str:
    bare = _QUOTED.sub("", line)
    return next((mark for mark in "\t;" if mark in bare), ",")


def _cells(where: str, line: str, delimiter: str, error: type[SurveyError]) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, strict=True))]
    except csv.Error as problem:
        raise error(f"{where}: {problem}; expected a closing quote on the same line") from problem


def _number(text: str, decimal: str) -> float:
    """A number; NaN where the text is none. With a decimal comma, a point is good too, but not both."""
    if decimal == "," and "." not in text:
        text = text.replace(",", ".", 1)
    try:
        return float(text)
    except ValueError:
        return math.nan
