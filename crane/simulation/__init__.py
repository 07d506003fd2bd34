"""Machines in time."""

from crane.simulation.recorded import imbalance
from crane.simulation.run import Force, simulate, trajectory
from crane.simulation.steps import Progress

__all__ = ["Force", "Progress", "imbalance", "simulate", "trajectory"]
