"""A MJCF file compiled by MuJoCo, with the lines of its elements for errors."""

import re
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from crane.common.errors import CraneWarning, DescriptionError
from crane.common.extras import library
from crane.formats.mjcf.bounds import copies
from crane.formats.mjcf.missing import MassMissingError, missing_file, without_files
from crane.formats.xml import XmlFile

_SHOWN = 6  # names in a line


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
        self._lost: dict[str, list[str]] = {}
        self._otherwise: dict[str, list[str]] = {}
        self._sizes: dict[Path, int] = {}
        self._open(file, [])
        self._mujoco = mujoco = library("mujoco", f"{file.name}: reading MJCF")
        told: list[str] = []
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(told.append)  # else into a file in the working folder
        try:
            self.model: Any = self._compiled()
        except MassMissingError as error:
            raise DescriptionError(
                f"{self.where(error.body, 'body')}: body '{error.body}' has its mass from "
                f"'{error.mesh}', which is not there: put the file there, or give the body an "
                "<inertial>"
            ) from None
        except Exception as error:  # ValueError, FatalError, and others of its parts
            raise self._refused(str(error) or type(error).__name__) from None
        finally:
            mujoco.set_mju_user_warning(before)
        if told := [" ".join(text.split()) for text in dict.fromkeys(told)]:
            self.warn(f"MuJoCo says {'; '.join(told)}")

    def _compiled(self) -> Any:
        """MuJoCo's model, without shapes and pictures whose files are not there."""
        path = str(self.file)
        try:
            return self._mujoco.MjModel.from_xml_path(path)
        except ValueError as error:
            if not (name := missing_file(str(error))):
                raise
        model, files, lighter = without_files(self._mujoco, path, name)
        self.lose("meshes and pictures that are not there", *(Path(x).name for x in files))
        if lighter:
            self.differ("bodies without the mass of their meshes, which are not there", *lighter)
        return model

    def _open(self, file: Path, above: list[Path], wanted: str = "mujoco") -> int:
        """Read a file and what it includes, strictly; the number of elements it stands for."""
        if file in above:
            raise DescriptionError(f"{above[-1].name}: includes {file.name} in a circle, break it")
        if file in self._sizes:
            return self._sizes[file]
        xml = XmlFile(file)
        if xml.root.tag not in {wanted, "mujoco"}:
            raise xml.fail(
                xml.root, f"a MJCF file starts with <{wanted}>, this file with <{xml.root.tag}>"
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
                raise xml.fail(
                    part, f"there is no file '{name[:100]}' to {part.tag}, check the path"
                )
            above_it = [*above, file]
            if part.tag == "include":
                included[name] = self._open(other, above_it, "mujocoinclude")
            else:
                stem = part.get("name") or other.stem
                models[stem] = self._open(other, above_it)
        self._sizes[file], _ = copies(xml, included, models)
        return self._sizes[file]

    def _refused(self, text: str) -> DescriptionError:
        """MuJoCo's words, which span lines, as one line with the place."""
        text = " ".join(text.split())
        line = re.search(r",? line (\d+)", text)
        where = self.file.name
        if line and len(self._files) == 1:
            where += f":{line[1]}"
            text = text.replace(line[0], "")
        text = re.sub(r"^(XML )?Error: ", "", text).rstrip(" .'") or "cannot be read"
        return DescriptionError(f"{where}: MuJoCo refuses it ({text}), correct it")

    def name(self, kind: str, index: int) -> str:
        """Name of a compiled element, empty where it has none.

        Args:
            kind: Of `mujoco.mjtObj`, such as "BODY".
            index: Its number.
        """
        found = self._mujoco.mj_id2name(
            self.model, getattr(self._mujoco.mjtObj, f"mjOBJ_{kind}"), index
        )
        return found or ""

    def kind(self, family: str, value: int) -> str:
        """Name of a value of an enumeration of MuJoCo, such as HINGE of "Joint"."""
        return str(getattr(self._mujoco, f"mjt{family}")(value).name).partition("_")[2]

    def body(self, index: int) -> str:
        """Name of a body, invented where it has none."""
        return self.name("BODY", index).strip() or f"body{index}"

    def joint(self, index: int) -> str:
        """Name of a joint, invented where it has none."""
        return self.name("JOINT", index).strip() or f"joint{index + 1}"

    def tendon(self, index: int) -> str:
        """Name of a tendon, invented where it has none."""
        return self.name("TENDON", index).strip() or f"tendon{index + 1}"

    def actuator(self, index: int) -> str:
        """Name of an actuator, invented where it has none."""
        return self.name("ACTUATOR", index).strip() or f"actuator{index + 1}"

    def transmission(self, actuator: int) -> tuple[str, int]:
        """What an actuator acts by, such as JOINT or TENDON, and the number of that."""
        kind = self.kind("Trn", self.model.actuator_trntype[actuator])
        target = int(self.model.actuator_trnid[actuator, 0])
        return "JOINT" if kind == "JOINTINPARENT" else kind, target

    @property
    def switched_off(self) -> set[str]:
        """What the file switches off of MuJoCo's computing, such as CONTACT."""
        bits = self._mujoco.mjtDisableBit.__members__
        return {
            name.partition("_")[2]
            for name, bit in bits.items()
            if name.startswith("mjDSBL_") and self.model.opt.disableflags & int(bit)
        }

    def where(self, name: str, *tags: str) -> str:
        """File and line of the element with a name, as far as it can be found."""
        places = (
            xml.where(element)
            for xml in self._files
            for element in xml.root.iter(*tags)
            if name and element.get("name") == name
        )
        return next(places, self.file.name)

    def where_equality(self, index: int) -> str:
        """File and line of an equality constraint by its number."""
        found: list[tuple[XmlFile, etree._Element]] = [
            (xml, child) for xml in self._files for part in xml.root.iter("equality")
            for child in part
        ]  # fmt: skip
        if len(found) != self.model.neq:
            return self.file.name
        xml, element = found[index]
        return xml.where(element)

    def lose(self, what: str, *names: str) -> None:
        """Note what is left out, to be told in one line with all else."""
        self._lost.setdefault(what, []).extend(names)

    def differ(self, what: str, *names: str) -> None:
        """Note what is taken otherwise than MuJoCo does."""
        self._otherwise.setdefault(what, []).extend(names)

    def tell(self) -> None:
        """Warn of all that has been noted, in a line of each kind."""
        for head, noted in (
            ("left out of what MuJoCo has", self._lost),
            ("otherwise than in MuJoCo", self._otherwise),
        ):
            words = [f"{what} ({listed(x)})" if x else what for what, x in noted.items()]
            if words:
                self.warn(f"{head}: {'; '.join(words)}")

    def warn(self, text: str) -> None:
        """Warn at once."""
        warnings.warn(f"{self.file.name}: {text}", CraneWarning, stacklevel=3)


def listed(names: Iterable[str]) -> str:
    """Names, the first of many."""
    names = list(dict.fromkeys(names))
    more = [f"{len(names) - _SHOWN} more"] if len(names) > _SHOWN else []
    return ", ".join(names[:_SHOWN] + more)


def rows(model: Any, field: str) -> list[int]:
    """Rows of a field in which a number is not zero; newer versions have more than older ones."""
    values = getattr(model, field, None)
    if values is None or not np.size(values):
        return []
    found: list[int] = np.flatnonzero(
        np.any(np.reshape(values, (len(values), -1)), axis=1)
    ).tolist()
    return found
