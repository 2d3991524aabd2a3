"""clicks.csv with one click set, moved or removed; other rows, columns and the comments before them are kept."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from survey.errors import ConfigError
from survey.files.csv_table import column_names, read_table, text_lines
from survey.photos.names import ImageNames

_COLUMNS = ("image", "x", "y", "name")


@dataclass(frozen=True)
class ClickRow:
    """A row: the photograph as the survey calls it, None where it has none; pixel, name of the place, all cells."""

    image: str | None
    pixel: tuple[float, float]
    name: str
    cells: tuple[tuple[str, str], ...]


def read_clicks(path: Path, images: Iterable[str]) -> list[ClickRow]:
    """The rows of a table of clicks; none where there is no file.

    Raises
    ------
    ConfigError
        If the file is damaged.
    """
    if not path.is_file():
        return []
    others = tuple(name for name in column_names(path) if name not in _COLUMNS)
    names = ImageNames(images)
    found = []
    for row in read_table(path, _COLUMNS, optional=others, error=ConfigError):
        # The decimal comma goes with the separators of the file.
        cells = row.cells | {"x": f"{row.number('x'):.10g}", "y": f"{row.number('y'):.10g}"}
        if cells.get("std"):
            cells["std"] = f"{row.number('std'):.10g}"
        pixel = (row.number("x"), row.number("y"))
        found.append(ClickRow(names.find(row.text("image"), row.where), pixel, row.text("name"), tuple(cells.items())))
    return found


def with_click(path: Path, name: str, image: str, pixel: tuple[float, float] | None, images: Iterable[str]) -> str:
    """The text of a table of clicks with the click on a place in a photograph; None as pixel removes it.

    Raises
    ------
    ConfigError
        If the file is damaged.
    """
    rows = read_clicks(path, images)
    at = next((i for i, row in enumerate(rows) if (row.name, row.image) == (name, image)), len(rows))
    before = dict(rows[at].cells) if at < len(rows) else {"image": image, "name": name}
    # A place has one click in a photograph.
    rows = [row for i, row in enumerate(rows) if i == at or (row.name, row.image) != (name, image)]
    if pixel is None:
        rows = rows[:at] + rows[at + 1 :]
    else:
        cells = before | {"x": f"{pixel[0]:.3f}", "y": f"{pixel[1]:.3f}"}
        changed = ClickRow(image, pixel, name, tuple(cells.items()))
        rows = [*rows[:at], changed, *rows[at + 1 :]]
    return _text(path, [dict(row.cells) for row in rows])


def _text(path: Path, rows: list[dict[str, str]]) -> str:
    said = list(text_lines(path, ConfigError)) if path.is_file() else []
    comments = []
    for _, line in said:
        if line.strip() and not line.lstrip().startswith("#"):
            break
        comments.append(line)
    columns = list(column_names(path)) if said else list(_COLUMNS)
    written = io.StringIO()
    table = csv.DictWriter(written, columns or _COLUMNS, restval="", lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return "".join(f"{line}\n" for line in comments) + written.getvalue()
