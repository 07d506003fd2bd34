"""Seeing a machine move: one offline page that plays a recording in any browser."""

from crane.view.page import open_in_browser, write_page
from crane.view.scene import Scene, build_scene

__all__ = ["Scene", "build_scene", "open_in_browser", "write_page"]
