"""Machines from files and into them: machine file, URDF, MJCF, parallel robots, meshes."""

from crane.formats.in_place import write_home
from crane.formats.loading import load, recalled
from crane.formats.machine_file.read import read
from crane.formats.machine_file.write import write_machine
from crane.formats.mjcf.write import write_mjcf
from crane.formats.urdf.description import robot_description
from crane.formats.urdf.write import write_urdf_plus

__all__ = [
    "load", "read", "recalled", "robot_description", "write_home", "write_machine", "write_mjcf",
    "write_urdf_plus",
]  # fmt: skip
