"""A machine to play with: sliders for its active joints, its loops closed at every move."""

from crane.view.live.live_session import Readout, Session

__all__ = ["Readout", "Session"]
