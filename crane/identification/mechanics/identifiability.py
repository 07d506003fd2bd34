"""Magnitudes and priors of parameters, and what a recording does not determine."""

import fnmatch
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import qr

from crane.common.errors import InputError, check_name
from crane.common.samples import Array, as_number, as_sample
from crane.description.estimation_settings import ParameterPrior, estimation_units
from crane.identification.estimation.estimators import Estimate, Prior
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.feasible_parameters import body_size, body_units
from crane.identification.mechanics.identification_model import IdentificationModel
from crane.identification.signals.signal_processing import Motion
from crane.machine.machine import Machine

_MIN_NAMED_SHARE = 0.25  # least component that a text names
_MAX_NAMED = 4  # parameters that a text names
_FORCE_PARAMETERS = ("coulomb", "stiction", "presliding", "memory")
_MIN_STROKE_SHARE = 0.5  # share of the stroke that a joint should cover
_RANK_TOLERANCE = 1e-10  # relative size of a pivot of dependent columns
_MAX_LISTED = 8
_RELATIVE_STD_RANGE = 1e-7, 1e6  # range of a relative standard deviation


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
        out[10 * i : 10 * i + 10] = body_units(mass, length)
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
        named = [i for i in largest[1:] if abs(vector[i]) >= _MIN_NAMED_SHARE]
        words = ""
        for i in (largest[0], *named):
            share = float(sign * vector[i])
            words += f" {'-' if share < 0 else '+'} {abs(share):.2f} {names[i]}"
        found.append((float(np.sqrt(value)), words.removeprefix(" + ")))
    return found


def motion_advice(machine: Machine, motions: Sequence[Motion]) -> str:
    """Text that recommends a motion to determine more parameters."""
    span = machine.upper - machine.lower
    moved = np.concatenate([[motion.q.min(axis=0), motion.q.max(axis=0)] for motion in motions])
    shares = np.ptp(moved, axis=0) / np.where(np.isfinite(span), span, np.inf)
    short_strokes = [
        f"{joint} (so far {100 * share:.0f} % of its stroke)"
        for joint, share, size in zip(machine.active, shares.tolist(), span.tolist(), strict=True)
        if np.isfinite(size) and share < _MIN_STROKE_SHARE
    ]
    if short_strokes:
        return f"record a motion that moves these joints further: {', '.join(short_strokes)}"
    return "record a motion that determines them (crane excite)"


def read_priors(
    given: float | Mapping[str, object], machine: Machine
) -> dict[str, ParameterPrior]:
    """Parse priors by name; a single relative standard deviation is that of all parameters.

    Raises:
        InputError: A prior is not valid.
    """
    if isinstance(given, Mapping):
        turns = {joint: machine.unit(joint) == "rad" for joint in machine.joints}
        return {
            name: what
            if isinstance(what, ParameterPrior)
            else ParameterPrior.parse(what, estimation_units(name, turns))
            for name, what in given.items()
        }
    share = as_number(given, "the prior's relative standard deviation", "", *_RELATIVE_STD_RANGE)
    return {"*": ParameterPrior(share, relative=True)}


def prior_from_names(
    model: IdentificationModel, priors: Mapping[str, ParameterPrior], parameter_sizes: Array
) -> Prior:
    """Means (p,) and standard deviations (p,) of parameters from priors by name.

    A name is that of a parameter, of a body for its mass and all moments, "bodies" for all bodies,
    or a pattern; "*" matches everything, and the last match takes precedence. The prior of a body
    is a relative standard deviation r: r m, r m l, r m l^2. That of another parameter refers to
    its described value, or, if that is zero, to the described friction of the same joint and kind.
    Parameters without a prior or a described value have their magnitudes as standard deviations.

    Args:
        model: The model.
        priors: Priors by name.
        parameter_sizes: Magnitudes (p,), see `parameter_magnitudes`.

    Raises:
        InputError: A name is unknown, or the prior of a body is not relative.
    """
    mean, std = model.nominal.copy(), np.where(parameter_sizes > 0, parameter_sizes, 1.0)
    count = 10 * len(model.bodies)
    for name, what in priors.items():
        everything = name == "*"
        bodies = (
            list(model.bodies)
            if everything or name == "bodies"
            else _matching_names(
                model.bodies, name if "." not in name or name in model.bodies else ""
            )
        )
        if bodies and (not what.relative or what.mean is not None):
            raise InputError(
                f"prior '{name}' is {what}, of bodies give a share of mass and size, as 10 %, or "
                f"name one of their parameters, such as {bodies[0]}.m"
            )
        for body in bodies:
            body_slice = slice(10 * (at := model.bodies.index(body)), 10 * at + 10)
            mean[body_slice], std[body_slice] = (
                model.nominal[body_slice],
                what.std * parameter_sizes[body_slice],
            )
        others = model.names[count:] if everything else _matching_names(model.names, name)
        for i in map(model.names.index, others):
            mean[i] = model.nominal[i] if what.mean is None else what.mean
            # an offset of zero is relative to the friction that it is an offset of
            where, _, kind = model.names[i].rpartition(".")
            law = model.machine.friction.get(where) if kind.endswith("_offset") else None
            reference = abs(mean[i]) or float(getattr(law, kind.removesuffix("_offset"), 0.0))
            std[i] = (what.std * (reference if what.relative else 1.0)) or (
                parameter_sizes[i] or 1.0
            )
        place = name.rpartition(".")[0]
        if not bodies and not others and not fnmatch.filter(model.machine.locked_joints, place):
            check_name(name, (*model.bodies, *model.names[count:]), f"prior '{name}' is unknown")
    return mean, std


def _matching_names(names: Sequence[str], pattern: str) -> list[str]:
    """The name itself, or the names that match a pattern."""
    return [pattern] if pattern in names else fnmatch.filter(names, pattern)


def check_prior(
    model: IdentificationModel, base: BaseParameters, prior: Any, feasible: bool
) -> Prior:
    """Check means (p,) and standard deviations (p,) of all parameters of a model.

    Args:
        model: The model.
        base: Base parameters of the model.
        prior: The given prior.
        feasible: Whether bodies are constrained to be feasible.

    Raises:
        InputError: It is no pair of arrays (p,), or a standard deviation is not positive.
    """
    count = len(model.names)
    if not isinstance(prior, Sequence | np.ndarray) or len(prior) != 2:
        raise InputError(
            f"the prior is no pair, give means ({count},) and standard deviations ({count},) of "
            "the model's parameters, or one relative standard deviation of its bodies"
        )
    given = [np.shape(part) for part in prior]
    if given[0] == given[1] == (len(base.independent),) != (count,):
        raise InputError(
            f"the prior is about the {given[0][0]} base parameters, give means and standard "
            f"deviations of all {count} parameters of the model "
            "(IdentificationModel(machine).names), infinite ones for those without a prior"
        )
    mean = as_sample(prior[0], count, "the prior's means", model.names)
    std = np.asarray(prior[1], dtype=np.float64)
    as_sample(np.where(np.isposinf(std), 1.0, std), count, "the prior's deviations", model.names)
    if not (std > 0).all():
        i = int(std.argmin())
        raise InputError(
            f"the prior's deviation of '{model.names[i]}' is {std[i]:g}, give one above 0, "
            "infinite without a prior"
        )
    for i, body in enumerate(model.bodies if feasible else ()):
        if not mean[10 * i] > 0:
            raise InputError(
                f"the prior's mean of '{body}' has the mass {mean[10 * i]:g} kg, give it a "
                "positive one"
            )
    return mean, std


def check_identifiable(names: Sequence[str], W: Array, prior: Prior) -> None:
    """Check that a prior and a motion together determine all parameters.

    Args:
        names: Names of all parameters (p,).
        W: Regressor (m, p).
        prior: Means and standard deviations (p,).

    Raises:
        InputError: Parameters without a finite prior are not identifiable.
    """
    unknown_columns = np.flatnonzero(np.isinf(prior[1]))
    if not len(unknown_columns):
        return
    columns = W[:, unknown_columns]
    length = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(length > 0, length, 1.0)
    triangle, pivots = qr(columns, mode="r", pivoting=True)
    pivot = np.abs(np.diag(triangle))
    rank = int((pivot > _RANK_TOLERANCE * max(pivot[0], 1e-300)).sum())
    if rank == len(unknown_columns):
        return
    # the null space shows the dependent parameters
    rest = np.linalg.solve(triangle[:rank, :rank], triangle[:rank, rank:])
    shares = np.concatenate([np.abs(rest).max(axis=1), np.ones(len(unknown_columns) - rank)])
    undetermined = sorted(unknown_columns[pivots[shares > 1e-6]])
    listed = ", ".join(names[i] for i in undetermined[:_MAX_LISTED]) + ", ..." * (
        len(undetermined) > _MAX_LISTED
    )
    raise InputError(
        f"there is no finite prior of {listed}, and this motion does not determine them "
        "separately: move the joints both ways and at several speeds, give prior=(means, "
        "deviations) with finite ones for them, or omit the prior to estimate base parameters"
    )


def essential_parameters(estimate: Estimate, level: float = 0.05) -> np.ndarray:
    """Essential parameters, without which the model would be significantly worse.

    The parameter with the largest relative standard deviation is set to zero and the others are
    updated by their covariances, repeatedly, until an F-test of all zero parameters against the
    full estimate rejects at `level`:

        F = theta_d^T C_dd^-1 theta_d / d.

    For least squares with independent noise this is (RSS_reduced - RSS) / (d sigma^2), and the
    updates equal new estimates; it remains valid for correlated noise.

    Returns:
        Indices of the kept parameters, increasing.

    Source: Pham, Gautier 1991, essential parameters of robots, IEEE CDC.
    """
    from scipy.stats import f

    kept, dropped = list(range(len(estimate.values))), list[int]()
    values, covariance = estimate.values, estimate.covariance
    while len(kept) > 1:
        std = np.sqrt(np.diag(covariance))
        worst = int(np.argmax(std / np.maximum(np.abs(values), np.finfo(float).tiny)))
        trial = [*dropped, kept[worst]]
        theta = estimate.values[trial]
        F = theta @ np.linalg.solve(estimate.covariance[np.ix_(trial, trial)], theta) / len(trial)
        if f.sf(F, len(trial), estimate.degrees_of_freedom) < level:
            break
        gain = covariance[:, worst] / covariance[worst, worst]
        rest = np.arange(len(kept)) != worst
        values = (values - gain * values[worst])[rest]
        covariance = (covariance - np.outer(gain, covariance[worst]))[np.ix_(rest, rest)]
        dropped.append(kept.pop(worst))
    return np.array(kept)
