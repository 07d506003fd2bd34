"""What a MJCF file declares, counted before MuJoCo makes it: a few letters can ask for days."""

import math
from collections.abc import Mapping

from lxml import etree

from crane.common.errors import DescriptionError
from crane.formats.xml_file import XmlFile

MAX_COPIES = 10_000  # elements that are copies; the time to make them goes with the square
# attributes whose product is a number of cells or bytes, and how many there may be
_SIZE_ATTRIBUTES = {
    "hfield": (("nrow", "ncol"), 10_000_000),
    "texture": (("width", "height"), 10_000_000),
    "numeric": (("size",), 1_000_000),
    "user": (("dim",), 1_000_000),
    "size": (("nuserdata",), 1_000_000),
}
_MAX_ATTRIBUTE_VALUES = {
    "size": 10_000,
    "mesh": 1_000,
}  # numbers of an element, apart from those above
_UNCHECKED_ATTRIBUTES = {
    "nuserdata",
    "memory",
    "njmax",
    "nconmax",
    "nstack",
}  # bounded above, or not allocated
_FLEXIBLE_ELEMENTS = ("flex", "flexcomp")


def count_elements(
    xml: XmlFile, included: Mapping[str, int], models: Mapping[str, int]
) -> tuple[int, int]:
    """Numbers of elements that a file stands for, and of those that are copies of others.

    Args:
        xml: The file.
        included: Elements that each file stands for that is included, by its name there.
        models: The same of models that are attached, by their names.

    Raises:
        DescriptionError: There are too many copies, or a number in the file is too large.
    """
    for element in xml.root.iter(*_FLEXIBLE_ELEMENTS):
        raise xml.error_at(element, "flexible bodies are no machine's, leave out")
    for element in xml.root.iter(*_SIZE_ATTRIBUTES, *_MAX_ATTRIBUTE_VALUES):
        _check_sizes(xml, element)
    return _count_below(xml, xml.root, included, models)


def _count_below(
    xml: XmlFile, element: etree._Element, included: Mapping[str, int], models: Mapping[str, int]
) -> tuple[int, int]:
    total, copied_count = 1, 0
    if element.tag == "include":
        total += included.get(element.get("file", ""), 0)
    if element.tag == "attach":
        copied_count += models.get(element.get("model", ""), 0)
        total += copied_count
    for child in element:
        if isinstance(child.tag, str):
            child_count, copied = _count_below(xml, child, included, models)
            total, copied_count = total + child_count, copied_count + copied
    if element.tag in ("replicate", "composite"):
        repetitions = 1.0
        for number in _read_numbers(element, "count"):
            repetitions *= number if number > 1 else 1.0  # else MuJoCo says what is wrong
        if total * repetitions > MAX_COPIES:
            raise _too_many_copies_error(xml, element, total * repetitions)
        copied_count += int(total * (repetitions - 1))
        total = int(total * repetitions)
    if copied_count > MAX_COPIES:
        raise _too_many_copies_error(xml, element, copied_count)
    return total, copied_count


def _too_many_copies_error(
    xml: XmlFile, element: etree._Element, count: float
) -> DescriptionError:
    return xml.error_at(
        element,
        f"<{element.tag}> stands for {count:.6g} elements by its copies, make at most "
        f"{MAX_COPIES}",
    )


def _check_sizes(xml: XmlFile, element: etree._Element) -> None:
    keys, maximum = _SIZE_ATTRIBUTES.get(element.tag, ((), 0))
    product = math.prod(max(abs(x), 1.0) for key in keys for x in _read_numbers(element, key))
    if keys and product > maximum:
        given = " ".join(f'{key}="{element.get(key)[:20]}"' for key in keys if element.get(key))
        raise xml.error_at(
            element, f"{given} of <{element.tag}> is too large, make it at most {maximum}"
        )
    if element.tag not in _MAX_ATTRIBUTE_VALUES or (
        element.tag != "size" and not element.get("builtin")
    ):
        return
    for key in ("params",) if element.tag == "mesh" else element.keys():
        if key not in _UNCHECKED_ATTRIBUTES and any(
            x > _MAX_ATTRIBUTE_VALUES[element.tag] for x in _read_numbers(element, key)
        ):
            raise xml.error_at(
                element,
                f'{key}="{element.get(key)[:20]}" of <{element.tag}> is too large, make it at '
                f"most {_MAX_ATTRIBUTE_VALUES[element.tag]}",
            )


def _read_numbers(element: etree._Element, key: str) -> list[float]:
    """Numbers of an attribute; MuJoCo says what is wrong with others."""
    try:
        return [float(word) for word in element.get(key, "").split()]
    except ValueError:
        return []
