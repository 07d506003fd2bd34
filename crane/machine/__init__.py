"""Machine: what was described, assembled and closed."""

from crane.machine.loading import load, recalled
from crane.machine.machine import Machine, Payload

__all__ = ["Machine", "Payload", "load", "recalled"]
