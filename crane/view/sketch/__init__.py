"""Drawings of a machine: its mechanism with dimensions, its hydraulic circuit."""

from crane.view.sketch.circuit.figure import sketch_circuit
from crane.view.sketch.draw import sketch

__all__ = ["sketch", "sketch_circuit"]
