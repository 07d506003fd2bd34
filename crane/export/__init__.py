"""Machines as programs for targets outside of Python."""

from crane.export.instance_program import InstanceProgram

__all__ = ["InstanceProgram"]
