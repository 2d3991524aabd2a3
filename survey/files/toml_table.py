"""Tables of a TOML file as frozen dataclasses, their keys and types checked.

A dataclass is the schema of a table: its fields are the known keys, their types those of the values, their defaults
the values of missing keys, with words and ranges (`key`). Its ``__post_init__`` checks how keys go together.
"""

from __future__ import annotations

import dataclasses
import difflib
import operator
import re
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from survey.errors import ConfigError
from survey.files.limits import LARGEST
from survey.words import instead_of_word

# Bytes of settings at most; those with all keys and comments have 10 kB.
_MOST_BYTES = 1_000_000
_KINDS = {
    float: f"a finite number of at most {LARGEST:g} in size",
    int: "a whole number",
    bool: "true or false",
    str: "a text in quotes",
}
# Share of letters that two near names have in common, in order: "level" and "level_m", not "gcp" and "gps_height".
_NEAR = 0.6
# Metadata of a field: a description of valid values, for the error message; all of them, where they are few; limits of
# its numbers, by their words in a schema; the option of the command line that sets it; True where it is an option alone
# and no key of the table.
EXPECTED, ONE_OF, LIMITS, OPTION, OPTION_ALONE = "expected", "one_of", "limits", "option", "option_alone"
_HOLDS: dict[str, Callable[[float, float], bool]] = {
    "exclusiveMinimum": operator.gt, "minimum": operator.ge, "exclusiveMaximum": operator.lt, "maximum": operator.le,
}  # fmt: skip
_LIMIT_IN_WORDS = dict(zip(_HOLDS, ("above", "of at least", "below", "at most"), strict=True))
_WORD_OF_LIMIT = dict(zip(("above", "least", "below", "most"), _HOLDS, strict=True))
# Metadata of a field whose record has keys of the table that it stands in, those that belong together.
INLINE = {"inline": True}
# A number in any form; signs that backslashes of a path become.
_NUMBER, _CONTROL = re.compile(r"[+-]?[\d.,' ]*\d[\d.,' ]*(\s*[A-Za-z%°]+)?"), re.compile(r"[\x00-\x1f\x7f]")


def key(default: Any, expected: str = "", *, one_of: Iterable[Any] = (), **limits: float) -> Any:
    """A field of a table with its own wording of what is expected, e.g. "[width, height] in pixels".

    By default that are the values in ``one_of``, where few are known, or what the type says. ``limits`` of a number, or
    of each in a list, are above, least, below and most.
    """
    return dataclasses.field(default=default, metadata=_metadata(expected, one_of, limits))


def _metadata(expected: str, one_of: Iterable[Any], limits: Mapping[str, float]) -> dict[str, Any]:
    words = tuple(one_of)
    listed = ", ".join(f"{word:g}" if isinstance(word, float) else str(word) for word in words)
    return {
        EXPECTED: expected or (f"one of {listed}" if words else ""),
        ONE_OF: words,
        LIMITS: {_WORD_OF_LIMIT[name]: limit for name, limit in limits.items()},
    }


def std_key(most: float, unit: str, example: str, form: str = "") -> Any:
    """A field for a standard deviation, or for one of each direction: ``form`` then says which."""
    of = f"{most:g} {unit}".strip() + (f", {form}" if form else "")
    return key(None, f"a standard deviation above 0 and at most {of}; {example}", above=0.0, most=most)


@dataclasses.dataclass(frozen=True)
class Option:
    """An option of the command line."""

    panel: str
    metavar: str | None  # What stands for its value in the help
    help: str
    # With its dashes; default: as the field is called. A boolean without a name has its opposite, --no-..., too
    name: str | None = None


def option(
    panel: str,
    metavar: str | None,
    help: str,
    *,
    name: str | None = None,
    default: Any = None,
    expected: str = "",
    one_of: Iterable[Any] = (),
    alone: bool = False,
    **limits: float,
) -> Any:
    """A field that an option of the command line sets, and, unless it is `alone`, a key of a table, as `key` has it.

    Where a few words are known and nothing else is said, the placeholder is made of them, too.
    """
    words = tuple(one_of)
    made = Option(panel, metavar or "|".join(words) or None, help, name)
    return dataclasses.field(
        default=default, metadata={**_metadata(expected, words, limits), OPTION: made, OPTION_ALONE: alone}
    )


def option_name(field: dataclasses.Field) -> str:
    """The option of the command line that sets a field."""
    return field.metadata[OPTION].name or f"--{field.name.replace('_', '-')}"


def require_options(record: Any) -> None:
    """Raise ConfigError where the value of a field that an option sets is none that it takes."""
    require_valid(record, type(record), option_name)


def keys_of(record: Any) -> Iterator[dataclasses.Field]:
    """The fields of a dataclass, or of one of its values, that are keys of its table or hold some of them."""
    return (field for field in dataclasses.fields(record) if not field.metadata.get(OPTION_ALONE))


def is_inline(field: dataclasses.Field) -> bool:
    """Whether the fields of a field's record are keys of the table itself."""
    return field.metadata == INLINE


def table_of(record: Any) -> dict[str, Any]:
    """The values of a dataclass by the keys that they have in a file, those of inner tables as dicts."""
    values: dict[str, Any] = {}
    for field in keys_of(record):
        value = getattr(record, field.name)
        if is_inline(field):
            values |= table_of(value)
        else:
            values[field.name] = table_of(value) if dataclasses.is_dataclass(value) else value
    return values


def read_toml(path: Path, parse: Callable[[str], Any]) -> Any:
    """Result of `parse` for the text of a TOML file."""
    try:
        size = path.stat().st_size
        if size > _MOST_BYTES:
            raise ConfigError(f"has {size / 1e6:.0f} MB, expected settings of a few lines; correct it")
        return parse(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be read ({error.strerror}); correct its name or its permissions") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def parse_toml(text: str, kind: type, *, synonyms: Mapping[str, str] | None = None) -> Any:
    """A dataclass filled from a text in TOML.

    Types of its fields are float, int, bool, str, tuples of them, other dataclasses (tables), tuples of these (arrays
    of tables), or a union of these and None. ``synonyms``: what other programs call a key, to its dotted name here, as
    ``{"gcp": "control.gcps"}``.
    """
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"not valid TOML: {error}; {_advice(text, error)}") from error
    except RecursionError as error:
        raise ConfigError("its tables and lists are nested too deeply for settings; correct it") from error
    return _Reader(kind, synonyms or {}).table(kind, "", tables)


_POINT = "write numbers with a decimal point and without separators, as 1234.5"
_SLASHES = "write paths with /, as C:/data, or in single quotes, since a backslash begins a sign such as a line break"
# What people write in lines that are no TOML, and what to write instead.
_HABITS = (
    (r"=\s*\[?\s*[+-]?[\d.' ]*\d,\d", _POINT),
    (r"=\s*\[?\s*[+-]?\d+[.' ]\d+[.' ]\d", _POINT),
    (r"=\s*\[?\s*[+-]?[\d.]+\s*[A-Za-z°%µ]", "write numbers without a unit: the key names it"),
    (r"[“”„‘’«»]", 'write straight quotes, as "text"'),
    (r"=\s*\".*\\", _SLASHES),
    (r"=\s*(True|False|TRUE|FALSE|yes|no|Yes|No|on|off)\b", "write true or false, in lower case"),
    (r"=\s*[^\s\d\[{\"'+-]", 'write texts in quotes, as "text"'),
    (r"^\s*[\w.]+\s*:\s", "write = between a key and its value"),
)


def _advice(text: str, error: tomllib.TOMLDecodeError) -> str:
    """How to correct the line in which an error was found."""
    number, lines = re.search(r"at line (\d+)", str(error)), text.splitlines()
    line = lines[int(number[1]) - 1] if number is not None and int(number[1]) <= len(lines) else ""
    known = next((advice for pattern, advice in _HABITS if re.search(pattern, line)), None)
    return "correct that line" if known is None else f"in {line.strip()!r}, {known}"


def parse_values(values: Mapping[str, Any], kind: type) -> Any:
    """A dataclass filled from values as TOML has them; see `parse_toml`."""
    return _Reader(kind, {}).table(kind, "", dict(values))


def require_valid(record: Any, table: type, name_of: Callable[[dataclasses.Field], str]) -> None:
    """Raise ConfigError where a value that no file gave is none that its key in a table takes."""
    for field in dataclasses.fields(table):
        if (value := getattr(record, field.name, None)) is not None:
            _require_valid(field, name_of(field), value)


def _require_valid(field: dataclasses.Field, name: str, value: Any) -> None:
    words, limits = field.metadata.get(ONE_OF), field.metadata.get(LIMITS, {})
    if words and value not in words:
        raise ConfigError(f"{name} is {_shown(value)}, expected {field.metadata[EXPECTED]}{instead_of_word(value)}")
    numbers = value if isinstance(value, tuple) else (value,)
    if not all(_HOLDS[word](number, limit) for word, limit in limits.items() for number in numbers):
        expected = " and ".join(f"{_LIMIT_IN_WORDS[word]} {limit:g}" for word, limit in limits.items())
        expected = field.metadata[EXPECTED] or f"a number {expected}"
        raise ConfigError(f"{name} is {_shown(value)}, expected {expected}")


def _shown(value: float | str | tuple) -> str:
    if isinstance(value, tuple):
        return str(list(value))
    return f'"{value}"' if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)


@dataclasses.dataclass(frozen=True)
class _Reader:
    root: type
    synonyms: Mapping[str, str]

    def table(self, kind: type, where: str, values: Any) -> Any:
        """A dataclass from a table whose dotted name is `where`; empty for the whole file."""
        if not isinstance(values, dict):
            raise ConfigError(f"{where} = {values!r} was found where the table [{where}] was expected")
        known = [field.name for field, _ in fields_of(kind)]
        for name, value in values.items():
            if name not in known:
                self._refuse(known, where, name, value)
        return self._record(kind, where, values)

    def _record(self, kind: type, where: str, values: Mapping[str, Any]) -> Any:
        """A dataclass from the values of its keys, with the records whose keys stand in the same table."""
        hints, found = typing.get_type_hints(kind), {}
        for field in keys_of(kind):
            if is_inline(field):
                found[field.name] = self._record(hints[field.name], where, values)
                continue
            name = field.name
            dotted = f"{where}.{name}" if where else name
            expected = field.metadata.get(EXPECTED) or _words(hints[name])
            if name in values:
                found[name] = self._value(hints[name], dotted, values[name], expected)
                _require_valid(field, dotted, found[name])
            elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise ConfigError(f"{dotted} is missing, expected {expected}; add it")
        try:
            return kind(**found)
        except ConfigError:
            raise
        except ValueError as error:
            raise ConfigError(f"{where}.{error}") from error

    def _value(self, kind: Any, dotted: str, value: Any, expected: str) -> Any:
        if isinstance(kind, types.UnionType):
            parts = [part for part in typing.get_args(kind) if part is not type(None)]
            of_list = [part for part in parts if (typing.get_origin(part) is tuple) == isinstance(value, list)]
            kind = (of_list or parts)[0]
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            return self.table(kind, dotted, value)
        if typing.get_origin(kind) is tuple:
            return self._tuple(typing.get_args(kind), dotted, value, expected)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if kind is float and is_number and abs(value) <= LARGEST:
            return float(value)
        if kind is str and isinstance(value, str) and value.strip():
            if _CONTROL.search(value):
                raise ConfigError(f"{dotted} is {value!r}, expected a text of one line; {_SLASHES}")
            return value
        if (kind is int and is_number and isinstance(value, int)) or (kind is bool and isinstance(value, bool)):
            return value
        is_text_of_number = isinstance(value, str) and kind in (float, int) and _NUMBER.fullmatch(value.strip())
        hint = f"; {_POINT}, without quotes" if is_text_of_number else ""
        raise ConfigError(f"{dotted} is {value!r}, expected {expected}{hint}")

    def _tuple(self, parts: tuple, dotted: str, value: Any, expected: str) -> tuple:
        if not isinstance(value, list) or (parts[-1] is not Ellipsis and len(value) != len(parts)):
            is_halved = isinstance(value, list) and len(value) == 2 * len(parts) and parts[-1] is not Ellipsis
            raise ConfigError(f"{dotted} is {value!r}, expected {expected}{f'; {_POINT}' if is_halved else ''}")
        kinds = [parts[0]] * len(value) if parts[-1] is Ellipsis else parts
        return tuple(
            self._value(part, f"{dotted}[{i}]", v, _words(part))
            for i, (part, v) in enumerate(zip(kinds, value, strict=True))
        )

    def _refuse(self, known: Sequence[str], where: str, name: str, value: Any) -> typing.NoReturn:
        """Raise ConfigError for an unknown key, with the right name, the nearest one, or all known keys."""
        dotted = f"{where}.{name}" if where else name
        is_table = isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))
        what = f"table [{dotted}]" if is_table else f"key {name}" + (f" in [{where}]" if where else "")
        # A table is compared with tables and a key with keys.
        everywhere = list(_all_keys(self.root))
        tables = {path for path, has_keys in everywhere if has_keys}
        same_kind = [other for other in known if (_join(where, other) in tables) == is_table]
        near = difflib.get_close_matches(name, same_kind, 1, _NEAR)
        elsewhere = [path for path, _ in everywhere if path.split(".")[-1] == name]
        synonym = self.synonyms.get(name.casefold())
        # What other programs call it is surer than what looks alike.
        is_here = synonym is not None and _join(where, synonym.split(".")[-1]) == synonym
        if near and not is_here:
            remedy = f"the nearest known one is {_place(_join(where, near[0]), is_table)}. Correct or remove it"
        elif elsewhere and not is_here:
            remedy = f"it belongs to {_place(elsewhere[0])}. Move it there, or remove it"
        elif synonym is not None:
            remedy = f"that is {_place(synonym)} here. Correct or remove it"
        else:
            listed = ", ".join(f"[{_join(where, other)}]" if is_table else other for other in same_kind)
            remedy = f"known are {listed or 'none'}. Correct or remove it"
        raise ConfigError(f"unknown {what}; {remedy}")


def _all_keys(kind: type, where: str = "") -> Iterator[tuple[str, bool]]:
    """Dotted names of all keys under a table, and whether each is a table itself."""
    for field, hint in fields_of(kind):
        dotted = _join(where, field.name)
        inner = [part for part in _parts(hint) if isinstance(part, type) and dataclasses.is_dataclass(part)]
        yield dotted, bool(inner)
        if inner:
            yield from _all_keys(inner[0], dotted)


def _parts(kind: Any) -> Iterator[Any]:
    """A type, and the members of a union or a tuple."""
    yield kind
    for part in typing.get_args(kind):
        yield from _parts(part)


def _join(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _place(dotted: str, is_table: bool = False) -> str:
    """A dotted name as written in a file, e.g. "[water] level_m"."""
    table, _, name = dotted.rpartition(".")
    if is_table:
        return f"[{dotted}]"
    return f"[{table}] {name}" if table else f"{name}, above the first table"


def _words(kind: Any) -> str:
    """A kind of value in words."""
    if isinstance(kind, types.UnionType):
        return " or ".join(dict.fromkeys(_words(part) for part in typing.get_args(kind) if part is not type(None)))
    if dataclasses.is_dataclass(kind):
        return "a table"
    if typing.get_origin(kind) is tuple:
        parts = typing.get_args(kind)
        count = "a list" if parts[-1] is Ellipsis else f"a list of {len(parts)}"
        return f"{count}, each {_words(parts[0])}"
    return _KINDS[kind]


def fields_of(kind: type) -> Iterator[tuple[dataclasses.Field, Any]]:
    """Fields of a table with their types, those of inline records among them."""
    hints = typing.get_type_hints(kind)
    for field in keys_of(kind):
        if is_inline(field):
            yield from fields_of(hints[field.name])
        else:
            yield field, hints[field.name]
