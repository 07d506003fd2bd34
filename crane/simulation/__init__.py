"""Machines in time."""

from crane.simulation.recorded import imbalance
from crane.simulation.run import Force, Progress, simulate, trajectory

__all__ = ["Force", "Progress", "imbalance", "simulate", "trajectory"]
