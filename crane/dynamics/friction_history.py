"""Friction that depends on the history of a motion: presliding and frictional memory."""

import numpy as np

from crane.common.samples import Array


def dahl_deflections(
    travel: Array, length: float, deflection: float = 0.0, last: float | None = None
) -> Array:
    """Deflections z (N,) of Dahl's law along a motion, dz = (1 - sign(v) z) ds / length.

    The steps are exact for a constant direction within each.

    Args:
        travel: (N,) coordinates s [m], [rad].
        length: Characteristic distance [m], [rad].
        deflection: z before the first sample.
        last: Coordinate before the first sample; default that of the first sample.

    Source: Dahl 1968, A solid friction model, Aerospace Corporation TOR-0158(3107-18)-1.
    """
    steps = np.diff(travel, prepend=travel[0] if last is None else last) / length
    z = np.empty(len(travel))
    for i, step in enumerate(steps.tolist()):
        limit = 1.0 if step > 0 else -1.0
        deflection = limit + (deflection - limit) * np.exp(-abs(step))
        z[i] = deflection
    return z


def remembered_speeds(
    v: Array, step: float, time_constant: float, speed: float = 0.0
) -> tuple[Array, float]:
    """Speeds w (N,) that a contact remembers along a motion, time_constant w' = |v| - w.

    The steps are exact for a constant speed within each.

    Args:
        v: (N,) velocities [m/s], [rad/s].
        step: Step of the samples [s].
        time_constant: [s].
        speed: w before the first sample.

    Returns:
        Speeds, and w after the last sample.
    """
    from scipy.signal import lfilter

    share = -np.expm1(-step / time_constant)
    w, state = lfilter([share], [1, share - 1], np.abs(v), zi=[(1 - share) * speed])
    return w, float(state[0] / (1 - share)) if len(v) else speed
