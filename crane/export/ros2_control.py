"""A machine as a transmission of ros2_control: a package around its kinematics in C."""

import re
from pathlib import Path

from crane.common.atomic_output import check_folder_is_writable
from crane.common.errors import InputError
from crane.export.c_sources import CSources, c_identifier, write_texts
from crane.export.kinematics_program import KinematicsProgram
from crane.formats.machine_loading import load
from crane.machine.machine import Machine

_TEMPLATES = ("package.xml", "CMakeLists.txt", "machine_plugins.xml", "machine_transmission.cpp")


def write_ros2_control(
    machine: Machine | str | Path, folder: str | Path, *, name: str = "", overwrite: bool = True
) -> Path:
    """Write a machine as a package for ROS 2 with a transmission of ros2_control.

    Its actuators are the active joints, its joints those of the tree without ball joints;
    positions, velocities and efforts are mapped as by `crane.motion.Transmission`.

    Args:
        machine: The machine, or what `crane.load` takes.
        folder: Folder of the package.
        name: Its name; that of the machine by default.
        overwrite: Whether files of the same names are replaced.

    Returns:
        The folder.

    Raises:
        InputError: The base floats, or a ball joint is active; see `KinematicsProgram`.
        OutputError: The folder cannot be written.
    """
    check_folder_is_writable(Path(folder), overwrite)
    loaded = machine if isinstance(machine, Machine) else load(machine)
    sources = CSources(KinematicsProgram(loaded), package_name(name or loaded.name))
    balls = {i + k for i in loaded.coordinates.rotation_columns for k in range(3)}
    active = loaded.closure.active.tolist()
    if loaded.coordinates.floating_base_columns or balls.intersection(active):
        raise InputError(
            f"'{loaded.name}' has a floating base or an active ball joint, which no joints of ROS "
            "are: fix the base, make other joints active"
        )
    joints = [(i, joint) for i, joint in enumerate(loaded.joints) if i not in balls]
    values = {
        "ACTUATORS": ", ".join(f'{{{i}, "{loaded.joints[i]}"}}' for i in active),
        "TREE_JOINTS": ", ".join(f'{{{i}, "{joint}"}}' for i, joint in joints),
    }
    texts = {f"{sources.name}.h": sources.header(), f"{sources.name}.c": sources.source()}
    for template in _TEMPLATES:
        file = template.replace("machine", sources.name)
        texts[file] = sources.fill(f"ros2_control/{template}", values)
    return write_texts(folder, texts, overwrite)


def package_name(name: str) -> str:
    """A name as that of a package: lower-case letters, digits and single underscores."""
    return re.sub("_+", "_", c_identifier(name).lower()).strip("_")
