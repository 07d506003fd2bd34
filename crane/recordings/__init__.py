"""Recordings: what they hold, the files they come from, the numbers that sum them up."""

from crane.recordings.recording import Recording

__all__ = ["Recording"]
