"""The JSON Schema of machine files, by which editors complete and check them."""

import json
import re
from pathlib import Path
from typing import Any

from crane.common.unit_conversions import NUMBER_PATTERN, accepted_units, unit_names, unit_size
from crane.description.key_types import (
    QUANTITY_UNIT,
    REQUIRED,
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
from crane.description.kinematic_tree import unique_name
from crane.description.machine_schema import EXTENDS_KEY, MACHINE

SCHEMA_PATH = Path(__file__).with_name("machine_file.schema.json")  # shipped with the package
_NUMBER_OR_NONE = ["number", "string", "null"]
# products of units, which only the reader tells apart
_COMPOUND_UNIT = r"1\s*/.*|[^\s%:0-9]+(?:[*/·^(²³0-9].*|\s+\S.*)"
_RATIO = r"%|:\s*[1-9][0-9]*"


def schema_text() -> str:
    """The JSON Schema (draft 2020-12) of machine files.

    A file with the key `extends` needs no other key, and may remove keys by empty values.
    """
    definitions = _SchemaDefinitions()
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "machine file of crane",
        "type": "object",
        "if": {"type": "object", "required": [EXTENDS_KEY]},
        "then": definitions.section("variant", MACHINE, is_partial=True),
        "else": definitions.section("machine", MACHINE, is_partial=False),
        "$defs": definitions.schemas,
    }
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


class _SchemaDefinitions:
    """Schemas of sections, each once.

    Attributes:
        schemas: By name.
    """

    def __init__(self) -> None:
        self.schemas: dict[str, Any] = {}
        self._names: dict[tuple[int, bool], str] = {}

    def section(self, name: str, section: SectionSchema, is_partial: bool) -> dict[str, Any]:
        """A reference to the schema of a section; a partial one requires no key."""
        place = (id(section), is_partial)
        if place not in self._names:
            name += "_variant" * (is_partial and name != "variant")
            name = unique_name(name, self.schemas)
            self._names[place], self.schemas[name] = name, {}
            self.schemas[name] = self._section(section, is_partial)
        return {"$ref": f"#/$defs/{self._names[place]}"}

    def _section(self, section: SectionSchema, is_partial: bool) -> dict[str, Any]:
        exclusive = {x for pair in section.exclusive for group in pair[:2] for x in group}
        required = [
            name
            for name, key in section.keys.items()
            if key.default is REQUIRED and name not in exclusive and not is_partial
        ]
        others = section.others and self._value("", section.others, is_partial)
        excluded: dict[str, list[dict[str, Any]]] = {}
        for first, second, _ in section.exclusive:
            for key in first:
                excluded.setdefault(key, []).extend(_given(x) for x in second if x != key)
        return {
            "type": ["object", "null"],
            "properties": {
                name: self._described(name, key, is_partial) for name, key in section.keys.items()
            },
            "additionalProperties": others or False,
            "required": required,
            "dependentSchemas": {
                key: {"if": _given(key), "then": {"not": {"anyOf": x}}}
                if is_partial
                else {"not": {"anyOf": x}}
                for key, x in excluded.items()
            },
        }

    def _described(self, name: str, key: Key, is_partial: bool) -> dict[str, Any]:
        text = key.text
        if isinstance(key, NumberKey) and key.units:
            text += f" [{key.units}]"
        if isinstance(key, NumberKey) and key.plausible is not None:
            text += f", usual: {key.plausible.lower:g} to {key.plausible.upper:g}"
        is_structure = isinstance(key, SectionKey | MapKey | ListKey)
        value = self._value(name, key, is_partial)
        if is_partial or (is_structure and key.default is None):
            value = _nullable(value)
        return {"description": text, **value} | (
            {"default": key.default}
            if (isinstance(key.default, str | float) and key.default != "")
            else {}
        )

    def _number(self, key: NumberKey) -> dict[str, Any]:
        """A number, or a text of a number with a unit; bounds are those of numbers."""
        bounds: dict[str, Any] = {} if key.minimum is None else {"minimum": key.minimum}
        if key.is_positive or (key.zero_error and key.minimum == 0):
            bounds = {"exclusiveMinimum": 0}
        columns = ", ".join(getattr(key, "column_units", ()))
        units = tuple(dict.fromkeys(columns.split(", ") if columns else key.si_units(None, (0,))))
        name = "_or_".join(unit or "ratio" for unit in units)
        name = "number_" + re.sub(r"\W", "_", name.replace("/", "_per_"))
        if name not in self.schemas:
            pattern = rf"^\s*{NUMBER_PATTERN}\s*(?:{'|'.join(map(_unit_pattern, units))})?\s*$"
            others = [x for unit in units if unit != QUANTITY_UNIT for x in accepted_units(unit)]
            number = {
                "type": ["number", "string"],
                "pattern": pattern,
                "examples": [f"1 {unit}" for unit in others if unit],
            }
            self.schemas[name] = number
            self.schemas[f"{name}_or_none"] = number | {"type": _NUMBER_OR_NONE}
        return {"$ref": f"#/$defs/{name}", **bounds}

    def _value(self, name: str, key: Key, is_partial: bool) -> dict[str, Any]:
        match key:
            case SectionKey():
                return self.section(name, key.section, is_partial) | {"type": "object"}
            case MapKey():
                item = self._value(name, key.item, is_partial or key.has_common_item)
                item = _nullable(item) if is_partial else item
                return {"type": "object", "additionalProperties": item}
            case ListKey():
                return {"type": "array", "items": self._value(name, key.item, False)}
            case VariantKey():
                return {"anyOf": [self._value(name, x, False) for x in key.types]}
            case FlagKey():
                return {"enum": [True, False, "yes", "no", "on", "off", "true", "false"]}
            case NameListKey():
                return _array({"type": "string"}, key.size) | {"uniqueItems": True}
            case RowListKey():
                return _array(_array(self._number(key), key.size), None)
            case NumberListKey():
                return _array(self._number(key), key.size)
            case NumberKey():
                return self._number(key)
        return {"enum": [*key.choices]} if key.choices else {"type": "string", "minLength": 1}


def _given(key: str) -> dict[str, Any]:
    """A schema of mappings that have a key, and do not remove it by an empty value."""
    return {"required": [key], "properties": {key: {"not": {"type": "null"}}}}


def _nullable(value: dict[str, Any]) -> dict[str, Any]:
    """The same values, or none at all; in the terms of the type, for clear errors."""
    if "type" in value:
        return value | {"type": [value["type"], "null"]}
    if "enum" in value:
        return value | {"enum": [*value["enum"], None]}
    if "anyOf" in value:
        return value | {"anyOf": [*value["anyOf"], {"type": "null"}]}
    return value | {"$ref": f"{value['$ref']}_or_none"}


def _unit_pattern(unit: str) -> str:
    """Pattern of the units of what a unit is of: their names, with prefixes, and products."""
    if not unit:
        return _RATIO
    if unit == QUANTITY_UNIT:
        return rf"{_RATIO}|[^\s%:0-9].*"
    names = [name for name in unit_names() if unit_size(name, unit) is not None]
    simple = rf"[numcdhkMG\u00b5\u03bc]?(?:{'|'.join(names)})|" if names else ""
    return simple + _COMPOUND_UNIT


def _array(items: dict[str, Any], size: int | None) -> dict[str, Any]:
    return {
        "type": "array",
        "items": items,
        **({} if size is None else {"minItems": size, "maxItems": size}),
    }
