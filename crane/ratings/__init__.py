"""Ratings of machines: lifting capacity, tool and break-out forces, working range."""

from crane.ratings.breakout_forces import Breakout, breakout
from crane.ratings.lifting_capacity import Capacity, Torques, capacity, torques
from crane.ratings.rating_rules import RULES, Rule
from crane.ratings.tool_forces import ToolForce, tool_force
from crane.ratings.working_ranges import WorkingRange, working_range

__all__ = [
    "RULES", "Breakout", "Capacity", "Rule", "ToolForce", "Torques", "WorkingRange", "breakout",
    "capacity", "tool_force", "torques", "working_range",
]  # fmt: skip
