"""A machine to play with: sliders for its active joints, its loops closed at every move."""

from crane.view.live.session import Posture, Session

__all__ = ["Posture", "Session"]
