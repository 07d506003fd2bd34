"""Linear models of a machine about an operating point, its modes and frequency responses."""

from crane.simulation.linear.model import LinearModel, Mode
from crane.simulation.linear.models import linear_models, linearize

__all__ = ["LinearModel", "Mode", "linear_models", "linearize"]
