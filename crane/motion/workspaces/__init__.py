"""Where the strokes of a machine take its tip, and where they cannot."""

from crane.motion.workspaces.explore import workspace
from crane.motion.workspaces.result import Curve, Extreme, Workspace

__all__ = ["Curve", "Extreme", "Workspace", "workspace"]
