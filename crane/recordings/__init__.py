"""Recordings: what they hold, the files they come from, the numbers that sum them up."""

from crane.recordings.measured import read_measured
from crane.recordings.recording import Recording

__all__ = ["Recording", "read_measured"]
