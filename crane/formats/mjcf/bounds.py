"""What a MJCF file declares, counted before MuJoCo makes it: a few letters can ask for days."""

import math
from collections.abc import Mapping

from lxml import etree

from crane.common.errors import DescriptionError
from crane.formats.xml import XmlFile

MOST = 10_000  # elements that are copies; the time to make them goes with the square
_SIZES = {  # attributes whose product is a number of cells or bytes, and how many there may be
    "hfield": (("nrow", "ncol"), 10_000_000),
    "texture": (("width", "height"), 10_000_000),
    "numeric": (("size",), 1_000_000),
    "user": (("dim",), 1_000_000),
    "size": (("nuserdata",), 1_000_000),
}
_EACH = {"size": 10_000, "mesh": 1_000}  # numbers of an element, apart from those above
_KEPT = {"nuserdata", "memory", "njmax", "nconmax", "nstack"}  # bounded above, or not allocated
_FLEXIBLE = ("flex", "flexcomp")


def copies(
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
    for element in xml.root.iter(*_FLEXIBLE):
        raise xml.fail(element, "flexible bodies are no machine's, leave out")
    for element in xml.root.iter(*_SIZES, *_EACH):
        _check(xml, element)
    return _count(xml, xml.root, included, models)


def _count(
    xml: XmlFile, element: etree._Element, included: Mapping[str, int], models: Mapping[str, int]
) -> tuple[int, int]:
    total, more = 1, 0
    if element.tag == "include":
        total += included.get(element.get("file", ""), 0)
    if element.tag == "attach":
        more += models.get(element.get("model", ""), 0)
        total += more
    for child in element:
        if isinstance(child.tag, str):
            below, copied = _count(xml, child, included, models)
            total, more = total + below, more + copied
    if element.tag in ("replicate", "composite"):
        times = 1.0
        for number in _numbers(element, "count"):
            times *= number if number > 1 else 1.0  # else MuJoCo says what is wrong
        if total * times > MOST:
            raise _too_many(xml, element, total * times)
        more += int(total * (times - 1))
        total = int(total * times)
    if more > MOST:
        raise _too_many(xml, element, more)
    return total, more


def _too_many(xml: XmlFile, element: etree._Element, count: float) -> DescriptionError:
    return xml.fail(
        element,
        f"<{element.tag}> stands for {count:.6g} elements by its copies, make at most {MOST}",
    )


def _check(xml: XmlFile, element: etree._Element) -> None:
    keys, most = _SIZES.get(element.tag, ((), 0))
    product = math.prod(max(abs(x), 1.0) for key in keys for x in _numbers(element, key))
    if keys and product > most:
        given = " ".join(f'{key}="{element.get(key)[:20]}"' for key in keys if element.get(key))
        raise xml.fail(element, f"{given} of <{element.tag}> is too large, make it at most {most}")
    if element.tag not in _EACH or (element.tag != "size" and not element.get("builtin")):
        return
    for key in ("params",) if element.tag == "mesh" else element.keys():
        if key not in _KEPT and any(x > _EACH[element.tag] for x in _numbers(element, key)):
            raise xml.fail(
                element,
                f'{key}="{element.get(key)[:20]}" of <{element.tag}> is too large, make it at '
                f"most {_EACH[element.tag]}",
            )


def _numbers(element: etree._Element, key: str) -> list[float]:
    """Numbers of an attribute; MuJoCo says what is wrong with others."""
    try:
        return [float(word) for word in element.get(key, "").split()]
    except ValueError:
        return []
