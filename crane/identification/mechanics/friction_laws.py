"""Friction laws of a machine file for identified friction terms."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.description import Friction
from crane.identification.mechanics.force_terms import (
    FrictionalMemory,
    PreslidingFriction,
    VelocityFriction,
)
from crane.identification.mechanics.identification_model import IdentificationModel

FrictionTerm = VelocityFriction | PreslidingFriction | FrictionalMemory
SpeedRanges = Mapping[str, tuple[float, float]]

_FRICTION_PARAMETERS = tuple(item.name for item in fields(Friction))
_SPEED_COUNT = 100  # speeds of a comparison of laws, in each direction
_MAX_STRIBECK_SHARE = 0.3  # largest Stribeck velocity, relative to the largest speed
_STRIBECK_GRID_SIZE = 30  # Stribeck velocities of the search


@dataclass(frozen=True)
class FrictionLawFit:
    """Friction law that replaces identified friction terms.

    Attributes:
        law: The friction law.
        max_deviation: Largest difference at a steady speed [N], [N m]; 0 if the law is exact.
    """

    law: Friction
    max_deviation: float = 0.0


def friction_laws(
    model: IdentificationModel, parameters: Array, speed_ranges: SpeedRanges
) -> dict[str, FrictionLawFit]:
    """Friction law of each direction with friction terms in the model.

    Terms that a machine file does not contain (presliding, frictional memory, root of the speed,
    several Stribeck velocities) are replaced by the law that is nearest in least squares to the
    total friction at steady speeds in both directions.

    Args:
        model: The model.
        parameters: All parameters (p,).
        speed_ranges: Least and largest speed of the comparison by direction [m/s], [rad/s].

    Raises:
        InputError: Identified friction is negative.
    """
    values = dict(zip(model.names, parameters.tolist(), strict=True))
    terms_by_direction: dict[str, list[FrictionTerm]] = {}
    for term in model.terms:
        if isinstance(term, FrictionTerm):
            terms_by_direction.setdefault(term.direction.name, []).append(term)
    return {
        name: _exact_law(model, name, terms, values)
        or _nearest_law(name, terms, values, speed_ranges[name])
        for name, terms in terms_by_direction.items()
    }


def _exact_law(
    model: IdentificationModel, name: str, terms: list[FrictionTerm], values: Mapping[str, float]
) -> FrictionLawFit | None:
    found = {each.removeprefix(f"{name}."): values[each] for term in terms for each in term.names}
    if not found.keys() <= set(_FRICTION_PARAMETERS) or found.get("stiction", 0.0) < 0:
        return None
    # a joint without described friction is identified with an unsmoothed sign
    law = model.machine.friction.get(name, Friction(smoothing=0.0))
    stribeck_velocities = [
        v for term in terms if isinstance(term, VelocityFriction) for v in term.stribeck_velocities
    ]
    try:
        stribeck = stribeck_velocities[0] if stribeck_velocities else law.stribeck
        return FrictionLawFit(Friction(smoothing=law.smoothing, stribeck=stribeck, **found))
    except InputError as error:
        raise InputError(f"'{name}': {error}, give feasible=True") from None


def _nearest_law(
    name: str,
    terms: list[FrictionTerm],
    values: Mapping[str, float],
    speed_range: tuple[float, float],
) -> FrictionLawFit:
    from scipy.optimize import lsq_linear

    low, high = speed_range
    v = np.linspace(low, high, _SPEED_COUNT)
    v = np.concatenate([-v[::-1], v])
    identified_force = np.zeros_like(v)
    for term in terms:
        identified_force += term.steady_forces(v) @ [values[each] for each in term.names]
    sign, best, lowest_cost = np.sign(v), Friction(), np.inf
    first = min(max(low, high / 1e3), _MAX_STRIBECK_SHARE * high)
    for stribeck in np.geomspace(first, _MAX_STRIBECK_SHARE * high, _STRIBECK_GRID_SIZE).tolist():
        basis = np.column_stack(
            [sign, np.ones_like(v), v, np.abs(v), sign * np.exp(-((v / stribeck) ** 2))]
        )
        bounds = np.array([0.0, -np.inf, 0.0, -np.inf, 0.0]), np.full(5, np.inf)
        found = lsq_linear(basis, identified_force, bounds)
        if found.cost < lowest_cost:
            lowest_cost, max_deviation = (
                found.cost,
                float(np.abs(basis @ found.x - identified_force).max()),
            )
            coulomb, offset, viscous, viscous_offset, stiction = np.round(found.x, 12).tolist()
            stiction_parameters = {"stiction": stiction, "stribeck": stribeck} if stiction else {}
            best = Friction(coulomb, offset, viscous, viscous_offset, 0.0, **stiction_parameters)
    return FrictionLawFit(best, max_deviation)
