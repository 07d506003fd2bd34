"""A MJCF file compiled by MuJoCo, with the lines of its elements for errors."""

import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from crane.common.errors import CraneWarning, DescriptionError
from crane.common.optional_libraries import import_optional_library
from crane.formats.mjcf.missing_meshes import (
    MassMissingError,
    compile_without_missing_files,
    missing_file,
)
from crane.formats.mjcf.size_limits import count_elements
from crane.formats.xml_file import XmlFile

_MAX_SHOWN_NAMES = 6  # names in a line


class MujocoFile:
    """A MJCF file.

    MuJoCo itself reads it, so that defaults, includes, units of angles, inertias from shapes and
    all else mean what they mean there. Before, the file is read as strictly as every XML.

    Args:
        file: The file.

    Attributes:
        file: The file.
        model: MuJoCo's `MjModel`.

    Raises:
        InputError: MuJoCo is not installed.
        DescriptionError: The file or what it includes is wrong.
    """

    def __init__(self, file: Path):
        self.file = file
        self._files: list[XmlFile] = []
        self._unsupported_features: dict[str, list[str]] = {}
        self._differences: dict[str, list[str]] = {}
        self._element_counts: dict[Path, int] = {}
        self._read_with_includes(file, [])
        self._mujoco = mujoco = import_optional_library("mujoco", f"{file.name}: reading MJCF")
        messages: list[str] = []
        previous_handler = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(messages.append)  # else into a file in the working folder
        try:
            self.model: Any = self._compile()
        except MassMissingError as error:
            raise DescriptionError(
                f"{self.source_location(error.body, 'body')}: body '{error.body}' has its mass "
                f"from "
                f"'{error.mesh}', which is not there: put the file there, or give the body an "
                "<inertial>"
            ) from None
        except Exception as error:  # ValueError, FatalError, and others of its parts
            raise self._compilation_error(str(error) or type(error).__name__) from None
        finally:
            mujoco.set_mju_user_warning(previous_handler)
        if messages := [" ".join(text.split()) for text in dict.fromkeys(messages)]:
            self.warn(f"MuJoCo says {'; '.join(messages)}")

    def _compile(self) -> Any:
        """MuJoCo's model, without shapes and pictures whose files are not there."""
        path = str(self.file)
        try:
            return self._mujoco.MjModel.from_xml_path(path)
        except ValueError as error:
            if not (name := missing_file(str(error))):
                raise
        model, files, lighter_bodies = compile_without_missing_files(self._mujoco, path, name)
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
        """Read a file and what it includes, strictly; the number of elements it stands for."""
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
            try:
                is_there = bool(name) and other.is_file()
            except (OSError, ValueError):  # a name longer than any file's
                is_there = False
            if not is_there:
                raise xml.error_at(
                    part, f"there is no file '{name[:100]}' to {part.tag}, check the path"
                )
            included_by = [*including_files, file]
            if part.tag == "include":
                included[name] = self._read_with_includes(other, included_by, "mujocoinclude")
            else:
                stem = part.get("name") or other.stem
                models[stem] = self._read_with_includes(other, included_by)
        self._element_counts[file], _ = count_elements(xml, included, models)
        return self._element_counts[file]

    def _compilation_error(self, text: str) -> DescriptionError:
        """MuJoCo's words, which span lines, as one line with the place."""
        text = " ".join(text.split())
        line = re.search(r",? line (\d+)", text)
        where = self.file.name
        if line and len(self._files) == 1:
            where += f":{line[1]}"
            text = text.replace(line[0], "")
        text = re.sub(r"^(XML )?Error: ", "", text).rstrip(" .'") or "cannot be read"
        return DescriptionError(f"{where}: MuJoCo refuses it ({text}), correct it")

    def element_name(self, object_type: str, index: int) -> str:
        """Name of a compiled element, empty where it has none.

        Args:
            object_type: Of `mujoco.mjtObj`, such as "BODY".
            index: Its number.
        """
        found = self._mujoco.mj_id2name(
            self.model, getattr(self._mujoco.mjtObj, f"mjOBJ_{object_type}"), index
        )
        return found or ""

    def enumeration_name(self, enumeration: str, value: int) -> str:
        """Name of a value of an enumeration of MuJoCo, such as HINGE of "Joint"."""
        return str(getattr(self._mujoco, f"mjt{enumeration}")(value).name).partition("_")[2]

    def body_name(self, index: int) -> str:
        """Name of a body, invented where it has none."""
        return self.element_name("BODY", index).strip() or f"body{index}"

    def joint_name(self, index: int) -> str:
        """Name of a joint, invented where it has none."""
        return self.element_name("JOINT", index).strip() or f"joint{index + 1}"

    def tendon_name(self, index: int) -> str:
        """Name of a tendon, invented where it has none."""
        return self.element_name("TENDON", index).strip() or f"tendon{index + 1}"

    def actuator_name(self, index: int) -> str:
        """Name of an actuator, invented where it has none."""
        return self.element_name("ACTUATOR", index).strip() or f"actuator{index + 1}"

    def transmission(self, actuator: int) -> tuple[str, int]:
        """What an actuator acts by, such as JOINT or TENDON, and the number of that."""
        kind = self.enumeration_name("Trn", self.model.actuator_trntype[actuator])
        target = int(self.model.actuator_trnid[actuator, 0])
        return "JOINT" if kind == "JOINTINPARENT" else kind, target

    @property
    def disabled_features(self) -> set[str]:
        """What the file switches off of MuJoCo's computing, such as CONTACT."""
        bits = self._mujoco.mjtDisableBit.__members__
        return {
            name.partition("_")[2]
            for name, bit in bits.items()
            if name.startswith("mjDSBL_") and self.model.opt.disableflags & int(bit)
        }

    def source_location(self, name: str, *tags: str) -> str:
        """File and line of the element with a name, as far as it can be found."""
        places = (
            xml.source_location(element)
            for xml in self._files
            for element in xml.root.iter(*tags)
            if name and element.get("name") == name
        )
        return next(places, self.file.name)

    def equality_location(self, index: int) -> str:
        """File and line of an equality constraint by its number."""
        found: list[tuple[XmlFile, etree._Element]] = [
            (xml, child) for xml in self._files for part in xml.root.iter("equality")
            for child in part
        ]  # fmt: skip
        if len(found) != self.model.neq:
            return self.file.name
        xml, element = found[index]
        return xml.source_location(element)

    def note_unsupported(self, feature: str, *names: str) -> None:
        """Note what is left out, to be told in one line with all else."""
        self._unsupported_features.setdefault(feature, []).extend(names)

    def note_difference(self, difference: str, *names: str) -> None:
        """Note what is taken otherwise than MuJoCo does."""
        self._differences.setdefault(difference, []).extend(names)

    def warn_about_notes(self) -> None:
        """Warn of all that has been noted, in a line of each kind."""
        for heading, notes in (
            ("left out of what MuJoCo has", self._unsupported_features),
            ("otherwise than in MuJoCo", self._differences),
        ):
            words = [f"{what} ({list_names(x)})" if x else what for what, x in notes.items()]
            if words:
                self.warn(f"{heading}: {'; '.join(words)}")

    def warn(self, text: str) -> None:
        """Warn at once."""
        warnings.warn(f"{self.file.name}: {text}", CraneWarning, stacklevel=3)


def list_names(names: Iterable[str]) -> str:
    """Names, the first of many."""
    names = list(dict.fromkeys(names))
    remainder = [f"{len(names) - _MAX_SHOWN_NAMES} more"] if len(names) > _MAX_SHOWN_NAMES else []
    return ", ".join(names[:_MAX_SHOWN_NAMES] + remainder)


def nonzero_rows(model: Any, field: str) -> list[int]:
    """Rows of a field in which a number is not zero; newer versions have more than older ones."""
    values = getattr(model, field, None)
    if values is None or not np.size(values):
        return []
    found: list[int] = np.flatnonzero(
        np.any(np.reshape(values, (len(values), -1)), axis=1)
    ).tolist()
    return found
