"""A file of a robot as URDF, whatever it is written in: xacro is expanded, SDF translated."""

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from crane.common.errors import CraneWarning
from crane.common.packages import giving
from crane.description.spec import ForceElement
from crane.formats.xacro.expand import expanded, needs_xacro
from crane.formats.xml import XmlFile
from crane.machine import Machine

_SDF = (".sdf", ".world")
_ROBOT, _EITHER = (".urdf", ".xacro", *_SDF), (".xml", ".mjcf")


@dataclass(frozen=True)
class Opened:
    """A robot as URDF.

    Attributes:
        xml: Its elements, each with the place where it was written.
        springs: What URDF has no place for.
    """

    xml: XmlFile
    springs: tuple[ForceElement, ...] = ()


def opened(file: Path) -> Opened:
    """The robot of a file.

    Raises:
        DescriptionError: It cannot be read, expanded or translated.
    """
    xml = XmlFile(file)
    if needs_xacro(xml):
        xml = expanded(xml)
    if file.suffix.lower() in _SDF and xml.root.tag not in ("sdf", "robot"):
        raise xml.fail(xml.root, f"an SDF starts with <sdf>, this file with <{xml.root.tag}>")
    if xml.root.tag == "sdf":
        from crane.formats.sdf.translate import translated  # most files are none

        return Opened(*translated(xml))
    return Opened(xml)


def is_robot(file: Path) -> bool:
    """Whether a file is XML that holds a robot and no MuJoCo model."""
    suffix = file.suffix.lower()
    if suffix in _EITHER:
        return XmlFile(file).root.tag in ("robot", "sdf")
    return suffix in _ROBOT


def is_sdf(file: Path) -> bool:
    """Whether a file is SDF."""
    suffix = file.suffix.lower()
    return suffix in _SDF or (suffix == ".xml" and XmlFile(file).root.tag == "sdf")


def is_simulators(file: Path) -> bool:
    """Whether a file is SDF or MJCF: it says all joints at home, and is not written into."""
    if file.suffix.lower() in (".yaml", ".yml"):
        return False
    return is_sdf(file) or not is_robot(file)


@contextmanager
def robots(machine: Machine, chains: Iterable[str] | None = None) -> Iterator[list[XmlFile]]:
    """The robots that a machine was made of, while its packages are known; of MJCF there are none.

    Args:
        machine: The machine.
        chains: Names of the chains, all if not given.
    """
    wanted = None if chains is None else set(chains)
    with giving(machine.packages, machine.arguments):
        with warnings.catch_warnings():  # which were told when it was loaded
            warnings.simplefilter("ignore", CraneWarning)
            found = [
                opened(chain.urdf).xml
                for chain in machine.chains
                if is_robot(chain.urdf) and (not wanted or chain.name in wanted)
            ]
        yield found
