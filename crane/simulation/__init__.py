"""Machines in time: runs, batches of them, recordings replayed."""

from crane.simulation.batch import Batch, simulate_batch
from crane.simulation.linear import LinearModel, Mode, linear_models, linearize
from crane.simulation.replays import Comparison, replay
from crane.simulation.run import Force, InterruptedRun, Progress, integrate, simulate
from crane.simulation.sensitivity import Gradient, Sensitivities, gradient, sensitivities

__all__ = [
    "Batch", "Comparison", "Force", "Gradient", "InterruptedRun", "LinearModel", "Mode",
    "Progress", "Sensitivities", "gradient", "integrate", "linear_models", "linearize", "replay",
    "sensitivities", "simulate", "simulate_batch",
]  # fmt: skip
