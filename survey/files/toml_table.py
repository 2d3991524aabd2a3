"""Tables of a TOML file as frozen dataclasses, their keys and types checked, and their JSON schema for editors.

A dataclass is the schema of a table: its fields are the known keys, their types those of the values, their defaults
the values of missing keys, with words and limits (`key`). Its ``__post_init__`` checks how keys go together.
"""

import dataclasses
import difflib
import operator
import re
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from survey.errors import ConfigError
from survey.words import LARGEST, instead_of_word

# Bytes of settings at most; those with all keys and comments have 10 kB.
_MOST_BYTES = 1_000_000
# Of each type its words in messages, and its name in a schema.
_KINDS = {
    float: (f"a finite number of at most {LARGEST:g} in size", "number"),
    int: ("a whole number", "integer"),
    bool: ("true or false", "boolean"),
    str: ("a text in quotes", "string"),
}
# Of each limit its test, its words in messages, and its name in a schema.
_LIMITS: dict[str, tuple[Callable[[float, float], bool], str, str]] = {
    "above": (operator.gt, "above", "exclusiveMinimum"),
    "least": (operator.ge, "of at least", "minimum"),
    "below": (operator.lt, "below", "exclusiveMaximum"),
    "most": (operator.le, "at most", "maximum"),
}
# Share of letters that two near names have in common, in order: "level" and "level_m", not "gcp" and "gps_height".
_NEAR = 0.6
# Metadata of a field: see `key`.
EXPECTED, ONE_OF, LIMITS, OPTION, OPTION_ALONE = "expected", "one_of", "limits", "option", "option_alone"
# A number in any form; signs that backslashes of a path become.
_NUMBER_IN_LIST = re.compile(r"\[\d+\]")
_NUMBER, _CONTROL = re.compile(r"[+-]?[\d.,' ]*\d[\d.,' ]*(\s*[A-Za-z%°]+)?"), re.compile(r"[\x00-\x1f\x7f]")


@dataclasses.dataclass(frozen=True)
class Option:
    panel: str
    metavar: str | None  # What stands for its value in the help
    help: str
    # With its dashes; default: as the field is called. A boolean without a name has its opposite, --no-..., too
    name: str | None = None


def key(
    default: Any,
    expected: str = "",
    *,
    one_of: Iterable[Any] = (),
    option: Option | None = None,
    alone: bool = False,
    **limits: float,
) -> Any:
    """A field of a table with its own wording of what is expected, e.g. "[width, height] in pixels".

    By default that are the values in ``one_of``, where few are known, or what the type says. ``limits`` of a number, or
    of each in a list, are above, least, below and most. ``option`` of the command line sets it, `alone` where it is no
    key of the table.
    """
    words = tuple(one_of)
    listed = ", ".join(f"{word:g}" if isinstance(word, float) else str(word) for word in words)
    expected = expected or (f"one of {listed}" if words else "")
    metadata = {EXPECTED: expected, ONE_OF: words, LIMITS: limits, OPTION_ALONE: alone}
    return dataclasses.field(default=default, metadata=metadata | ({} if option is None else {OPTION: option}))


def std_key(most: float, unit: str, example: str, form: str = "") -> Any:
    """A field for a standard deviation, or for one of each direction: ``form`` then says which."""
    of = f"{most:g} {unit}".strip() + (f", {form}" if form else "")
    return key(None, f"a standard deviation above 0 and at most {of}; {example}", above=0.0, most=most)


def option(
    panel: str,
    metavar: str | None,
    help: str,
    *,
    name: str | None = None,
    default: Any = None,
    one_of: Iterable[Any] = (),
    **of_key: Any,
) -> Any:
    """A `key` that an option of the command line sets; the placeholder may be made of the words that are known."""
    words = tuple(one_of)
    made = Option(panel, metavar or "|".join(words) or None, help, name)
    return key(default, one_of=words, option=made, **of_key)


def option_name(field: dataclasses.Field) -> str:
    """The option of the command line that sets a field."""
    return field.metadata[OPTION].name or f"--{field.name.replace('_', '-')}"


def require_options(record: Any) -> None:
    """Raise ConfigError where the value of a field that an option sets is none that it takes."""
    require_valid(record, type(record), option_name)


def require_valid(record: Any, table: type, name_of: Callable[[dataclasses.Field], str]) -> None:
    """Raise ConfigError where a value that no file gave is none that its key in a table takes."""
    for field in dataclasses.fields(table):
        if (value := getattr(record, field.name, None)) is not None:
            _require_valid(field, name_of(field), value)


def _require_valid(field: dataclasses.Field, name: str, value: Any) -> None:
    words, limits, expected = (field.metadata.get(part) for part in (ONE_OF, LIMITS, EXPECTED))
    shown = str(list(value)) if isinstance(value, tuple) else f"{value:g}" if isinstance(value, float) else str(value)
    if words and value not in words:
        shown = f'"{value}"' if isinstance(value, str) else shown
        raise ConfigError(f"{name} is {shown}, expected {expected}{instead_of_word(value)}")
    numbers, limits = value if isinstance(value, tuple) else (value,), limits or {}
    if not all(_LIMITS[word][0](number, limit) for word, limit in limits.items() for number in numbers):
        in_words = " and ".join(f"{_LIMITS[word][1]} {limit:g}" for word, limit in limits.items())
        raise ConfigError(f"{name} is {shown}, expected {expected or f'a number {in_words}'}")


def require_with(table: str, record: Any, other: str, names: Iterable[str], remedy: str = "") -> None:
    """Raise ConfigError where one of some keys is given without another that it belongs to."""
    for name in names:
        if getattr(record, other) is None and getattr(record, name) is not None:
            remedies = f"give both{', ' * bool(remedy)}{remedy}"
            raise ConfigError(f"[{table}] {name} is given without {other}, to which it belongs; {remedies}")


def fields_of(kind: type) -> Iterator[tuple[dataclasses.Field, Any]]:
    """Fields of a table with their types."""
    hints = typing.get_type_hints(kind)
    return ((field, hints[field.name]) for field in _keys_of(kind))


def _keys_of(record: Any) -> Iterator[dataclasses.Field]:
    return (field for field in dataclasses.fields(record) if not field.metadata.get(OPTION_ALONE))


def table_of(record: Any) -> dict[str, Any]:
    """The values of a dataclass by the keys that they have in a file, those of inner tables as dicts."""
    values = {field.name: getattr(record, field.name) for field in _keys_of(record)}
    return {name: table_of(value) if dataclasses.is_dataclass(value) else value for name, value in values.items()}


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


def parse_values(values: Mapping[str, Any], kind: type) -> Any:
    """A dataclass filled from values as TOML has them; see `parse_toml`."""
    return _Reader(kind, {}).table(kind, "", dict(values))


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


@dataclasses.dataclass(frozen=True)
class _Reader:
    root: type
    synonyms: Mapping[str, str]

    def table(self, kind: type, where: str, values: Any) -> Any:
        """A dataclass from a table whose dotted name is `where`; empty for the whole file."""
        if not isinstance(values, dict):
            raise ConfigError(f"{where} = {values!r} was found where the table [{where}] was expected")
        known, arguments = dict((field.name, (field, hint)) for field, hint in fields_of(kind)), {}
        for name, value in values.items():
            if name not in known:
                raise ConfigError(self._unknown(list(known), where, name, value))
        for name, (field, hint) in known.items():
            dotted, expected = _join(where, name), field.metadata.get(EXPECTED) or _words(hint)
            if name in values:
                arguments[name] = self._value(hint, dotted, values[name], expected)
                _require_valid(field, dotted, arguments[name])
            elif _is_required(field):
                raise ConfigError(f"{dotted} is missing, expected {expected}; add it")
        try:
            return kind(**arguments)
        except ConfigError:
            raise
        except ValueError as error:
            raise ConfigError(f"{where}.{error}") from error

    def _value(self, kind: Any, dotted: str, value: Any, expected: str) -> Any:
        is_list, hint = isinstance(value, list), ""
        if isinstance(kind, types.UnionType):
            parts = [part for part in typing.get_args(kind) if part is not type(None)]
            kind = next((part for part in parts if (typing.get_origin(part) is tuple) == is_list), parts[0])
        if dataclasses.is_dataclass(kind):
            return self.table(typing.cast("type", kind), dotted, value)
        if typing.get_origin(kind) is tuple:
            parts = list(typing.get_args(kind))
            if is_list and parts[-1] is Ellipsis:
                parts = parts[:1] * len(value)
            if is_list and len(value) == len(parts):
                named = ((part, f"{dotted}[{i}]") for i, part in enumerate(parts))
                return tuple(self._value(*of, item, _words(of[0])) for of, item in zip(named, value, strict=True))
            hint = f"; {_POINT}" if is_list and len(value) == 2 * len(parts) else ""
        elif self._is_of(kind, value):
            if kind is str and _CONTROL.search(value):
                raise ConfigError(f"{dotted} is {value!r}, expected a text of one line; {_SLASHES}")
            return float(value) if kind is float else value
        elif isinstance(value, str) and kind in (float, int) and _NUMBER.fullmatch(value.strip()):
            hint = f"; {_POINT}, without quotes"
        raise ConfigError(f"{dotted} is {value!r}, expected {expected}{hint}")

    @staticmethod
    def _is_of(kind: type, value: Any) -> bool:
        if kind is str:
            return isinstance(value, str) and bool(value.strip())
        if kind is bool or isinstance(value, bool):
            return kind is bool and isinstance(value, bool)
        return isinstance(value, int) if kind is int else isinstance(value, int | float) and abs(value) <= LARGEST

    def _unknown(self, known: list[str], where: str, name: str, value: Any) -> str:
        """A sentence on an unknown key, with the right name, the nearest one, or all known keys."""
        is_table = isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))
        what = f"table [{_join(where, name)}]" if is_table else f"key {name}" + (f" in [{where}]" if where else "")
        # A table is compared with tables and a key with keys.
        everywhere = dict(_all_keys(self.root))
        table = _NUMBER_IN_LIST.sub("", where)
        same_kind = [other for other in known if everywhere[_join(table, other)] == is_table]
        near = difflib.get_close_matches(name, same_kind, 1, _NEAR)
        elsewhere = [path for path in everywhere if path.split(".")[-1] == name]
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
        return f"unknown {what}; {remedy}"


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _all_keys(kind: type, where: str = "") -> Iterator[tuple[str, bool]]:
    """Dotted names of all keys under a table, and whether each is a table itself."""
    for field, hint in fields_of(kind):
        inner = _table_in(hint)
        yield _join(where, field.name), inner is not None
        if inner is not None:
            yield from _all_keys(inner, _join(where, field.name))


def _table_in(kind: Any) -> type | None:
    """The table that a type is, or that a union or tuple has."""
    if dataclasses.is_dataclass(kind):
        return typing.cast("type", kind)
    return next((table for part in typing.get_args(kind) if (table := _table_in(part)) is not None), None)


def _join(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _place(dotted: str, is_table: bool = False) -> str:
    """A dotted name as written in a file, e.g. "[water] level_m"."""
    table, _, name = dotted.rpartition(".")
    if is_table:
        return f"[{dotted}]"
    return f"[{table}] {name}" if table else f"{name}, above the first table"


def _words(kind: Any) -> str:
    parts = typing.get_args(kind)
    if isinstance(kind, types.UnionType):
        return " or ".join(dict.fromkeys(_words(part) for part in parts if part is not type(None)))
    if typing.get_origin(kind) is tuple:
        return f"a list{'' if parts[-1] is Ellipsis else f' of {len(parts)}'}, each {_words(parts[0])}"
    return "a table" if dataclasses.is_dataclass(kind) else _KINDS[kind][0]


def schema_of(kind: type) -> dict[str, Any]:
    """The JSON schema of a whole file, of a dataclass as `parse_toml` takes it."""
    return {"$schema": "http://json-schema.org/draft-07/schema#", **_table_schema(kind)}


def _table_schema(kind: type) -> dict[str, Any]:
    return {
        "type": "object",
        "description": (kind.__doc__ or "").partition("\n")[0],
        "properties": {field.name: _key_schema(hint, field) for field, hint in fields_of(kind)},
        "required": [field.name for field, _ in fields_of(kind) if _is_required(field)],
        "additionalProperties": False,
    }


def _key_schema(kind: Any, field: dataclasses.Field) -> dict[str, Any]:
    words, limits, expected = (field.metadata.get(part) for part in (ONE_OF, LIMITS, EXPECTED))
    schema: dict[str, Any] = {"enum": list(words)} if words else _value_schema(kind, limits or {})
    if expected:
        schema["description"] = expected
    if field.default is not dataclasses.MISSING and field.default is not None:
        schema["default"] = field.default
    return schema


def _value_schema(kind: Any, limits: Mapping[str, float]) -> dict[str, Any]:
    parts = [part for part in typing.get_args(kind) if part is not type(None)]
    if isinstance(kind, types.UnionType):
        schemas = [_value_schema(part, limits) for part in parts]
        return schemas[0] if len(schemas) == 1 else {"anyOf": schemas}
    if dataclasses.is_dataclass(kind):
        return _table_schema(typing.cast("type", kind))
    if typing.get_origin(kind) is tuple:
        length = {} if parts[-1] is Ellipsis else {"minItems": len(parts), "maxItems": len(parts)}
        return {"type": "array", "items": _value_schema(parts[0], limits), **length}
    return {"type": _KINDS[kind][1], **{_LIMITS[word][2]: limit for word, limit in limits.items()}}
