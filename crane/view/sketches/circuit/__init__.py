"""Drawings of hydraulic circuits with graphic symbols (ISO 1219-1)."""

from crane.view.sketches.circuit.circuit_drawing import circuit_figure, sketch_circuit

__all__ = ["circuit_figure", "sketch_circuit"]
