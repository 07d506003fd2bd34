"""Weights in a recording: what is left of its forces where nothing trembles, and at rest."""

from dataclasses import replace

import numpy as np

from crane.common.samples import Array
from crane.dynamics import Dynamics
from crane.identification.mechanics.force_delays import motion_frequency
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.mechanics.payload_estimate import PayloadTerm
from crane.identification.signals.signal_processing import Motion, is_moving, low_pass
from crane.machine import Machine

_REST_SPEED_SHARE = 0.05  # of a joint's largest velocity, below which it rests
_MIN_REST_DURATION = 0.25  # s of rest, that tell a mass
MIN_FRICTION_SHARE = 0.01  # of a drive's force, that its friction and its sensor may hide at rest
_CUTOFF_FACTOR = 10.0  # times the motion's frequency, below which weights are compared
_MIN_PERIODS = 5.0  # periods of that in a recording


def low_passed_motion(motion: Motion) -> Motion:
    """A motion without what trembles beyond `static_cutoff`."""
    cutoff, step = static_cutoff(motion), float(motion.time[1] - motion.time[0])
    if 4 * cutoff >= 1 / step:
        return motion
    v, a = (low_pass(motion.time, x, cutoff) for x in (motion.v, motion.a))
    return replace(motion, v=v, a=a)


def static_cutoff(motion: Motion) -> float:
    """Low-pass [Hz] below which forces are weights and friction."""
    step, duration = float(motion.time[1] - motion.time[0]), float(np.ptp(motion.time))
    wanted = max(_CUTOFF_FACTOR * motion_frequency(motion.q, step), _MIN_PERIODS / duration)
    return min(wanted, 0.24 / step)


def static_mass(
    machine: Machine,
    load: PayloadTerm,
    motion: Motion,
    friction_corrections: dict[str, float],
    com: Array,
) -> tuple[float, float] | None:
    """Mass by the forces at rest, and how much friction may hold of it; None if nothing rests.

    Each drive counts by its friction, described and found, as by a standard deviation.
    """
    step = float(motion.time[1] - motion.time[0])
    v = low_passed_motion(motion).v
    is_resting = ~is_moving(v, _REST_SPEED_SHARE * np.abs(v).max(axis=0)).any(axis=1)
    edges = np.flatnonzero(np.diff(is_resting.astype(np.int8), prepend=0, append=0))
    runs = [
        (i, j) for i, j in edges.reshape(-1, 2).tolist() if (j - i) * step >= _MIN_REST_DURATION
    ]
    if not runs:
        return None
    q = np.array([motion.q[i:j].mean(axis=0) for i, j in runs])
    tau = np.array([motion.tau[i:j].mean(axis=0) for i, j in runs])
    zero = np.zeros_like(q)
    tau = tau - Dynamics(machine).inverse(q, zero, zero)
    at = IdentificationModel(machine, [load]).samples(q, zero, zero)
    unit_forces = load.columns(at)[:, :, :4] @ np.append(1.0, com)
    friction_forces = np.array([breakaway_force(machine, joint) for joint in machine.active])
    friction_forces += [abs(friction_corrections.get(joint, 0.0)) for joint in machine.active]
    friction_forces = np.maximum(
        friction_forces, MIN_FRICTION_SHARE * np.sqrt(np.mean(motion.tau**2, axis=0))
    )
    information = ((unit_forces / friction_forces) ** 2).sum()
    if not information > 0:
        return None
    mass = float((unit_forces * tau / friction_forces**2).sum() / information)
    # where drives disagree by more than their friction, what they say is worth less
    misfit = float((((tau - unit_forces * mass) / friction_forces) ** 2).sum()) / max(
        unit_forces.size - 1, 1
    )
    return mass, float(np.sqrt(max(misfit, 1.0) * len(runs) / information))


def breakaway_force(machine: Machine, joint: str) -> float:
    """Largest friction of a joint at rest [N], [N m]."""
    law = machine.friction.get(joint)
    return 0.0 if law is None else law.coulomb + law.stiction + abs(law.coulomb_offset)
