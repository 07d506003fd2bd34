"""Types of the keys of a machine file: type, unit, bounds, default and text of a value."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from crane.common.plausible_ranges import PlausibleRange, plausible_range

QUANTITY_UNIT = "unit of the quantity"  # of a number whose unit is that of what is measured
REQUIRED: Any = object()  # the default of a key that has to be given


@dataclass(frozen=True)
class Key:
    """A key whose value is a text.

    Attributes:
        text: What it is, one line.
        default: Its value where the key is absent; None: nothing, `REQUIRED`: an error.
        default_text: The default in words, where it is not one value.
        attribute: Name of the value in the class that is made of the section; "" as the key.
        choices: All values that a text may have; empty where it may be any.
    """

    text: str = ""
    default: Any = field(default=None, kw_only=True)
    default_text: str = field(default="", kw_only=True)
    attribute: str = field(default="", kw_only=True)
    choices: tuple[str, ...] = field(default=(), kw_only=True)


@dataclass(frozen=True)
class TextKey(Key):
    """A key whose value is a text that is not empty."""


@dataclass(frozen=True)
class FileKey(Key):
    """A key whose value is the path of a file, from the folder of the machine file."""


@dataclass(frozen=True)
class FlagKey(Key):
    """A key whose value is true or false."""


@dataclass(frozen=True)
class NameListKey(Key):
    """A key whose value is a list of different names."""

    size: int | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class NumberKey(Key):
    """A key whose value is a finite number.

    Attributes:
        unit: SI unit; of a number that belongs to a joint, that of a sliding one.
        rotary_unit: SI unit where the joint turns; "" where it is the same.
        minimum: Least value.
        zero_error: The error where the value is 0, with {key} and {title}; "": 0 may be given,
            or is refused by the class that is made of the section.
        is_positive: Whether the value has to be above 0.
        plausible: Usual range.
    """

    unit: str = ""
    rotary_unit: str = ""
    minimum: float | None = field(default=None, kw_only=True)
    zero_error: str = field(default="", kw_only=True)
    is_positive: bool = field(default=False, kw_only=True)
    plausible: PlausibleRange | None = field(default=None, kw_only=True)

    @property
    def units(self) -> str:
        """Its units, as text: "N, N m"; empty for a number without one."""
        return ", ".join(dict.fromkeys(filter(None, (self.unit, self.rotary_unit))))

    def si_units(self, turns: bool | None, position: Sequence[int] = ()) -> tuple[str, ...]:
        """Its SI unit, or both where it is not known whether its joint turns.

        Args:
            turns: Whether its joint turns; None: not known.
            position: Where it is in the list or the rows of the key.
        """
        rotary_unit = self.rotary_unit or self.unit
        if turns is None:
            return tuple(dict.fromkeys((self.unit, rotary_unit)))
        return (rotary_unit if turns else self.unit,)


@dataclass(frozen=True)
class NumberListKey(NumberKey):
    """A key whose value is a list of finite numbers, `size` of them if given.

    Attributes:
        size: See above.
        column_units: SI units of the numbers in turn, where they differ; "m, rad" of one that
            depends on the joint.
        is_polynomial: Whether it is of coefficients of powers of the time, in the unit by s, s2..
    """

    size: int | None = field(default=None, kw_only=True)
    column_units: tuple[str, ...] = field(default=(), kw_only=True)
    is_polynomial: bool = field(default=False, kw_only=True)

    def si_units(self, turns: bool | None, position: Sequence[int] = ()) -> tuple[str, ...]:
        """See `NumberKey`."""
        column = position[-1] if position else 0
        if self.column_units:
            units = self.column_units[column % len(self.column_units)].split(", ")
            return tuple(units) if turns is None or len(units) == 1 else (units[turns],)
        by_time = f"/s{column if column > 1 else ''}" if self.is_polynomial and column else ""
        return tuple(f"{unit}{by_time}" for unit in super().si_units(turns))


@dataclass(frozen=True)
class RowListKey(NumberListKey):
    """A key whose value is a list of rows, each a list of `size` numbers."""


@dataclass(frozen=True)
class VariantKey(Key):
    """A key whose value is of one of several types."""

    types: tuple[Key, ...] = ()


@dataclass(frozen=True)
class SectionKey(Key):
    """A key whose value is a mapping with the keys of a schema."""

    section: "SectionSchema" = None  # type: ignore[assignment]


@dataclass(frozen=True)
class ListKey(Key):
    """A key whose value is a list of such values, most often of mappings."""

    item: Key = None  # type: ignore[assignment]


@dataclass(frozen=True)
class MapKey(Key):
    """A key whose value is a mapping of names that the user chooses, or that the machine has.

    Attributes:
        item: Type of the values.
        names: What the names are of.
        has_common_item: Whether an item `all` holds for all others.
    """

    item: Key = None  # type: ignore[assignment]
    names: str = "name"
    has_common_item: bool = field(default=False, kw_only=True)


@dataclass(frozen=True)
class SectionSchema:
    """The keys of a mapping in a machine file.

    Attributes:
        title: What errors call it; of items the words before the name.
        keys: By name, in the order in which they are documented.
        content: The class that is made of it.
        component: Name of its plausible ranges.
        others: Type of the values of all other keys; None where there must be none.
        exclusive: Pairs of groups of keys that exclude each other, and the error, with {key} and
            {other}, the keys that are given, {title}, and values by their keys; of two equal
            groups one key may be given.
    """

    title: str
    keys: Mapping[str, Key]
    content: type | None = None
    component: str = ""
    others: Key | None = None
    exclusive: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = ()

    def alternatives(self, key: str) -> tuple[str, ...]:
        """Keys that may be given instead of one."""
        groups = [pair[:2] for pair in self.exclusive]
        groups += [(other, group) for group, other in groups]
        return tuple(name for group, other in groups if key in group for name in other)

    def values_of(self, item: Any, *excluded: str) -> dict[str, Any]:
        """What a machine file has to say of an object: its values that are not the defaults."""
        values = {}
        for name, key in self.keys.items():
            value = getattr(item, key.attribute or name, key.default)
            value = value.item() if isinstance(value, np.generic) else value
            if name not in excluded and value not in (key.default, None, "", (), {}):
                values[name] = _plain_value(value, key)
        return values


def section_schema(
    title: str,
    keys: Mapping[str, Key],
    content: type | None = None,
    component: str = "",
    **more: Any,
) -> SectionSchema:
    """A schema whose keys take from a class what they do not say themselves.

    Defaults are those of the fields of the class; bounds and usual ranges those of hydraulic
    components.

    Args:
        title: See `SectionSchema`.
        keys: See `SectionSchema`.
        content: The class.
        component: See `SectionSchema`; "": of the class.
        more: See `SectionSchema`.
    """
    fields = {} if content is None else {x.name: x for x in dataclasses.fields(content)}
    if content is not None and content.__module__.startswith("crane.hydraulics"):
        component = component or content.__name__.removeprefix("Circuit").lower()
    return SectionSchema(
        title,
        {
            name: _completed(key, name, fields.get(key.attribute or name), component)
            for name, key in keys.items()
        },
        content,
        component,
        **more,
    )


def _completed(key: Key, name: str, entry: Any, component: str) -> Key:
    """A key with default, bounds and unit of a field of a class, None where it has none."""
    changes: dict[str, Any] = {}
    if entry is not None and key.default is None:
        is_missing = entry.default is dataclasses.MISSING
        has_factory = entry.default_factory is not dataclasses.MISSING
        changes["default"] = None if has_factory else REQUIRED if is_missing else entry.default
    if component and type(key) is NumberKey:
        plausible, rotary = (plausible_range(name, turns, component) for turns in (False, True))
        changes["plausible"] = plausible
        if entry is not None:
            changes["is_positive"] = bool(entry.metadata.get("positive"))
            is_unbounded = key.minimum is None and entry.metadata.get("signed")
            changes["minimum"] = None if is_unbounded else key.minimum or 0.0
        if plausible is not None and rotary is not None and not key.unit:
            changes["unit"] = plausible.unit
            changes["rotary_unit"] = rotary.unit if rotary.unit != plausible.unit else ""
    return dataclasses.replace(key, **changes)


def _plain_value(value: Any, key: Key) -> Any:
    if isinstance(key, SectionKey):
        return key.section.values_of(value)
    item = getattr(key, "item", key)
    if isinstance(value, Mapping):
        return {name: _plain_value(part, item) for name, part in value.items()}
    if not isinstance(value, list | tuple):
        return value
    parts = [_plain_value(part, item) for part in value]
    if isinstance(key, MapKey):  # objects that have the name
        return {each.joint: part for each, part in zip(value, parts, strict=True)}
    return parts
