"""Machine: what was described, assembled and closed."""

from crane.machine.machine import Machine
from crane.machine.payload import Payload

__all__ = ["Machine", "Payload"]
