"""Values converted for JSON, and JSON files written completely or not at all."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np

from geo.files import write_text


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
