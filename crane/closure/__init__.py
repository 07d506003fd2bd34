"""Loops and their closure."""

from crane.closure.closure import Closure
from crane.closure.loop_equations import frame_id

__all__ = ["Closure", "frame_id"]
