"""Recordings of machines: columns, files, logs of other programs, checks and summaries."""

from crane.recordings.recording import Recording

__all__ = ["Recording"]
