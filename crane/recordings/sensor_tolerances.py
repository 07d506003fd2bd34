"""By how much what is recorded may be off [rad], [m]; of small machines a share of their size."""

from collections.abc import Mapping

from crane.machine import Machine

AGREEMENT_TOLERANCE = {"rad": 5e-3, "m": 5e-4}  # sensors of one quantity
HELD_JOINT_TOLERANCE = {"rad": 0.02, "m": 2e-3}  # a joint that is held


def tolerance(tolerances: Mapping[str, float], machine: Machine, unit: str) -> float:
    """A deviation of a unit, smaller in a machine of less than a metre."""
    return tolerances[unit] * (
        min(machine.closure.characteristic_length, 1.0) if unit == "m" else 1.0
    )
