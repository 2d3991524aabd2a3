"""Tables in text files: columns by their names, under any of the trade and with a unit; every error with its line.

The first line that is neither empty nor a comment (# or //) decides the separator: a tab if it has one, else a
semicolon, else a comma, else blanks. Behind tabs and semicolons a comma in a number is the decimal one. That line names
the columns, or the comment before it does where it has numbers. What is at fault raises the SurveyError that the caller
names.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from geo.crs import unit_named
from survey.errors import SurveyError
from survey.words import LARGEST

_SPACE = " "
# Lines of these alone are empty.
_EMPTY = " \t,;"
# What the csv module of Python takes as one value.
_LONGEST_LINE = 100_000
_QUOTED = re.compile(r'"[^"]*"')
_IN_BRACKETS = re.compile(r"(.*?)[\s_]*[(\[]\s*([^()\[\]]+?)\s*[)\]]")
_DEGREES = ("deg", "degree", "degrees", "°", "dd", "decimal degrees")
# Of two feet, which differ by 2e-6.
_SAME_UNIT = 1e-9
_UNSPECIFIED_FOOT = ("ft", "foot", "feet")


class UnspecifiedFoot(float):
    """A foot [m] of unknown kind, international or US survey; international where nothing decides."""


def same_unit(a: float, b: float) -> bool:
    return abs(a / b - 1.0) < _SAME_UNIT


def words_of(columns: Mapping[str, Iterable[str]]) -> dict[str, str]:
    """Words by which columns are known, to their names: each name itself, and what else it is called."""
    return {word: name for name, words in columns.items() for word in (name, *words)}


@dataclass(frozen=True)
class Row:
    where: str  # Path and line number, for messages
    cells: dict[str, str]  # Texts of the requested columns, by name; of optional ones only those that the table has
    decimal: str  # "." or ","
    error: type[SurveyError]  # What is raised

    def text(self, name: str) -> str:
        """The text in a column; SurveyError if it is empty."""
        if not self.cells[name]:
            raise self.error(f"{self.where}: {name} is empty, expected a text; give it or remove the line")
        return self.cells[name]

    def number(self, name: str, *, default: float | None = None) -> float:
        """The finite number in a column; `default` where the table does not have the column or the cell is empty."""
        text = self.cells.get(name, "")
        if not text and default is not None:
            return default
        value = number_of(text, self.decimal)
        if not abs(value) <= LARGEST:
            raise self.error(
                f"{self.where}: {name} is {text or 'empty'}, expected a finite number of at most "
                f"{LARGEST:g} in size; correct it or remove the line"
            )
        return value

    def multiplied(self, factors: Mapping[str, float]) -> Row:
        """The row with the numbers of some columns multiplied; empty cells stay."""
        changed = {
            name: repr(self.number(name) * factor)
            for name, factor in factors.items()
            if factor != 1.0 and self.cells.get(name)
        }
        return replace(self, cells=self.cells | changed)


@dataclass(frozen=True)
class Column:
    cell: str  # Its name in the file, lower case
    name: str  # What it means by the words of its reader; as in the file where it is none of them
    unit_m: float | None  # [m], where its name in the file states one


@dataclass(frozen=True)
class Table:
    """A table in a text file, its head read."""

    path: Path
    columns: tuple[Column, ...]  # Empty where the first line has numbers, and no comment before it names them
    first: tuple[str, ...]  # Cells of the first line
    start: int  # Number of the first line of values
    delimiter: str
    error: type[SurveyError]

    @classmethod
    def read(cls, path: Path, words: Mapping[str, str], error: type[SurveyError] = SurveyError) -> Table:
        """The head of a table in UTF-8, with or without a byte order mark; words are those of `words_of`."""
        title = ""
        for numbered in text_lines(path, error):
            if _is_comment(numbered[1]):
                title = numbered[1].lstrip().lstrip("#/").lstrip()
            elif numbered[1].strip(_EMPTY):
                break
        else:
            return cls(path, (), (), 1, ",", error)
        number, line = numbered
        bare = _QUOTED.sub("", line)
        delimiter = next((mark for mark in "\t;," if mark in bare), _SPACE if len(bare.split()) > 1 else ",")

        def columns_of(cells: Iterable[str]) -> tuple[tuple[Column, ...], bool]:
            """Columns, and whether two or more of them are known."""
            known = [(cell.casefold(), meaning(cell.casefold(), words)) for cell in cells]
            columns = tuple(Column(cell, *(means or (cell, None))) for cell, means in known)
            return columns, sum(means is not None for _, means in known) > 1

        cells = _cells(f"{path}, line {number}", line, delimiter, error)
        columns, are_known = columns_of(cells)
        if any(math.isfinite(number_of(cell, ",")) for cell in cells) and not are_known:
            number -= 1
            columns, are_known = columns_of(_cells(str(path), title, delimiter, error))
            if not (len(columns) >= len(cells) > 1 and are_known):
                columns = ()
        return cls(path, columns, tuple(cells), number + 1, delimiter, error)

    @property
    def names(self) -> tuple[str, ...]:
        """What the columns mean."""
        return tuple(column.name for column in self.columns)

    @property
    def units(self) -> dict[str, float]:
        """Units [m] of the columns whose names in the file state one."""
        return {column.name: column.unit_m for column in reversed(self.columns) if column.unit_m is not None}

    @property
    def decimal(self) -> str:
        """The decimal mark beside the point."""
        return "." if self.delimiter in (",", _SPACE) else ","

    def common_unit_m(self, one: str, other: str) -> float | None:
        """The unit [m] that two columns have by their names in the file; None where these state none."""
        units = [self.units.get(one), self.units.get(other)]
        if units[0] is None or units[1] is None or not same_unit(units[0], units[1]):
            if units == [None, None]:
                return None
            stated = ["without a unit" if unit is None else f"in units of {unit:.10g} m" for unit in units]
            raise self.error(
                f"{self.path}: {one} is {stated[0]} and {other} {stated[1]}, by the names of their columns; expected "
                "one unit: convert one, or name it in both"
            )
        return units[0]

    def rows(self, columns: Iterable[str], optional: Iterable[str] = ()) -> list[Row]:
        """All rows, with the columns that the table must have and those that it may have, in any order."""
        columns, names = tuple(columns), self.names
        missing = [name for name in columns if name not in names]
        if missing:
            found = ",".join(names or self.first) or "nothing"
            raise self.error(
                f"{self.path}: the first line has no column {', '.join(missing)}; expected {','.join(columns)}, found "
                f"{found}"
            )
        place = {name: names.index(name) for name in (*columns, *optional) if name in names}
        needed, rows = 1 + max(place[name] for name in columns), []
        for number, line in text_lines(self.path, self.error):
            if number < self.start or _is_comment(line) or not line.strip(_EMPTY):
                continue
            where = f"{self.path}, line {number}"
            cells = _cells(where, line, self.delimiter, self.error)
            if len(cells) < needed:
                raise self.error(f"{where}: {len(cells)} values were found, expected {needed}; complete the line")
            texts = {name: cells[i] for name, i in place.items() if i < len(cells)}
            rows.append(Row(where, texts, self.decimal, self.error))
        return rows


def read_table(
    path: Path, columns: Iterable[str], *, optional: Iterable[str] = (), error: type[SurveyError] = SurveyError
) -> list[Row]:
    """Rows of a table whose columns have these names: `Table.read`, `Table.rows`."""
    columns, optional = tuple(columns), tuple(optional)
    return Table.read(path, {name: name for name in (*columns, *optional)}, error).rows(columns, optional)


def column_names(path: Path, words: Mapping[str, str] | None = None) -> tuple[str, ...]:
    """What the columns of a table mean; none if the file is not text."""
    try:
        return Table.read(path, words or {}).names
    except SurveyError:
        return ()


def text_lines(path: Path, error: type[SurveyError]) -> Iterator[tuple[int, str]]:
    """Numbers and texts of all lines of a file in UTF-8, with or without a byte order mark."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, start=1):
                yield number, line.rstrip("\r\n")
    except UnicodeDecodeError as problem:
        raise error(f"{path} is not UTF-8 ({problem.reason}); save the table as UTF-8") from problem
    except OSError as problem:
        raise error(f"{path} cannot be read ({problem.strerror}); correct its name or its permissions") from problem


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


def meaning(cell: str, words: Mapping[str, str]) -> tuple[str, float | None] | None:
    """Meaning of a column and its unit [m], by its name in lower case; None where the name is none of the words.

    Examples
    --------
    >>> words = {"z": "height", "depth": "depth", "std_m": "std"}
    >>> meaning("depth_ft", words), meaning("z [m]", words), meaning("std_m", words), meaning("z_up", words)
    (('depth', 0.3048), ('height', 1.0), ('std', None), None)
    """
    if cell in words:
        return words[cell], None
    # A name and what may be its unit: in brackets, or behind an underscore or blank.
    parts = [(cell[:i], cell[i + 1 :]) for i in range(1, len(cell) - 1) if cell[i] in "_ "]
    if (bracket := _IN_BRACKETS.fullmatch(cell)) is not None:
        parts.insert(0, (bracket[1], bracket[2]))
    for bare, unit in parts:
        if bare in words and unit in _DEGREES:
            return words[bare], None
        metres = unit_named(unit) if bare in words else None
        if metres is not None:
            return words[bare], UnspecifiedFoot(metres) if unit in _UNSPECIFIED_FOOT else metres
    return None


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "//"))


def _cells(where: str, line: str, delimiter: str, error: type[SurveyError]) -> list[str]:
    if len(line) > _LONGEST_LINE:
        raise error(f"{where}: the line has {len(line)} characters, expected a line of a table; correct the file")
    try:
        if delimiter == _SPACE:
            line = line.strip()
        cells = next(csv.reader([line], delimiter=delimiter, strict=True, skipinitialspace=delimiter == _SPACE), [])
        return [cell.strip() for cell in cells if delimiter != _SPACE or cell]
    except csv.Error as problem:
        raise error(f"{where}: {problem}; expected a closing quote on the same line") from problem
