"""Identifiability: magnitudes of parameters, and undetermined directions."""

from collections.abc import Sequence

import numpy as np

from crane.common.samples import Array
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.feasible_parameters import body_size
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.signals.signal_processing import Motion
from crane.machine.machine import Machine

_MIN_NAMED_SHARE = 0.25  # least component that a text names
_MAX_NAMED = 4  # parameters that a text names
_FORCE_PARAMETERS = ("coulomb", "stiction", "presliding", "memory")
_MIN_STROKE_SHARE = 0.5  # share of the stroke that a joint should cover


def base_magnitudes(base: BaseParameters, parameter_sizes: Array) -> Array:
    """Magnitudes (r,) of base parameters: sqrt(sum_j (K_ij s_j)^2) for the group K_i.

    Args:
        base: Base parameters that a recording determines.
        parameter_sizes: Magnitudes s (p,) of all parameters, see `parameter_magnitudes`.
    """
    return np.asarray(np.sqrt(base.grouping**2 @ parameter_sizes**2))


def parameter_magnitudes(
    model: IdentificationModel, base: BaseParameters, factors: Array
) -> Array:
    """Magnitudes (p,) of parameters of such a machine, 0 without an effect.

    Those of a body are its described mass m, m l and m l^2 with the root mean square distance l of
    its mass from its joint (for bodies without mass the mean of the others). For other parameters
    it is the value that alone causes the whole force of a drive in this recording; for all
    friction forces of one joint the least of these.

    Args:
        model: The model.
        base: Base parameters that the recording determines.
        factors: Triangular factors (g, r + 1, r + 1) of [W y] for the rows of each drive.
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
    # for free joints the norm of the described force components
    parts = np.linalg.norm(factors[:, :, :-1], axis=1) * base.values(model.nominal)
    force = np.where(force > 0, force, np.linalg.norm(parts, axis=1))
    single_forces = np.linalg.norm(factors[:, :, :-1] @ base.grouping[:, count:], axis=1)
    has_effect = single_forces > 1e-9 * single_forces.max(axis=0, initial=0.0)
    share = np.divide(
        force[:, None], single_forces, out=np.full_like(single_forces, np.inf), where=has_effect
    )
    factors_of_force = share.min(axis=0, initial=np.inf)
    out[count:] = np.where(np.isfinite(factors_of_force), factors_of_force, 0.0)
    # friction that decays with speed or time affects few rows
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
    """Directions whose standard deviation exceeds the magnitudes, the weakest first.

    They are eigenvectors of the covariance of theta_i / magnitude_i; for equal noise, singular
    directions of the regressor with columns scaled by the magnitudes.

    Returns:
        Standard deviation in units of the magnitudes, and text of the direction, such as "0.71
        boom.mx + 0.70 stick.mx".
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
    """Text that recommends a motion to determine more parameters."""
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
