"""Sections of a machine file, read as their schema says."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from crane.common.errors import InputError
from crane.description.findings import UnknownNames, error_recovery, report_error
from crane.description.key_types import Key, ListKey, SectionKey, SectionSchema
from crane.description.machine_lookup import bundled_machines
from crane.description.machine_schema import ALL_ITEM, EXTENDS_KEY
from crane.formats.machine_file.yaml_text import LocatedMapping, format_value, parse_yaml_file
from crane.formats.machine_file.yaml_values import YamlValues
from crane.hydraulics.circuit_elements import CircuitParameterError

Item = TypeVar("Item")


def parse_with_base(
    file: Path, schema: SectionSchema, including_files: tuple[Path, ...]
) -> LocatedMapping:
    """A machine file put over the one that it extends, which may extend another.

    Args:
        file: The machine file.
        schema: Its keys.
        including_files: The variants that led to it, resolved.
    """
    variant = parse_yaml_file(file)
    if EXTENDS_KEY not in variant or EXTENDS_KEY not in schema.keys:
        return variant
    section = YamlSection(variant, schema)
    base_name = section.text(EXTENDS_KEY)
    base_file = bundled_machines().get(base_name) or section.file(EXTENDS_KEY)
    if base_file.suffix.lower() not in (".yaml", ".yml"):
        raise section.error_at(
            EXTENDS_KEY, f"'{base_name}' is no machine file (.yaml), a variant needs one"
        )
    including_files = (*including_files, file.resolve())
    if base_file in including_files:
        raise section.error_at(
            EXTENDS_KEY, f"'{base_name}' is a variant of this file itself, extend another"
        )
    del variant[EXTENDS_KEY]
    data = parse_with_base(base_file, schema, including_files)
    data.update_from_variant(variant)
    return data


class YamlSection(YamlValues):
    """A mapping of a machine file; see `YamlValues`."""

    @classmethod
    def read(cls, file: Path, schema: SectionSchema) -> "YamlSection":
        """The top level of a YAML file, a variant put over the file that it extends.

        Raises:
            DescriptionError: A file is missing, not YAML, or not a mapping of these keys.
        """
        section = cls(parse_with_base(file, schema, ()), schema)
        section.check_keys(schema.keys)
        return section

    def section(self, key: str, title: str = "") -> "YamlSection | None":
        """A mapping with its keys checked, None where the key is absent.

        Args:
            key: The key.
            title: What errors call it; "": the key in quotes.
        """
        value = self._data.get(key)
        if value is None:
            return None
        title = title or f"'{key}'"
        if not isinstance(value, LocatedMapping):
            raise self.error_at(
                key, f"{title} is {format_value(value)}, give a mapping 'name: value'"
            )
        spec = self._key(key)
        spec = next((x for x in getattr(spec, "types", ()) if isinstance(x, SectionKey)), spec)
        names = SectionSchema(title, {}, others=getattr(spec, "item", Key()))
        schema = spec.section if isinstance(spec, SectionKey) else names
        section = YamlSection(value, schema, title, self._data.locations[key], key, self.turns)
        if schema.others is None:
            section.check_keys(schema.keys)
        return section

    def create(self, function: Callable[..., Item], *arguments: object, **values: Any) -> Item:
        """What a class or function makes of values of this section.

        Raises:
            DescriptionError: Its error, with the file and line of the key that it is about.
        """
        try:
            return function(*arguments, **values)
        except CircuitParameterError as error:
            section, (*path, key) = self, error.path
            for name in path:
                section = section.section(name) or section
            raise section.error_at(key, str(error)) from None
        except InputError as error:
            raise self.error_at(None, str(error)) from None

    def read_map(
        self,
        key: str,
        read: "Callable[[str, YamlSection], Item]",
        check_name: Callable[[str, str], None] = lambda name, location: None,
    ) -> dict[str, Item]:
        """What is read of each mapping of a mapping, by name; an error ends only its item.

        Args:
            key: The key.
            read: Called with each name and mapping.
            check_name: As for `value_map`.
        """

        def read_item(outer: YamlSection, name: str) -> Item:
            spec = outer._key(name)
            assert isinstance(spec, SectionKey)
            title = f"{spec.section.title} '{name}'"
            item = outer.section(name, title)
            if item is None or not list(item):
                raise outer.error_at(
                    name, f"{title} is empty, its keys are {', '.join(spec.section.keys)}"
                )
            return read(name, item)

        return self.value_map(key, read_item, check_name)

    def read_items(self, key: str, read: "Callable[[YamlSection], Item]") -> tuple[Item, ...]:
        """What is read of each mapping of a list."""
        found = []
        for item in self.list_items(key):
            with error_recovery():
                found.append(read(item))
        return tuple(found)

    def value_map(
        self,
        key: str,
        read: "Callable[[YamlSection, str], Item]",
        check_name: Callable[[str, str], None] = lambda name, location: None,
        title: str = "",
    ) -> dict[str, Item]:
        """The values of a mapping by name; an error ends only the value that has it.

        Args:
            key: The key.
            read: Called with the mapping and each name, `YamlSection.number` for numbers.
            check_name: Raises for a name that is not allowed; called with the location, too.
            title: What errors call the mapping; "": the key in quotes.
        """
        found: dict[str, Item] = {}
        with error_recovery():
            section = self.section(key, title)
            for name, location in self.item_locations(key).items():
                with error_recovery():
                    check_name(name, location)
                    assert section is not None
                    found[name] = read(section, name)
        return found

    def item_locations(self, key: str) -> dict[str, str]:
        """Files and lines of the items of a mapping, by name."""
        outer = self.section(key)
        return {} if outer is None else {name: outer.source_location(name) for name in outer}

    def list_items(self, key: str, title: str = "") -> "Iterator[YamlSection]":
        """The mappings of a list; none where the key is absent.

        Args:
            key: The key.
            title: What errors call the items; "": the title of their schema.
        """
        spec, value = self._key(key), self._data.get(key)
        if value is None:
            return
        if not isinstance(value, list):
            report_error(
                self.error_at(
                    key, f"'{key}' is {format_value(value)}, give a list, its items with '- '"
                )
            )
            self.is_complete = False
            return
        assert isinstance(spec, ListKey) and isinstance(spec.item, SectionKey)
        schema = spec.item.section
        for item in value:
            if not isinstance(item, LocatedMapping):
                report_error(
                    self.error_at(
                        key,
                        f"'{key}' lists {format_value(item)}, write each item as {{key: value}}",
                    )
                )
                self.is_complete = False
                continue
            section = YamlSection(
                item, schema, _item_title(title or schema.title, item), turns=self.turns
            )
            if schema.others is None:
                section.check_keys(schema.keys)
            yield section

    def apply_common_item(self, key: str, names: Iterable[str]) -> None:
        """Let the item `all` of a mapping of mappings hold for each of some names.

        A key of the item itself has priority; an item that is absent is made.
        """
        outer = self._data.get(key)
        if not isinstance(outer, LocatedMapping) or not isinstance(
            outer.get(ALL_ITEM), LocatedMapping
        ):
            return
        common, location = outer.pop(ALL_ITEM), outer.locations.pop(ALL_ITEM)
        for name in names:
            item = outer.get(name, LocatedMapping(*location))
            if not isinstance(item, LocatedMapping):
                continue
            for common_key in [x for x in common if x not in item]:
                item.copy_key(common, common_key)
            outer[name], outer.locations[name] = item, outer.locations.get(name, location)

    def fill_items(self, key: str, source: "YamlSection", names: Iterable[str]) -> None:
        """Let the items of a mapping have what those of another section have.

        Args:
            key: Of the mapping in both sections.
            source: The other section.
            names: Keys to take over into items that have none of them.
        """
        items, names = source._data.get(key), set(names)
        if not isinstance(items, LocatedMapping):
            return
        location = source._data.locations[key]
        outer = self._data.setdefault(key, LocatedMapping(*location))
        self._data.locations.setdefault(key, location)
        for name in items if isinstance(outer, LocatedMapping) else ():
            item = outer.setdefault(name, LocatedMapping(*items.locations[name]))
            outer.locations.setdefault(name, items.locations[name])
            if not isinstance(items[name], LocatedMapping) or not isinstance(item, LocatedMapping):
                continue
            if names.isdisjoint(item):
                for shared in names & items[name].keys():
                    item.copy_key(items[name], shared)

    def item_names(self, key: str) -> tuple[str, ...]:
        """Names in a mapping, none where there is none."""
        outer = self._data.get(key)
        if not isinstance(outer, LocatedMapping):
            return ()
        return tuple(name for name in outer if name != ALL_ITEM)

    def known_item_names(self, key: str) -> tuple[str, ...]:
        """Names in a mapping of mappings, unknown names where it or an item is refused."""
        outer = self._data.get(key)
        if outer is None:
            return ()
        names = self.item_names(key)
        return (
            names
            if (
                isinstance(outer, LocatedMapping)
                and all(isinstance(outer[x], LocatedMapping) for x in names)
            )
            else UnknownNames()
        )


def _item_title(title: str, item: LocatedMapping) -> str:
    """What errors call an item of a list: by its name, its joint or its two frames."""
    name = item.get("name", item.get("joint", item.get("between")))
    if isinstance(name, list) and all(isinstance(frame, str) for frame in name):
        return f"the {title.removesuffix(' of')} between {' and '.join(map(repr, name))}"
    return f"{title} '{name}'" if isinstance(name, str) else f"a {title.removesuffix(' of')}"
