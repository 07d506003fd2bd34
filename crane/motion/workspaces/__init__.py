"""Workspaces: reachable positions of the tip, singular curves and extremes."""

from crane.motion.workspaces.workspace_mapping import workspace
from crane.motion.workspaces.workspace_result import SingularCurve, Workspace, WorkspaceExtreme

__all__ = ["SingularCurve", "WorkspaceExtreme", "Workspace", "workspace"]
