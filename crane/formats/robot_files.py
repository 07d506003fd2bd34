"""A file of a robot as URDF, whatever it is written in: xacro is expanded, SDF translated."""

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from crane.common.errors import CraneWarning
from crane.common.package_search import use_load_options
from crane.description.specification import ForceElement
from crane.formats.xacro.xacro_expansion import expand_xacro, needs_xacro
from crane.formats.xml_file import XmlFile
from crane.machine import Machine

_SDF_SUFFIXES = (".sdf", ".world")
_ROBOT_SUFFIXES, _AMBIGUOUS_SUFFIXES = (".urdf", ".xacro", *_SDF_SUFFIXES), (".xml", ".mjcf")


@dataclass(frozen=True)
class RobotDocument:
    """A robot as URDF.

    Attributes:
        xml: Its elements, each with the place where it was written.
        springs: What URDF has no place for.
    """

    xml: XmlFile
    springs: tuple[ForceElement, ...] = ()


def open_robot(file: Path) -> RobotDocument:
    """The robot of a file.

    Raises:
        DescriptionError: It cannot be read, expanded or translated.
    """
    xml = XmlFile(file)
    if needs_xacro(xml):
        xml = expand_xacro(xml)
    if file.suffix.lower() in _SDF_SUFFIXES and xml.root.tag not in ("sdf", "robot"):
        raise xml.error_at(xml.root, f"an SDF starts with <sdf>, this file with <{xml.root.tag}>")
    if xml.root.tag == "sdf":
        from crane.formats.sdf.sdf_translation import translate_to_urdf  # most files are none

        return RobotDocument(*translate_to_urdf(xml))
    return RobotDocument(xml)


def is_robot_file(file: Path) -> bool:
    """Whether a file is XML that holds a robot and no MuJoCo model."""
    suffix = file.suffix.lower()
    if suffix in _AMBIGUOUS_SUFFIXES:
        return XmlFile(file).root.tag in ("robot", "sdf")
    return suffix in _ROBOT_SUFFIXES


def is_sdf_file(file: Path) -> bool:
    """Whether a file is SDF."""
    suffix = file.suffix.lower()
    return suffix in _SDF_SUFFIXES or (suffix == ".xml" and XmlFile(file).root.tag == "sdf")


def is_simulator_file(file: Path) -> bool:
    """Whether a file is SDF or MJCF: it says all joints at home, and is not written into."""
    if file.suffix.lower() in (".yaml", ".yml"):
        return False
    return is_sdf_file(file) or not is_robot_file(file)


@contextmanager
def open_robots(machine: Machine, chains: Iterable[str] | None = None) -> Iterator[list[XmlFile]]:
    """The robots that a machine was made of, while its packages are known; of MJCF there are none.

    Args:
        machine: The machine.
        chains: Names of the chains, all if not given.
    """
    chain_names = None if chains is None else set(chains)
    with use_load_options(machine.packages, machine.arguments):
        with warnings.catch_warnings():  # which were told when it was loaded
            warnings.simplefilter("ignore", CraneWarning)
            documents = [
                open_robot(chain.urdf).xml
                for chain in machine.chains
                if is_robot_file(chain.urdf) and (not chain_names or chain.name in chain_names)
            ]
        yield documents
