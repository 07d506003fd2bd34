"""Where a machine's parts are for given strokes: kinematics, trajectories, workspaces."""

from crane.motion.kinematics import Kinematics
from crane.motion.sway import Sway, retimed, without_sway
from crane.motion.trajectories import (
    Trajectory,
    point_to_point,
    polynomial,
    task_trajectory,
    tip_trajectory,
)

__all__ = [
    "Kinematics",
    "Sway",
    "Trajectory",
    "point_to_point",
    "polynomial",
    "retimed",
    "task_trajectory",
    "tip_trajectory",
    "without_sway",
]
