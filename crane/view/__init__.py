"""Seeing a machine move: one offline page with the machine, its forces and its numbers."""

from crane.view.page import open_in_browser, report
from crane.view.scene import Scene, build_scene

__all__ = ["Scene", "build_scene", "open_in_browser", "report"]
