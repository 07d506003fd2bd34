"""Where a machine's parts are for given strokes: kinematics, trajectories, workspaces."""

from crane.motion.attitude import Turning, via_attitudes
from crane.motion.curves import Trajectory, point_to_point, polynomial, via_points
from crane.motion.kinematics import Kinematics
from crane.motion.paths import read_path
from crane.motion.sway import Sway, retimed, without_sway
from crane.motion.trajectories import task_trajectory, tip_trajectory
from crane.motion.transmission import JointState, Transmission

__all__ = [
    "JointState",
    "Kinematics",
    "Sway",
    "Trajectory",
    "Transmission",
    "Turning",
    "point_to_point",
    "polynomial",
    "read_path",
    "retimed",
    "task_trajectory",
    "tip_trajectory",
    "via_attitudes",
    "via_points",
    "without_sway",
]
