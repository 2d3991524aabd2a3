"""Values converted for JSON, and JSON files written completely or not at all."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np

from geo.files import write_text
from survey.errors import SurveyError
from survey.files.foreign import LARGEST


def plain(value):
    """A value as JSON knows it: numpy scalars and arrays, tuples and dataclasses undone; NaN and infinity as None.

    What JSON has no form for, e.g. a path or a CRS, becomes its text.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)


def json_text(value) -> str:
    """A value as indented JSON, see `plain`."""
    return json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def read_json_object(path: str | Path) -> dict:
    """The object in a JSON file in UTF-8; empty where the file is missing, damaged, or holds something else."""
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def write_json(path: str | Path, value) -> None:
    """Write a value as an indented JSON file in UTF-8, whole or not at all; see `plain`."""
    write_text(path, json_text(value))


def read_foreign_json(path: Path, error: type[SurveyError]):
    """The value in a JSON file of another program, in UTF-8 with or without a byte order mark.

    Numbers of more digits than any has become what float makes of them, infinity included.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
        return json.loads(text, parse_int=lambda digits: int(digits) if len(digits) < 20 else float(digits))
    except OSError as problem:
        raise error(f"{path} cannot be read ({problem.strerror}); correct its name or its permissions") from problem
    except RecursionError as problem:
        raise error(f"{path} is nested too deeply for a file of poses or control points; export it again") from problem
    except ValueError as problem:
        raise error(f"{path} is not valid JSON ({problem}); export it again") from problem


def finite_numbers(value, count: int) -> list[float] | None:
    """A list of so many finite numbers from JSON; None if it is anything else."""
    if not isinstance(value, list | tuple) or len(value) != count:
        return None
    found = [finite_number(item) for item in value]
    return None if None in found else [number for number in found if number is not None]


def finite_number(value) -> float | None:
    """A finite number from JSON of at most `LARGEST` in size; None if it is anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        return None
    return float(value)
