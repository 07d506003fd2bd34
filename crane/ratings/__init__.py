"""What a machine lifts, how hard it digs, and how far it works."""

from crane.ratings.lifting import Capacity, capacity
from crane.ratings.moments import Torques, torques
from crane.ratings.rules import RULES, Rule

__all__ = ["RULES", "Capacity", "Rule", "Torques", "capacity", "torques"]
