"""The hydraulic circuit: its parts, the laws of their flows, the equations of the whole."""

from crane.hydraulics.circuit import Circuit
from crane.hydraulics.components import (
    Counterbalance,
    Cylinder,
    Hydraulics,
    Oil,
    PDGains,
    Spool,
    Valve,
)
from crane.hydraulics.curve import Curve
from crane.hydraulics.elements import Accumulator, Element, Line
from crane.hydraulics.sources import Engine, Supply

__all__ = [
    "Accumulator", "Circuit", "Counterbalance", "Curve", "Cylinder", "Element", "Engine",
    "Hydraulics", "Line", "Oil", "PDGains", "Spool", "Supply", "Valve",
]  # fmt: skip
