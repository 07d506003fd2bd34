"""Straight-line machine code from traced arithmetic."""

from crane.straight.machine_code import Program, TooLongError
from crane.straight.scalar import Expression, Number, Tape, largest, maximum

__all__ = ["Expression", "Number", "Program", "Tape", "TooLongError", "largest", "maximum"]
