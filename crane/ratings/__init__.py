"""What a machine lifts, how hard it digs, and how far it works."""

from crane.ratings.digging import Breakout, breakout
from crane.ratings.lifting import Capacity, capacity
from crane.ratings.moments import Torques, torques
from crane.ratings.ranges import WorkingRange, working_range
from crane.ratings.rules import RULES, Rule
from crane.ratings.tool import ToolForce, tool_force

__all__ = [
    "RULES", "Breakout", "Capacity", "Rule", "ToolForce", "Torques", "WorkingRange", "breakout",
    "capacity", "tool_force", "torques", "working_range",
]  # fmt: skip
