"""Machines in time: runs, batches of them, recordings replayed."""

from crane.simulation.batch import Batch, simulate_batch
from crane.simulation.recorded import imbalance
from crane.simulation.replays import Comparison, replay
from crane.simulation.run import Force, Progress, integrate, simulate

__all__ = [
    "Batch", "Comparison", "Force", "Progress", "imbalance", "replay", "simulate",
    "simulate_batch", "integrate",
]  # fmt: skip
