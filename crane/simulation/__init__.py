"""Machines in time: runs here; batches, replays, sensitivities, linear models in their modules."""

from crane.simulation.recorded_run import InterruptedRun
from crane.simulation.simulation_run import Progress, integrate, simulate
from crane.simulation.simulation_setup import Force

__all__ = ["Force", "InterruptedRun", "Progress", "integrate", "simulate"]
