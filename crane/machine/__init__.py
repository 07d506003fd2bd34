"""Machine: what was described, assembled and closed."""

from crane.machine.machine import Machine, Payload

__all__ = ["Machine", "Payload"]
