"""Readers and writers of machines: machine file, URDF, SDF, MJCF, parallel robots, meshes."""

from crane.formats.home_writer import write_home
from crane.formats.machine_file.machine_reader import read_machine_spec
from crane.formats.machine_file.machine_writer import write_machine
from crane.formats.machine_loading import load, load_from_expression
from crane.formats.mjcf.mjcf_writer import write_mjcf
from crane.formats.urdf.urdf_writer import robot_description, write_urdf_plus

__all__ = [
    "load",
    "read_machine_spec",
    "load_from_expression",
    "robot_description",
    "write_home",
    "write_machine",
    "write_mjcf",
    "write_urdf_plus",
]
