"""Where a machine's parts are for given strokes: kinematics, trajectories, workspaces."""

from crane.motion.kinematics import Kinematics
from crane.motion.trajectories import Path, point_to_point, polynomial, task_path, tip_path

__all__ = ["Kinematics", "Path", "point_to_point", "polynomial", "task_path", "tip_path"]
