"""A MJCF file that MuJoCo compiles, with bounds on its size and lines of its elements."""

import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from lxml import etree

from crane.common.errors import DescriptionError
from crane.common.optional_libraries import import_optional_library
from crane.formats.conversion_notes import ConversionNotes
from crane.formats.xml_file import XmlFile, parse_attribute

MAX_COPIES = 10_000  # copied elements; MuJoCo's time to copy grows with the square
# attributes whose product is a number of cells or bytes, and its bound
_SIZE_ATTRIBUTES = {
    "hfield": (("nrow", "ncol"), 10_000_000),
    "texture": (("width", "height"), 10_000_000),
    "numeric": (("size",), 1_000_000),
    "user": (("dim",), 1_000_000),
    "size": (("nuserdata",), 1_000_000),
}
_MAX_ATTRIBUTE_VALUES = {"size": 10_000, "mesh": 1_000}  # for other attributes
# bounded above, or not allocated
_UNCHECKED_ATTRIBUTES = {"nuserdata", "memory", "njmax", "nconmax", "nstack"}
_FLEXIBLE_ELEMENTS = ("flex", "flexcomp")
_MISSING_FILE_PATTERN = re.compile(r"opening file '([^']*)'")  # in messages of MuJoCo
_ELEMENT_PATTERN = re.compile(r"Element name '([^']*)'")
_IMAGE_COLLECTIONS = ("materials", "textures", "skins")
_DRAWN_COLLECTIONS = ("geoms", "sites", "tendons")  # with materials
_AUTOMATIC_INERTIA = 2  # value of inertiafromgeom: for bodies without an <inertial>


def _count_elements(
    xml: XmlFile, element: etree._Element, included: Mapping[str, int], models: Mapping[str, int]
) -> tuple[int, int]:
    """Count the elements of an element with its includes and copies, before MuJoCo creates them.

    A few characters of MJCF can request copies that take days.

    Args:
        xml: The file.
        element: The element.
        included: Number of elements of each included file, by its name in the `<include>`.
        models: Number of elements of each attached model, by name.

    Returns:
        Number of all elements, and of copies among them.

    Raises:
        DescriptionError: There are too many copies.
    """
    total, copied_count = 1, 0
    if element.tag == "include":
        total += included.get(element.get("file", ""), 0)
    if element.tag == "attach":
        copied_count += models.get(element.get("model", ""), 0)
        total += copied_count
    for child in element:
        child_count, copied = _count_elements(xml, child, included, models)
        total, copied_count = total + child_count, copied_count + copied
    repeated_count = 0.0
    if element.tag in ("replicate", "composite"):  # MuJoCo reports invalid counts
        repetitions = math.prod(max(1.0, x) for x in parse_attribute(element, "count"))
        repeated_count = total * repetitions
        if repeated_count <= MAX_COPIES:
            copied_count += int(total * (repetitions - 1))
            total = int(repeated_count)
    if (count := max(copied_count, repeated_count)) > MAX_COPIES:
        raise xml.error_at(
            element,
            f"<{element.tag}> stands for {count:.6g} elements by its copies, make at most "
            f"{MAX_COPIES}",
        )
    return total, copied_count


def _check_sizes(xml: XmlFile, element: etree._Element) -> None:
    keys, maximum = _SIZE_ATTRIBUTES.get(element.tag, ((), math.inf))
    product = math.prod(max(abs(x), 1.0) for key in keys for x in parse_attribute(element, key))
    sizes: list[tuple[tuple[str, ...], float, float]] = [(keys, product, maximum)]
    if element.tag == "size" or (element.tag in _MAX_ATTRIBUTE_VALUES and element.get("builtin")):
        maximum = _MAX_ATTRIBUTE_VALUES[element.tag]
        sizes += [
            ((key,), max(parse_attribute(element, key), default=0.0), maximum)
            for key in (("params",) if element.tag == "mesh" else element.keys())
            if key not in _UNCHECKED_ATTRIBUTES
        ]
    for keys, size, maximum in sizes:
        if size > maximum:
            given = " ".join(
                f'{key}="{element.get(key)[:20]}"' for key in keys if element.get(key)
            )
            raise xml.error_at(
                element, f"{given} of <{element.tag}> is too large, make it at most {maximum}"
            )


def _remove_shapes(
    spec: Any, name: str, moving_bodies: set[str], lighter_bodies: dict[str, str]
) -> bool:
    """Remove the meshes and height fields of a file with their geoms.

    Args:
        spec: The `MjSpec`.
        name: Name of the file.
        moving_bodies: Names of the bodies that can move.
        lighter_bodies: Receives the moving bodies that lose mass, with the file.

    Returns:
        Whether there were any.
    """
    removed = [x for x in (*spec.meshes, *spec.hfields) if x.file and name.endswith(x.file)]
    shapes = {x.name for x in removed}
    for geom in [x for x in spec.geoms if shapes & {x.meshname, x.hfieldname}]:
        if geom.parent.name in moving_bodies and _contributes_mass(spec.compiler, geom):
            lighter_bodies.setdefault(geom.parent.name, name)
        spec.delete(geom)
    for item in removed:
        spec.delete(item)
    return bool(shapes)


def _contributes_mass(settings: Any, geom: Any) -> bool:
    inertia_mode = int(settings.inertiafromgeom)
    is_explicit = inertia_mode == _AUTOMATIC_INERTIA and geom.parent.explicitinertial
    lowest, highest = settings.inertiagrouprange
    is_massless = geom.mass == 0 or (math.isnan(geom.mass) and geom.density == 0)
    is_counted = lowest <= geom.group <= highest and not is_massless
    return bool(inertia_mode and not is_explicit and is_counted)


_MAX_SHOWN_NAMES = 6  # names in a line


class MujocoFile(ConversionNotes):
    """A MJCF file, compiled by MuJoCo, so that all elements have the meaning that they have there.

    Before that, the file is read as strictly as any other XML.

    Args:
        file: The file.

    Attributes:
        model: MuJoCo's `MjModel`.

    Raises:
        InputError: MuJoCo is not installed.
        DescriptionError: The file or what it includes is wrong.
    """

    def __init__(self, file: Path):
        super().__init__(file, "MuJoCo", _MAX_SHOWN_NAMES)
        self._files: list[XmlFile] = []
        self._element_counts: dict[Path, int] = {}
        self._read_with_includes(file, [])
        self._mujoco = mujoco = import_optional_library("mujoco", f"{file.name}: reading MJCF")
        messages: list[str] = []
        previous_handler = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(messages.append)  # by default it writes a file MUJOCO_LOG.TXT
        try:
            self.model: Any = self._compile()
        except DescriptionError:
            raise
        except Exception as error:  # ValueError, FatalError and others
            raise self._compilation_error(str(error) or type(error).__name__) from None
        finally:
            mujoco.set_mju_user_warning(previous_handler)
        if messages := [" ".join(text.split()) for text in dict.fromkeys(messages)]:
            self.warn(f"MuJoCo says {'; '.join(messages)}")

    def _compile(self) -> Any:
        """Return the compiled model, without shapes and textures whose files are missing.

        A machine needs them only where MuJoCo computes the mass of a body from a mesh. A moving
        body that has other mass is then lighter, which is noted; one without any other mass is an
        error.
        """
        path = str(self.file)
        try:
            return self._mujoco.MjModel.from_xml_path(path)
        except ValueError as error:
            if not (missing := _MISSING_FILE_PATTERN.search(str(error))):
                raise
        spec = self._mujoco.MjSpec.from_file(path)
        for item in (x for kind in _DRAWN_COLLECTIONS for x in getattr(spec, kind)):
            item.material = ""
        for kind in _IMAGE_COLLECTIONS:
            for item in list(getattr(spec, kind)):
                spec.delete(item)
        moving_bodies = set[str]()
        for i, body in enumerate(spec.bodies):  # parents before children
            body.name, parent = body.name or f"body{i}", body.parent
            if parent is not None and (len(body.joints) or parent.name in moving_bodies):
                moving_bodies.add(body.name)
        model, files, lighter_bodies = None, [missing[1]], dict[str, str]()
        while model is None:
            is_removed = _remove_shapes(spec, files[-1], moving_bodies, lighter_bodies)
            try:
                model = spec.compile()
            except ValueError as error:
                missing = _MISSING_FILE_PATTERN.search(str(error))
                element = _ELEMENT_PATTERN.search(str(error))
                if not missing and element and (mesh := lighter_bodies.get(element[1])):
                    raise DescriptionError(
                        f"{self.source_location(element[1], 'body')}: body '{element[1]}' has its "
                        f"mass from '{mesh}', which is not there: put the file there, or give the "
                        "body an <inertial>"
                    ) from None
                if not missing or (not is_removed and files[-1] != files[0]):
                    raise
                files.append(missing[1])
        self.note_unsupported(
            "meshes and pictures that are not there", *(Path(x).name for x in files)
        )
        if lighter_bodies:
            self.note_difference(
                "bodies without the mass of their meshes, which are not there", *lighter_bodies
            )
        return model

    def _read_with_includes(
        self, file: Path, including_files: list[Path], root_tag: str = "mujoco"
    ) -> int:
        """Read a file and its includes strictly, and return the number of their elements."""
        if file in including_files:
            raise DescriptionError(
                f"{including_files[-1].name}: includes {file.name} in a circle, break it"
            )
        if file in self._element_counts:
            return self._element_counts[file]
        xml = XmlFile(file)
        if xml.root.tag not in {root_tag, "mujoco"}:
            raise xml.error_at(
                xml.root, f"a MJCF file starts with <{root_tag}>, this file with <{xml.root.tag}>"
            )
        self._files.append(xml)
        included, models = {}, {}
        for part in xml.root.iter("include", "model"):
            name = part.get("file", "")
            other = self._files[0].file.parent / name
            if not name or not os.path.isfile(other):  # also for invalid names
                raise xml.error_at(
                    part, f"there is no file '{name[:100]}' to {part.tag}, check the path"
                )
            included_by = [*including_files, file]
            if part.tag == "include":
                included[name] = self._read_with_includes(other, included_by, "mujocoinclude")
            else:
                stem = part.get("name") or other.stem
                models[stem] = self._read_with_includes(other, included_by)
        for element in xml.root.iter(*_FLEXIBLE_ELEMENTS):
            raise xml.error_at(element, "flexible bodies are no machine's, leave out")
        for element in xml.root.iter(*_SIZE_ATTRIBUTES, *_MAX_ATTRIBUTE_VALUES):
            _check_sizes(xml, element)
        self._element_counts[file], _ = _count_elements(xml, xml.root, included, models)
        return self._element_counts[file]

    def _compilation_error(self, text: str) -> DescriptionError:
        """Return an error in one line with file and line from MuJoCo's message."""
        text = " ".join(text.split())
        line = re.search(r",? line (\d+)", text)
        where = self.file.name
        if line and len(self._files) == 1:
            where += f":{line[1]}"
            text = text.replace(line[0], "")
        text = re.sub(r"^(XML )?Error: ", "", text).rstrip(" .'") or "cannot be read"
        return DescriptionError(f"{where}: MuJoCo refuses it ({text}), correct it")

    def element_name(self, object_type: str, index: int) -> str:
        """Return the name of a compiled element, "" if it has none.

        Args:
            object_type: A name of `mujoco.mjtObj`, such as "BODY".
            index: Index of the element.
        """
        found = self._mujoco.mj_id2name(
            self.model, getattr(self._mujoco.mjtObj, f"mjOBJ_{object_type}"), index
        )
        return found or ""

    def enumeration_name(self, enumeration: str, value: int) -> str:
        """Return the name of a value of an enumeration of MuJoCo, such as HINGE of "Joint"."""
        return str(getattr(self._mujoco, f"mjt{enumeration}")(value).name).partition("_")[2]

    def name(self, object_type: str, index: int) -> str:
        """Return the name of a compiled element, or a generated one such as joint2."""
        number = index + (object_type != "BODY")
        return self.element_name(object_type, index).strip() or f"{object_type.lower()}{number}"

    def kinematics(self, qpos: np.ndarray, data: Any = None) -> Any:
        """Return MuJoCo's `MjData` with sites, axes of joints and tendons at coordinates (nq,).

        Args:
            qpos: The coordinates.
            data: What receives them; new if not given.
        """
        data = self._mujoco.MjData(self.model) if data is None else data
        data.qpos[:] = qpos
        for step in ("mj_kinematics", "mj_comPos", "mj_tendon"):
            getattr(self._mujoco, step)(self.model, data)
        return data

    def point_jacobian(self, data: Any, point: np.ndarray, body: int) -> np.ndarray:
        """Return the Jacobian (3, nv) of a point (3,) in the world that moves with a body."""
        jacobian = np.zeros((3, self.model.nv))
        self._mujoco.mj_jac(self.model, data, jacobian, None, point, body)
        return jacobian

    def joint_type(self, joint: int) -> str:
        """Return the type of a joint: HINGE, SLIDE, BALL or FREE."""
        return self.enumeration_name("Joint", self.model.jnt_type[joint])

    def note_unsupported_elements(
        self, feature: str, object_type: str, indices: Iterable[int]
    ) -> None:
        """Note that compiled elements, if there are any, have a feature that is left out."""
        if names := [self.name(object_type, index) for index in indices]:
            self.note_unsupported(feature, *names)

    def tendon_path(self, tendon: int) -> list[tuple[str, int, float]]:
        """Return the type, the index and the parameter of each object on the way of a tendon."""
        model, start = self.model, self.model.tendon_adr[tendon]
        return [
            (
                self.enumeration_name("Wrap", model.wrap_type[i]),
                int(model.wrap_objid[i]),
                float(model.wrap_prm[i]),
            )
            for i in range(start, start + model.tendon_num[tendon])
        ]

    def transmission(self, actuator: int) -> tuple[str, int]:
        """Return the type of an actuator's transmission, such as JOINT, and its target's index."""
        kind = self.enumeration_name("Trn", self.model.actuator_trntype[actuator])
        target = int(self.model.actuator_trnid[actuator, 0])
        return "JOINT" if kind == "JOINTINPARENT" else kind, target

    @property
    def disabled_features(self) -> set[str]:
        """Names of the parts of MuJoCo's model that the file disables, such as CONTACT."""
        return {
            name.partition("_")[2]
            for name, bit in self._mujoco.mjtDisableBit.__members__.items()
            if name.startswith("mjDSBL_") and self.model.opt.disableflags & int(bit)
        }

    def source_location(self, name: str, *tags: str) -> str:
        """Return file and line of the element with a name; the file alone if it is not found."""
        places = (
            xml.source_location(element)
            for xml in self._files
            for element in xml.root.iter(*tags)
            if name and element.get("name") == name
        )
        return next(places, self.file.name)

    def equality_location(self, index: int) -> str:
        """Return file and line of an equality constraint by its index."""
        locations = [
            xml.source_location(child)
            for xml in self._files
            for part in xml.root.iter("equality")
            for child in part
        ]
        return locations[index] if len(locations) == self.model.neq else self.file.name


def nonzero_rows(model: Any, field: str) -> list[int]:
    """Return the rows of a field with a nonzero value, none if this MuJoCo lacks the field."""
    values = getattr(model, field, None)
    if values is None or not np.size(values):
        return []
    return [
        int(row) for row in np.flatnonzero(np.any(np.reshape(values, (len(values), -1)), axis=1))
    ]


def pose(quaternion: np.ndarray, position: np.ndarray) -> pin.SE3:
    """Return a pose from a quaternion, w first, and a position (3,), as MuJoCo stores them.

    A quaternion of length zero is no rotation.
    """
    return pin.SE3(pin.Quaternion(*quaternion).normalized().toRotationMatrix(), position.copy())
