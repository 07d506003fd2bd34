"""Kinematics of frames, trajectories, transmissions, sway suppression and workspaces."""

from crane.motion.attitude import via_attitudes
from crane.motion.kinematics import Kinematics
from crane.motion.path_reader import read_path
from crane.motion.sway import Sway
from crane.motion.sway_suppression import retime, suppress_sway
from crane.motion.task_trajectories import task_trajectory, tip_trajectory
from crane.motion.trajectory import (
    AttitudeTrajectory,
    Trajectory,
    point_to_point,
    polynomial,
    via_points,
)
from crane.motion.transmission import JointState, Transmission

__all__ = [
    "JointState",
    "Kinematics",
    "Sway",
    "Trajectory",
    "Transmission",
    "AttitudeTrajectory",
    "point_to_point",
    "polynomial",
    "read_path",
    "retime",
    "task_trajectory",
    "tip_trajectory",
    "via_attitudes",
    "via_points",
    "suppress_sway",
]
