"""Machines in time: runs here; batches, replays, sensitivities, linear models in their modules."""

from crane.simulation.recorded import InterruptedRun
from crane.simulation.run import Force, Progress, integrate, simulate

__all__ = ["Force", "InterruptedRun", "Progress", "integrate", "simulate"]
