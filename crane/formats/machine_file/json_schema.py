"""The JSON Schema of machine files, by which editors complete and check them."""

import math
from typing import Any

from crane.description.key_types import (
    REQUIRED,
    FileKey,
    FlagKey,
    Key,
    ListKey,
    MapKey,
    NameListKey,
    NumberKey,
    NumberListKey,
    RowListKey,
    SectionKey,
    SectionSchema,
    VariantKey,
)
from crane.description.machine_schema import EXTENDS_KEY, MACHINE

SCHEMA_FILE = "machine_file.schema.json"
_NUMBER_PATTERN = r"^\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*$"  # PyYAML reads 2e5 as text
_NULL = {"type": "null"}


def machine_file_schema() -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of machine files.

    A file with the key `extends` needs no other key, and may remove keys by empty values.
    """
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Machine file of crane",
        "if": {"type": "object", "required": [EXTENDS_KEY]},
        "then": _section(MACHINE, is_partial=True),
        "else": _section(MACHINE, is_partial=False),
        "$defs": {"number": {"type": ["number", "string"], "pattern": _NUMBER_PATTERN}},
    }


def _section(section: SectionSchema, is_partial: bool) -> dict[str, Any]:
    """A mapping with the keys of a section; partial ones need none."""
    schema: dict[str, Any] = {
        "type": "object",
        "properties": {name: _described(key, is_partial) for name, key in section.keys.items()},
        "additionalProperties": False
        if section.others is None
        else _value(section.others, is_partial),
    }
    optional = {x for pair in section.exclusive for group in pair[:2] for x in group}
    required = [
        name
        for name, key in section.keys.items()
        if key.default is REQUIRED and name not in optional
    ]
    if required and not is_partial:
        schema["required"] = required
    excluded = [
        {"not": {"required": [key, other]}}
        for first, second, _ in section.exclusive
        for key in first
        for other in second
    ]
    return schema | ({"allOf": excluded} if excluded else {})


def _described(key: Key, is_partial: bool) -> dict[str, Any]:
    """The value of a key with its text, unit, usual range and default."""
    description = key.text
    if isinstance(key, NumberKey):
        description += f" [{key.units}]" if key.units else ""
        if key.plausible is not None:
            description += f"; usual: {key.plausible.lower:g} to {key.plausible.upper:g}"
    schema = _value(key, is_partial)
    if is_partial or isinstance(key, SectionKey | MapKey | ListKey | NameListKey):
        schema = {"anyOf": [schema, _NULL]} if is_partial or key.default is None else schema
    schema = {"description": description} | schema
    if isinstance(key.default, str | float | int) and key.default != "":
        schema["default"] = key.default
    return schema


def _value(key: Key, is_partial: bool) -> dict[str, Any]:
    """The values that a key may have."""
    match key:
        case SectionKey():
            return _section(key.section, is_partial)
        case MapKey():
            item = _value(key.item, is_partial or key.has_common_item)
            item = {"anyOf": [item, _NULL]} if is_partial else item
            return {"type": "object", "additionalProperties": item}
        case ListKey():
            return {"type": "array", "items": _value(key.item, is_partial=False)}
        case VariantKey():
            return {"anyOf": [_value(x, is_partial) for x in key.types]}
        case FlagKey():
            return {"enum": [True, False, "yes", "no", "on", "off", "true", "false"]}
        case NameListKey():
            return _array({"type": "string", "minLength": 1}, key.size) | {"uniqueItems": True}
        case NumberListKey():
            return _array(_number(key), key.size)
        case RowListKey():
            return _array(_array(_number(key), key.size), None)
        case NumberKey():
            return _number(key)
        case FileKey():
            return {"type": "string", "minLength": 1}
    return {"enum": list(key.choices)} if key.choices else {"type": "string", "minLength": 1}


def _number(key: NumberKey) -> dict[str, Any]:
    schema: dict[str, Any] = {"$ref": "#/$defs/number"}
    if key.is_positive or key.zero_error and key.minimum == 0:
        schema["exclusiveMinimum"] = 0
    elif key.minimum is not None and math.isfinite(key.minimum):
        schema["minimum"] = key.minimum
    return schema


def _array(items: dict[str, Any], size: int | None) -> dict[str, Any]:
    bounds = {"minItems": 1} if size is None else {"minItems": size, "maxItems": size}
    return {"type": "array", "items": items} | bounds
