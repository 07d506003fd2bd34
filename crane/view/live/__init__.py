"""Live view of a machine: sliders for its active joints, with loops closed at every move."""

from crane.view.live.live_session import Readout, Session

__all__ = ["Readout", "Session"]
