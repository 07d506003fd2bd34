"""Sensitivities of a simulation."""

from crane.simulation.sensitivity.functional import Gradient, gradient
from crane.simulation.sensitivity.named import Sensitivities, sensitivities

__all__ = ["Gradient", "Sensitivities", "gradient", "sensitivities"]
