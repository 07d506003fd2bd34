"""Priors of parameters: by name, or as means and standard deviations of all parameters."""

import fnmatch
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import qr

from crane.common.errors import InputError
from crane.common.errors import suggest_names as known_names
from crane.common.samples import Array, as_number, as_sample
from crane.description.specification import ParameterPrior
from crane.identification.estimation.regression_problem import Prior
from crane.identification.mechanics.base_parameters import BaseParameters
from crane.identification.mechanics.identification_model import IdentificationModel

_RANK_TOLERANCE = 1e-10  # relative size of a pivot of dependent columns
_MAX_LISTED = 8
_RELATIVE_STD_RANGE = 1e-7, 1e6  # range of a relative standard deviation


def read_priors(given: float | Mapping[str, object]) -> dict[str, ParameterPrior]:
    """Parse priors by name; a single relative standard deviation is that of all parameters.

    Raises:
        InputError: A prior is not valid.
    """
    if isinstance(given, Mapping):
        return {
            name: what if isinstance(what, ParameterPrior) else ParameterPrior.parse(what)
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
            reference_value = abs(mean[i]) or _described_friction(model, i)
            size = what.std * (reference_value if what.relative else 1.0)
            std[i] = size or (parameter_sizes[i] or 1.0)
        place = name.rpartition(".")[0]
        if not bodies and not others and not fnmatch.filter(model.machine.locked_joints, place):
            names = (*model.bodies, *model.names[count:])
            raise InputError(f"prior '{name}' is unknown, {known_names(names, name)}")
    return mean, std


def _described_friction(model: IdentificationModel, i: int) -> float:
    """Described friction of the same joint and kind as the offset of a parameter, else 0."""
    where, _, kind = model.names[i].rpartition(".")
    base_kind = kind.removesuffix("_offset")
    law = model.machine.friction.get(where)
    return float(getattr(law, base_kind, 0.0)) if base_kind != kind else 0.0


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
    square = triangle[:rank, :rank]
    rest = (
        np.linalg.solve(square, triangle[:rank, rank:])
        if rank
        else np.zeros((0, len(unknown_columns)))
    )
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
