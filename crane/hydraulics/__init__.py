"""The hydraulic circuit: its parts, the laws of their flows, the equations of the whole."""

from crane.hydraulics.circuit_elements import Accumulator, CircuitElement, CircuitLine
from crane.hydraulics.circuit_equations import CircuitEquations
from crane.hydraulics.components import (
    CounterbalanceValve,
    Cylinder,
    Hydraulics,
    Oil,
    PDGains,
    Spool,
    Valve,
)
from crane.hydraulics.opening_curve import OpeningCurve
from crane.hydraulics.supply_and_engine import Engine, Supply

__all__ = [
    "Accumulator",
    "CircuitEquations",
    "CounterbalanceValve",
    "OpeningCurve",
    "Cylinder",
    "CircuitElement",
    "Engine",
    "Hydraulics",
    "CircuitLine",
    "Oil",
    "PDGains",
    "Spool",
    "Supply",
    "Valve",
]
