"""Tables of keys in machine_file.md, written from the schema by `python docs/key_tables.py`.

A table follows each comment `<!-- keys: SECTION -->`, with the names of sections down to it.
"""

import re
from pathlib import Path

from crane.common.plausible_ranges import PLAUSIBLE_RANGES, ROTARY_RANGES, plausible_range
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
from crane.description.machine_schema import MACHINE

PAGE = Path(__file__).with_name("machine_file.md")
_TABLE = re.compile(r"(<!-- (keys|units): ?([\w.]*) -->\n\n)(?:\|.*\n)*")
_TYPES = {FileKey: "path", FlagKey: "yes, no", NameListKey: "list of names", ListKey: "list",
          NumberListKey: "list", RowListKey: "list of rows", SectionKey: "mapping"}  # fmt: skip


def with_tables(text: str) -> str:
    """The page with tables as the schema has them."""

    def table(match: re.Match[str]) -> str:
        rows = _unit_rows() if match[2] == "units" else _key_rows(_section(match[3]))
        return match[1] + "".join(f"| {' | '.join(row)} |\n" for row in rows)

    return _TABLE.sub(table, text)


def _section(path: str) -> SectionSchema:
    """The section at the end of a path such as `hydraulics.valves`; `machine` is the whole."""
    section = MACHINE
    for name in path.split(".") if path != "machine" else ():
        key: Key = section.keys[name]
        keys = [key, getattr(key, "item", key), *getattr(key, "types", ())]
        section = next(x.section for x in keys if isinstance(x, SectionKey))
    return section


def _key_rows(section: SectionSchema) -> list[tuple[str, ...]]:
    has_ranges = any(getattr(key, "plausible", None) for key in section.keys.values())
    head = ("key", "type, unit", *["usual range"] * has_ranges, "default", "meaning")
    rows = [head, ("---",) * len(head)]
    for name, key in section.keys.items():
        usual = [_usual_text(name, section.component)] * has_ranges
        default = _default_text(key)
        if key.default is REQUIRED and (others := section.alternatives(name)):
            default = f"required without {', '.join(f'`{x}`' for x in others)}"
        rows.append((f"`{name}`", _type_text(key), *usual, default, key.text))
    return rows


def _type_text(key: Key) -> str:
    if isinstance(key, VariantKey):
        return ", or ".join(dict.fromkeys(map(_type_text, key.types)))
    if key.choices:
        names = ", ".join(f"`{x}`" for x in key.choices)
        return f"list of {names}" if isinstance(key, NameListKey) else names
    if isinstance(key, MapKey):
        is_number = type(key.item) is NumberKey and key.item.units
        item = f"[{_type_text(key.item)}]" if is_number else _type_text(key.item)
        return f"mapping {key.names}: {item}"
    if isinstance(key, NumberKey):
        kind = _TYPES.get(type(key), "")
        bound = "> 0" if key.is_positive or key.zero_error and key.minimum == 0 else ""
        bound = bound or ("" if key.minimum is None else f"≥ {_number_text(key.minimum)}")
        words = [f"{kind} [{key.units}]" if kind and key.units else kind or key.units, bound]
        return ", ".join(filter(None, words)) or "number"
    return _TYPES.get(type(key), "text")


def _number_text(value: float) -> str:
    if value == 0 or 1e-2 <= abs(value) < 1e4:
        return f"{value:g}"
    digits, exponent = f"{value:.6e}".split("e")
    return f"{digits.rstrip('0').rstrip('.')}e{int(exponent)}"


def _usual_text(name: str, component: str) -> str:
    ranges = [plausible_range(name, turns, component) for turns in (False, True)]
    texts = [
        f"{_number_text(x.lower)} to {_number_text(x.upper)}" for x in ranges if x is not None
    ]
    return "; ".join(dict.fromkeys(texts))


def _default_text(key: Key) -> str:
    if key.default_text or key.default is REQUIRED:
        return key.default_text or "required"
    if isinstance(key.default, bool):
        return "yes" if key.default else "no"
    if isinstance(key.default, int | float):
        return _number_text(key.default)
    if isinstance(key.default, tuple) and key.default:
        return str([f"{x:g}" for x in key.default]).replace("'", "")
    return f"`{key.default}`" if key.default else "none"


def _unit_rows() -> list[tuple[str, ...]]:
    """The units in which numbers of an SI unit are tried."""
    units: dict[str, dict[str, None]] = {}
    for quantity in (*PLAUSIBLE_RANGES.values(), *ROTARY_RANGES.values()):
        names = [name for group in quantity.other_units for name, _ in group]
        units.setdefault(quantity.unit or "dimensionless", {}).update(dict.fromkeys(names))
    rows = [("SI unit", "other units tried"), ("---", "---")]
    rows += [(unit, ", ".join(names)) for unit, names in units.items() if names]
    return rows


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
