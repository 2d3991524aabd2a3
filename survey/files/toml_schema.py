"""The JSON schema of a table, from the dataclass that it is read into: editors complete and check a file by it."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator
from typing import Any

from survey.files.toml_table import EXPECTED, ONE_OF, is_inline

_KINDS = {float: "number", int: "integer", bool: "boolean", str: "string"}


def schema_of(kind: type) -> dict[str, Any]:
    """The schema of a whole file.

    Parameters
    ----------
    kind : dataclass
        As `survey.files.toml_table.parse_toml` takes it.
    """
    return {"$schema": "http://json-schema.org/draft-07/schema#", **_table(kind)}


def _table(kind: type) -> dict[str, Any]:
    keys = list(_fields_of(kind))
    return {
        "type": "object",
        "description": (kind.__doc__ or "").partition("\n")[0],
        "properties": {field.name: _key(hint, field) for field, hint in keys},
        "required": [field.name for field, _ in keys if _is_required(field)],
        "additionalProperties": False,
    }


def _fields_of(kind: type) -> Iterator[tuple[dataclasses.Field, Any]]:
    """Fields of a table with their types, those of inline records among them."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        if is_inline(field):
            yield from _fields_of(hints[field.name])
        else:
            yield field, hints[field.name]


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _key(kind: Any, field: dataclasses.Field) -> dict[str, Any]:
    schema = _value(kind)
    if field.metadata.get(ONE_OF):
        schema = {"enum": list(field.metadata[ONE_OF])}
    if field.metadata.get(EXPECTED):
        schema["description"] = field.metadata[EXPECTED]
    if field.default is not dataclasses.MISSING and field.default is not None:
        schema["default"] = field.default
    return schema


def _value(kind: Any) -> dict[str, Any]:
    if isinstance(kind, types.UnionType):
        schemas = [_value(part) for part in typing.get_args(kind) if part is not type(None)]
        return schemas[0] if len(schemas) == 1 else {"anyOf": schemas}
    if dataclasses.is_dataclass(kind):
        return _table(typing.cast("type", kind))
    if typing.get_origin(kind) is tuple:
        parts = typing.get_args(kind)
        length = {} if parts[-1] is Ellipsis else {"minItems": len(parts), "maxItems": len(parts)}
        return {"type": "array", "items": _value(parts[0]), **length}
    return {"type": _KINDS[kind]}
