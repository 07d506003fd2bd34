"""Drawings of a machine: sketch of its mechanism, and its hydraulic circuit."""

from crane.view.sketches.circuit.circuit_drawing import sketch_circuit
from crane.view.sketches.sketch_figure import sketch

__all__ = ["sketch", "sketch_circuit"]
