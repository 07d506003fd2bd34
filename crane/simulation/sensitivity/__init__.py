"""Sensitivities of a simulation."""

from crane.simulation.sensitivity.motion_gradient import Gradient, gradient
from crane.simulation.sensitivity.motion_sensitivities import Sensitivities, sensitivities

__all__ = ["Gradient", "Sensitivities", "gradient", "sensitivities"]
