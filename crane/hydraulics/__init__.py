"""The hydraulic circuit of a machine: components, flows, and equations of the circuit."""

from crane.hydraulics.circuit_elements import (
    Accumulator,
    CircuitElement,
    CircuitLine,
    Engine,
    Supply,
)
from crane.hydraulics.circuit_equations import CircuitEquations
from crane.hydraulics.components import CounterbalanceValve, Cylinder, OpeningCurve, Spool, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics, Oil, PDGains

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
