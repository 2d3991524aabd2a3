"""The JSON schema of a table of a TOML file, for editors."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any

from survey.files.toml_table import EXPECTED, LIMITS, ONE_OF, fields_of

_KINDS = {float: "number", int: "integer", bool: "boolean", str: "string"}


def schema_of(kind: type) -> dict[str, Any]:
    """The schema of a whole file, of a dataclass as `parse_toml` takes it."""
    return {"$schema": "http://json-schema.org/draft-07/schema#", **_table(kind)}


def _table(kind: type) -> dict[str, Any]:
    keys = list(fields_of(kind))
    return {
        "type": "object",
        "description": (kind.__doc__ or "").partition("\n")[0],
        "properties": {field.name: _key(hint, field) for field, hint in keys},
        "required": [field.name for field, _ in keys if _is_required(field)],
        "additionalProperties": False,
    }


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _key(kind: Any, field: dataclasses.Field) -> dict[str, Any]:
    schema = _value(kind, field.metadata.get(LIMITS, {}))
    if field.metadata.get(ONE_OF):
        schema = {"enum": list(field.metadata[ONE_OF])}
    if field.metadata.get(EXPECTED):
        schema["description"] = field.metadata[EXPECTED]
    if field.default is not dataclasses.MISSING and field.default is not None:
        schema["default"] = field.default
    return schema


def _value(kind: Any, limits: Mapping[str, float]) -> dict[str, Any]:
    if isinstance(kind, types.UnionType):
        schemas = [_value(part, limits) for part in typing.get_args(kind) if part is not type(None)]
        return schemas[0] if len(schemas) == 1 else {"anyOf": schemas}
    if dataclasses.is_dataclass(kind):
        return _table(typing.cast("type", kind))
    if typing.get_origin(kind) is tuple:
        parts = typing.get_args(kind)
        length = {} if parts[-1] is Ellipsis else {"minItems": len(parts), "maxItems": len(parts)}
        return {"type": "array", "items": _value(parts[0], limits), **length}
    return {"type": _KINDS[kind], **limits}
