"""Identified friction as a machine file has it."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from crane.common.errors import InputError
from crane.common.samples import Array
from crane.description import Friction
from crane.identification.mechanics.friction import Along, Presliding, RestMemory
from crane.identification.mechanics.model import Model

Frictional = Along | Presliding | RestMemory
Speeds = Mapping[str, tuple[float, float]]

_KINDS = tuple(item.name for item in fields(Friction))
_POINTS = 100  # speeds at which laws are compared, each way
_FADED = 0.3  # of the largest speed, where stiction is gone
_VELOCITIES = 30  # that are tried for where stiction fades


@dataclass(frozen=True)
class Written:
    """A law of friction in the place of the identified one.

    Attributes:
        law: The law.
        off: By how much the two differ at most at a steady speed [N], [N m]; 0 where they are one.
    """

    law: Friction
    off: float = 0.0


def laws(model: Model, parameters: Array, speeds: Speeds) -> dict[str, Written]:
    """The law of each direction that the model has friction along.

    What is none of a machine file's kinds (friction that winds up, remembers rest, goes with the
    root of the speed, or fades over several velocities) is replaced by the law that is nearest, in
    least squares, to what all of it is at a steady speed, both ways.

    Args:
        model: The model.
        parameters: Of all (p,).
        speeds: Least and largest speed by direction [m/s], [rad/s], between which they are
            compared.

    Raises:
        InputError: Friction is negative.
    """
    values = dict(zip(model.names, parameters.tolist(), strict=True))
    along: dict[str, list[Frictional]] = {}
    for term in model.terms:
        if isinstance(term, Frictional):
            along.setdefault(term.direction.name, []).append(term)
    return {
        name: _exact(model, name, terms, values) or _nearest(name, terms, values, speeds[name])
        for name, terms in along.items()
    }


def _exact(
    model: Model, name: str, terms: list[Frictional], values: Mapping[str, float]
) -> Written | None:
    found = {each.removeprefix(f"{name}."): values[each] for term in terms for each in term.names}
    if not found.keys() <= set(_KINDS) or found.get("stiction", 0.0) < 0:
        return None
    # a joint without friction of its own is identified with a sign that jumps
    law = model.machine.friction.get(name, Friction(smoothing=0.0))
    fading = [v for term in terms if isinstance(term, Along) for v in term.stribeck]
    try:
        stribeck = fading[0] if fading else law.stribeck
        return Written(Friction(smoothing=law.smoothing, stribeck=stribeck, **found))
    except InputError as error:
        raise InputError(f"'{name}': {error}, give feasible=True") from None


def _nearest(
    name: str, terms: list[Frictional], values: Mapping[str, float], speeds: tuple[float, float]
) -> Written:
    from scipy.optimize import lsq_linear

    low, high = speeds
    v = np.linspace(low, high, _POINTS)
    v = np.concatenate([-v[::-1], v])
    wanted = np.zeros_like(v)
    for term in terms:
        wanted += term.steady(v) @ [values[each] for each in term.names]
    sign, best, least = np.sign(v), Friction(), np.inf
    first = min(max(low, high / 1e3), _FADED * high)
    for stribeck in np.geomspace(first, _FADED * high, _VELOCITIES).tolist():
        basis = np.column_stack(
            [sign, np.ones_like(v), v, np.abs(v), sign * np.exp(-((v / stribeck) ** 2))]
        )
        bounds = np.array([0.0, -np.inf, 0.0, -np.inf, 0.0]), np.full(5, np.inf)
        found = lsq_linear(basis, wanted, bounds)
        if found.cost < least:
            least, off = found.cost, float(np.abs(basis @ found.x - wanted).max())
            coulomb, offset, viscous, viscous_offset, stiction = np.round(found.x, 12).tolist()
            fades = {"stiction": stiction, "stribeck": stribeck} if stiction else {}
            best = Friction(coulomb, offset, viscous, viscous_offset, 0.0, **fades)
    return Written(best, off)
