"""The hydraulic circuit: valves, cylinders, supply."""

from crane.hydraulics.circuit import Circuit

__all__ = ["Circuit"]
