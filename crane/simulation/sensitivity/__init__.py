"""Sensitivities of a simulation."""

from crane.simulation.sensitivity.named import Sensitivities, sensitivities

__all__ = ["Sensitivities", "sensitivities"]
