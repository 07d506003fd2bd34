"""Strict reading of XML: nothing is expanded or fetched, every error has its line."""

import math
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

from lxml import etree

from crane.common.errors import DescriptionError, known
from crane.common.inputs import content
from crane.description.findings import flag
from crane.description.spec import WITHOUT_AXIS, unit_vector
from crane.description.tree import Placement, Vector

LARGEST = 50_000_000  # bytes of a file
_X = (1.0, 0.0, 0.0)
_ROOTS = {  # what a file holds by its suffix, if not a <robot>
    ".sdf": "an <sdf>", ".world": "an <sdf>", ".mjcf": "a <mujoco>",
    ".xml": "a <robot>, an <sdf> or a <mujoco>",
}  # fmt: skip
_LINES = 1 << 16
_LONG = 60  # characters of a value in an error
_SEVERAL = {"link", "joint", "loop", "visual", "collision"}  # elements that there may be more of


class Places:
    """Where elements were written that come from several files.

    Args:
        file: Name of the file for all that has no place of its own.

    Attributes:
        listed: Files and lines.
    """

    def __init__(self, file: str):
        self.listed = [file]
        self._numbers = {file: 0}

    def put(self, element: etree._Element, place: str) -> None:
        """Say where an element was written."""
        number = self._numbers.setdefault(place, len(self.listed))
        if number == len(self.listed):
            self.listed.append(place)
        element.sourceline = number if number < _LINES else 0  # all that the parser holds


class _Beginning:
    """What a parser finds up to the root element, in whatever encoding the file is."""

    class End(Exception):  # noqa: N818
        """The root element is there."""

    class DocumentType(Exception):  # noqa: N818
        """There is one."""

    def doctype(self, *_: object) -> None:
        """Called before anything of it is declared."""
        raise self.DocumentType

    def start(self, *_: object) -> None:
        """Called at each element."""
        raise self.End

    def end(self, *_: object) -> None:
        """Never called."""

    def close(self) -> None:
        """Called at the end of a file without elements."""


def _refuse_document_type(file: Path, data: bytes) -> None:
    """Raise for <!DOCTYPE>, whose entities may grow without bounds, or fetch."""
    try:
        etree.fromstring(data, etree.XMLParser(target=_Beginning(), no_network=True))
    except _Beginning.DocumentType:
        line = data.count(b"\n", 0, max(data.find(b"<!DOCTYPE"), 0)) + 1
        raise DescriptionError(
            f"{file.name}:{line}: <!DOCTYPE> is not supported, remove it"
        ) from None
    except (_Beginning.End, etree.XMLSyntaxError):  # told by whoever reads all
        pass


class XmlFile:
    """An XML file.

    Args:
        file: The file.

    Attributes:
        file: The file.
        root: Its root element, without comments.
        nameless: Kinds of elements of which one has no name of its own.
        places: Where elements were written, if they come from several files: `sourceline` of an
            element is a number in this list then.

    Raises:
        DescriptionError: The file cannot be read, is not XML, or has a document type.
    """

    def __init__(self, file: Path):
        self.file = file
        self.nameless: set[str] = set()
        self.places: Sequence[str] = ()
        try:
            data = content(file, LARGEST)
        except OSError as error:
            raise DescriptionError(
                f"{file}: cannot be read ({error.strerror}), check the path"
            ) from None
        if not data.strip():
            root = _ROOTS.get(file.suffix.lower(), "a <robot>")
            raise DescriptionError(f"{file.name}: the file is empty, write {root} in it")
        _refuse_document_type(file, data)
        if b"encoding" not in data[:200] and not data.startswith((b"\xff\xfe", b"\xfe\xff")):
            try:
                data.decode("utf-8")
            except UnicodeDecodeError as error:
                line = data.count(b"\n", 0, error.start) + 1
                raise DescriptionError(
                    f"{file.name}:{line}: not UTF-8, save it as UTF-8 or declare its encoding"
                ) from None
        parser = etree.XMLParser(
            resolve_entities=False, no_network=True, remove_comments=True, remove_pis=True
        )
        try:
            self.root = etree.fromstring(data, parser)
        except etree.XMLSyntaxError as error:
            text = (error.msg or "broken").splitlines()[0].split(", line")[0].rstrip(" !")
            raise DescriptionError(
                f"{file.name}:{error.lineno or 1}: not XML, {text}, mend it"
            ) from None

    @classmethod
    def made(cls, file: Path, root: etree._Element, places: Sequence[str]) -> "XmlFile":
        """What a file stands for: a root element made of it, and where each part was written."""
        xml = cls.__new__(cls)
        xml.file, xml.root, xml.nameless, xml.places = file, root, set(), places
        return xml

    def where(self, element: etree._Element) -> str:
        """File and line of an element."""
        if self.places:
            number = element.sourceline or 0
            return self.places[number if number < len(self.places) else 0]
        return f"{self.file.name}:{element.sourceline}"

    def fail(self, element: etree._Element, what: str) -> DescriptionError:
        """An error that points at an element."""
        return DescriptionError(f"{self.where(element)}: {what}")

    def check(
        self,
        element: etree._Element,
        children: Mapping[str, set[str]],
        attributes: Mapping[str, set[str]],
        exact: set[str],
    ) -> None:
        """Raise for tags and attributes that are slips of known ones, or in a wrong place.

        Foreign ones (sensors, settings of simulators) are common and ignored, apart from
        attributes of the elements `exact`. Where findings are collected, slips are mended, so
        that what stands there is read, too.

        Args:
            element: Where to begin.
            children: Tags that an element may contain.
            attributes: Attributes that an element may have.
            exact: Elements that have no others.

        Raises:
            DescriptionError: There is a slip.
        """
        self._check_attributes(element, attributes.get(element.tag, set()), exact)
        tags = children.get(element.tag, set())
        for child in element:
            if not isinstance(child.tag, str):  # an entity, not expanded
                continue
            if child.tag not in tags:
                self._check_stranger(element, child, children)
            if child.tag in tags:  # now
                self.check(child, children, attributes, exact)

    def _check_attributes(
        self, element: etree._Element, allowed: set[str], exact: set[str]
    ) -> None:
        for key in element.keys() if allowed else ():
            if key in allowed:
                continue
            near = get_close_matches(key.lower(), allowed, 1, 0.75)
            meant = bool(near) and element.get(near[0]) is None
            if element.tag in exact or meant:
                hint = known(allowed, key.lower())
                problem = f'unknown {key}="..." in <{element.tag}>, {hint}'
                flag(self.fail(element, problem), harmless=meant)
            if meant:
                element.set(near[0], element.attrib.pop(key))

    def _check_stranger(
        self, element: etree._Element, child: etree._Element, children: Mapping[str, set[str]]
    ) -> None:
        """A child whose tag its parent does not have: a slip, in a wrong place, or foreign."""
        tags = children.get(element.tag, set())
        near = get_close_matches(child.tag.lower(), tags, 1, 0.75)
        if near:
            hint = known(tags, child.tag.lower())
            meant = near[0] in _SEVERAL or element.find(near[0]) is None
            problem = f"unknown <{child.tag}> in <{element.tag}>, {hint}"
            flag(self.fail(child, problem), harmless=meant)
            if meant:
                child.tag = near[0]
        elif any(child.tag in x for x in children.values() if tags):
            flag(self.fail(child, f"<{child.tag}> has no place in <{element.tag}>, move it"))

    def only(self, element: etree._Element, tag: str, what: str) -> etree._Element | None:
        """The child with a tag, if there is one.

        Raises:
            DescriptionError: There are several.
        """
        found = element.findall(tag)
        if len(found) > 1:
            flag(self.fail(found[1], f"{what} has {len(found)} <{tag}>, keep one"))
        return found[0] if found else None

    def number(
        self, element: etree._Element, name: str, what: str, default: float | None = None
    ) -> float:
        """A finite number.

        Args:
            element: The element.
            name: Its attribute.
            what: What it describes, for errors.
            default: Value of a missing attribute; None if it must not be missing.

        Raises:
            DescriptionError: Missing, not a number or not finite. Where findings are collected,
                it is noted, and the number is NaN.
        """
        return self.vector(element, name, what, 1, None if default is None else (default,))[0]

    def vector(
        self,
        element: etree._Element,
        name: str,
        what: str,
        length: int,
        default: tuple[float, ...] | None = None,
    ) -> tuple[float, ...]:
        """Finite numbers, as `number`."""
        try:
            return self._vector(element, name, what, length, default)
        except DescriptionError as error:
            flag(error)
            return (math.nan,) * length

    def _vector(
        self,
        element: etree._Element,
        name: str,
        what: str,
        length: int,
        default: tuple[float, ...] | None,
    ) -> tuple[float, ...]:
        text = element.get(name)
        if text is None:
            if default is None:
                raise self.fail(element, f'{what} has no {name}, add {name}="..."')
            return default
        short = text if len(text) < _LONG else text[:_LONG] + "..."
        return self.parsed(element, text, f'{name}="{short}" of {what}', length)

    def parsed(
        self, element: etree._Element, text: str, given: str, length: int
    ) -> tuple[float, ...]:
        """Finite numbers in a text.

        Args:
            element: Where it stands.
            text: The text.
            given: What it describes, for errors.
            length: How many numbers there have to be.

        Raises:
            DescriptionError: There are others.
        """
        words = text.split()
        try:
            values = tuple(float(word) for word in words)
        except ValueError:
            hint = "write digits"
            if "," in text:
                hint = "write a decimal point"
            if "${" in text:
                hint = "expand the file with xacro"
            raise self.fail(element, f"{given} is not a number, {hint}") from None
        if len(values) != length:
            raise self.fail(element, f"{given} has {len(values)} numbers, give {length}")
        if not all(math.isfinite(value) for value in values):
            raise self.fail(element, f"{given} is not finite, give a number")
        return values

    def direction(self, element: etree._Element, what: str, default: tuple[float, ...]) -> Vector:
        """Unit vector of the child `<axis xyz="..."/>`; not read where the type uses none.

        Raises:
            DescriptionError: It is zero or malformed.
        """
        if element.get("type") in WITHOUT_AXIS:
            return _X
        axis = self.only(element, "axis", what)
        xyz = default if axis is None else self.vector(axis, "xyz", f"the axis of {what}", 3)
        if (unit := unit_vector(xyz)) is None:
            flag(self.fail(axis, f"the axis of {what} is zero, give a direction"))
            return _X
        return unit

    def placement(self, element: etree._Element, what: str) -> Placement:
        """Numbers xyz [m] and rpy [rad] of the child `<origin/>`, zeros without one.

        Raises:
            DescriptionError: They are malformed.
        """
        origin = self.only(element, "origin", what)
        zero = (0.0, 0.0, 0.0)
        if origin is None:
            return zero, zero
        (x, y, z), (roll, pitch, yaw) = (
            self.vector(origin, key, f"the origin of {what}", 3, zero) for key in ("xyz", "rpy")
        )
        return (x, y, z), (roll, pitch, yaw)
