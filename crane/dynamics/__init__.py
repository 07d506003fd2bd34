"""Equations of motion in the active coordinates."""

from crane.dynamics.dynamics import Dynamics
from crane.dynamics.joint_forces import JointForces

__all__ = ["Dynamics", "JointForces"]
