"""Where the strokes of a machine take its tip, and where they cannot."""

from crane.motion.workspaces.workspace_mapping import workspace
from crane.motion.workspaces.workspace_result import SingularCurve, Workspace, WorkspaceExtreme

__all__ = ["SingularCurve", "WorkspaceExtreme", "Workspace", "workspace"]
