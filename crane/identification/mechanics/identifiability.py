"""Which parameters a recording determines, and in which directions it does not."""

from collections.abc import Sequence

import numpy as np

from crane.common.samples import Array
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.feasible_parameters import body_size
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.signals.signal_processing import Motion
from crane.machine import Machine

_MIN_NAMED_SHARE = 0.25  # share in a direction that is named
_MAX_NAMED = 4  # parameters that are named of a direction
_FORCE_PARAMETERS = ("coulomb", "stiction", "presliding", "memory")
_MIN_STROKE_SHARE = 0.5  # of its stroke, that a joint should move over


def base_magnitudes(base: BaseParameters, parameter_sizes: Array) -> Array:
    """How large base parameters (r,) can be: sqrt(sum_j (K_ij s_j)^2) of the group K_i.

    Args:
        base: What of its base parameters a recording tells.
        parameter_sizes: s of all parameters (p,), see `parameter_magnitudes`.
    """
    return np.asarray(np.sqrt(base.grouping**2 @ parameter_sizes**2))


def parameter_magnitudes(
    model: IdentificationModel, base: BaseParameters, factors: Array
) -> Array:
    """How large parameters (p,) can be on such a machine, of one without any effect 0.

    A body's are its described mass m, m l and m l^2, l the root of the mean square distance of its
    mass from its joint (bodies without mass count as the mean of the others); of friction and the
    like what would alone make as much force as a drive's whole force in this recording; of all
    parts of one joint's friction that are forces the least of these.

    Args:
        model: The model.
        base: What of its base parameters the recording tells.
        factors: Triangular factors (g, r + 1, r + 1) of [W y] of each drive's rows.
    """
    count = 10 * len(model.bodies)
    out = np.zeros(len(model.names))
    bodies = [model.nominal[i : i + 10] for i in range(0, count, 10)]
    sizes = [body_size(body) if body[0] > 0 else (0.0, 0.0) for body in bodies]
    heavy = [size for size in sizes if min(size) > 0] or [(1.0, 1.0)]
    usual = tuple(np.mean(heavy, axis=0).tolist())
    for i, size in enumerate(sizes):
        mass, length = size if min(size) > 0 else usual
        out[10 * i : 10 * i + 10] = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
    force = np.linalg.norm(factors[:, :, -1], axis=1)
    # where nothing drives, what the described parts of the force are that add up to nothing
    parts = np.linalg.norm(factors[:, :, :-1], axis=1) * base.values(model.nominal)
    force = np.where(force > 0, force, np.linalg.norm(parts, axis=1))
    single_forces = np.linalg.norm(factors[:, :, :-1] @ base.grouping[:, count:], axis=1)
    has_effect = single_forces > 1e-9 * single_forces.max(axis=0, initial=0.0)
    share = np.divide(
        force[:, None], single_forces, out=np.full_like(single_forces, np.inf), where=has_effect
    )
    factors_of_force = share.min(axis=0, initial=np.inf)
    out[count:] = np.where(np.isfinite(factors_of_force), factors_of_force, 0.0)
    # friction that fades with speed or time is a force too, which few rows show
    force_parameters: dict[str, list[int]] = {}
    for i, name in enumerate(model.names[count:], start=count):
        where, _, kind = name.rpartition(".")
        if kind.startswith(_FORCE_PARAMETERS) and out[i] > 0:
            force_parameters.setdefault(where, []).append(i)
    for several in force_parameters.values():
        out[several] = out[several].min()
    return out


def weak_directions(
    names: Sequence[str], covariance: Array, magnitude: Array
) -> list[tuple[float, str]]:
    """Directions whose standard deviation exceeds what is possible, the weakest first.

    Eigenvectors of the covariance of theta_i / magnitude_i; for equal noise, those are the
    singular directions of the regressor with columns scaled by the magnitudes.

    Returns:
        Standard deviation in units of the magnitudes, and the direction in words, such as
        "0.71 boom.mx + 0.70 stick.mx".
    """
    unit = np.maximum(magnitude, np.finfo(float).tiny)
    scaled = covariance / unit / unit[:, None]
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    found = []
    for value, vector in sorted(zip(values, vectors.T, strict=True), key=lambda pair: -pair[0]):
        if value <= 1:
            break
        largest = np.argsort(-np.abs(vector))[:_MAX_NAMED]
        sign = np.sign(vector[largest[0]])
        words = ""
        for i in largest:
            share = float(sign * vector[i])
            if words and abs(share) < _MIN_NAMED_SHARE:
                break
            words += f" {'-' if share < 0 else '+'} {abs(share):.2f} {names[i]}"
        found.append((float(np.sqrt(value)), words.removeprefix(" + ")))
    return found


def motion_advice(machine: Machine, motions: Sequence[Motion]) -> str:
    """What to move more, to tell what was not told."""
    span = machine.upper - machine.lower
    moved = np.concatenate([[motion.q.min(axis=0), motion.q.max(axis=0)] for motion in motions])
    shares = np.ptp(moved, axis=0) / np.where(np.isfinite(span), span, np.inf)
    short_strokes = [
        f"{joint} ({100 * share:.0f} % of its stroke so far)"
        for joint, share, size in zip(machine.active, shares.tolist(), span.tolist(), strict=True)
        if np.isfinite(size) and share < _MIN_STROKE_SHARE
    ]
    if short_strokes:
        return f"record one that moves {', '.join(short_strokes)} further"
    return "record one that excites it (crane excite)"
