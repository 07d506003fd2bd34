"""Loops and their closure."""

from crane.closure.closure import Closure
from crane.closure.equations import frame_id

__all__ = ["Closure", "frame_id"]
