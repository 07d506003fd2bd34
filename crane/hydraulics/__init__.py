"""The hydraulic circuit: its parts, the laws of their flows, the equations of the whole."""

from crane.hydraulics.circuit import Circuit
from crane.hydraulics.components import (
    Counterbalance,
    Cylinder,
    Hydraulics,
    Oil,
    PDGains,
    Supply,
    Valve,
)

__all__ = [
    "Circuit", "Counterbalance", "Cylinder", "Hydraulics", "Oil", "PDGains", "Supply", "Valve",
]  # fmt: skip
