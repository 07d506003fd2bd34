"""Linear models of a machine about an operating point, its modes and frequency responses."""

from crane.simulation.linear.linear_model import LinearModel, Mode
from crane.simulation.linear.linearization import linear_models, linearize

__all__ = ["LinearModel", "Mode", "linear_models", "linearize"]
