"""Tables of a TOML file as frozen dataclasses: every key known, every value of the kind that its field says."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from typing import Any

from survey.errors import ConfigError

_KINDS = {float: "a number", int: "a whole number", bool: "true or false", str: "a text in quotes"}


def table(kind: type, where: str, values: Any) -> Any:
    """A dataclass filled from a table.

    Parameters
    ----------
    kind : dataclass
        Its fields are the known keys, their types the kinds of values, their defaults what holds without them.
        Types are float, int, bool, str, tuples of them, other dataclasses, lists of these, or one of these or None.
    where : str
        Name of the table, for messages; empty for the whole file.

    Raises
    ------
    ConfigError
        At the first key that is unknown, missing or of another kind.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{where} = {_shown(values)} was found where the table [{where}] was expected")
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name in values:
        if name not in fields:
            near = difflib.get_close_matches(name, fields, 1, 0.0)
            place = f" in [{where}]" if where else ""
            raise ConfigError(f"unknown key {name}{place}; the nearest known one is {near[0]}. Correct or remove it")
    hints, found = typing.get_type_hints(kind), {}
    for name, field in fields.items():
        key = f"{where}.{name}" if where else name
        if name in values:
            found[name] = _value(hints[name], key, values[name])
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{key} is missing, expected {_words(hints[name])}; add it")
    return kind(**found)


def _value(kind: Any, key: str, value: Any) -> Any:
    if isinstance(kind, types.UnionType):
        kind = next(part for part in typing.get_args(kind) if part is not type(None))
    if dataclasses.is_dataclass(kind):
        return table(kind, key, value)
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list) or (parts[-1] is not Ellipsis and len(value) != len(parts)):
            raise ConfigError(f"{key} is {_shown(value)}, expected {_words(kind)}")
        kinds = [parts[0]] * len(value) if parts[-1] is Ellipsis else parts
        return tuple(_value(part, f"{key}[{i}]", v) for i, (part, v) in enumerate(zip(kinds, value, strict=True)))
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is float and is_number and math.isfinite(value):
        return float(value)
    if (kind is int and is_number and isinstance(value, int)) or (kind in (bool, str) and isinstance(value, kind)):
        return value
    raise ConfigError(f"{key} is {_shown(value)}, expected {_words(kind)}")


def _words(kind: Any) -> str:
    """A kind of value in words."""
    if isinstance(kind, types.UnionType):
        kind = next(part for part in typing.get_args(kind) if part is not type(None))
    if dataclasses.is_dataclass(kind):
        return "a table"
    if typing.get_origin(kind) is tuple:
        parts = typing.get_args(kind)
        count = "a list" if parts[-1] is Ellipsis else f"a list of {len(parts)}"
        return f"{count}, each {_words(parts[0])}"
    return _KINDS[kind]


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
