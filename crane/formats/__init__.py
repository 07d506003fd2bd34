"""Writing machines in other formats."""

from crane.formats.machine_file import write_machine
from crane.formats.mjcf import write_mjcf
from crane.formats.urdf_plus import write_urdf_plus

__all__ = ["write_machine", "write_mjcf", "write_urdf_plus"]
