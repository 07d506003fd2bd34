"""Self-contained page with a machine, its motion, forces and plots."""

from crane.view.page.report_page import open_in_browser, report
from crane.view.page.scene import Scene, build_scene

__all__ = ["Scene", "build_scene", "open_in_browser", "report"]
