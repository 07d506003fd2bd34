"""Which terms a model has: what the description asks for, and what is asked for by name.

A name is WHERE.KIND, WHERE a joint, several by a pattern (q*), or active joints that a motor turns
with together, each with its factor (q5+q6, q6+0.5*q5); KIND one of `KINDS`.
"""

import fnmatch
import math
from collections.abc import Mapping
from dataclasses import dataclass

from crane.common.errors import InputError, known
from crane.common.samples import as_number
from crane.description.estimation import Numbers
from crane.identification.mechanics.friction import Presliding, RestMemory, friction, root
from crane.identification.mechanics.inertias import Inertial, RotorInertia
from crane.identification.mechanics.passive import GasScale
from crane.identification.mechanics.term import Direction, Term
from crane.machine import Machine

Changes = Mapping[str, Numbers | None]
"""Numbers of a term by name, () where it has none; None leaves it out."""

_ACTIVE = ("coulomb", "coulomb_offset", "viscous", "viscous_offset")


@dataclass(frozen=True)
class Kind:
    """A kind of term.

    Attributes:
        numbers: What its numbers are, in words.
        count: How many there are at least and at most.
    """

    numbers: str = ""
    count: tuple[int, int] = (0, 0)


KINDS = {
    **{name: Kind() for name in (*_ACTIVE, "root", "rotor_inertia", "gas_scale")},
    "stiction": Kind("velocities over which it fades", (0, 9)),
    "presliding": Kind("the distance over which it winds up", (1, 1)),
    "memory": Kind("the time and the speed by which rest is forgotten", (2, 2)),
}


def default_terms(machine: Machine) -> list[Term]:
    """Bodies; four coefficients of friction per driven joint, viscous friction of all others."""
    return _built(machine, _default(machine))


def terms_of(machine: Machine, changes: Changes) -> list[Term]:
    """Terms of a model: the default ones, those of the machine's `estimation`, and changes.

    Args:
        machine: The machine.
        changes: As in a machine file under `identification`, `terms`: later ones win.

    Raises:
        InputError: A name that nothing has, or numbers that do not fit or are not above 0.
    """
    wanted, asked = _default(machine), set()
    for name, numbers in (*machine.estimation.terms.items(), *changes.items()):
        where, _, kind = name.rpartition(".")
        if kind not in KINDS:
            raise InputError(f"term '{name}': '{kind}' is unknown, {known(KINDS, kind)}")
        if not where:
            raise InputError(f"term '{name}' does not say of what, write q1.{kind} or q*.{kind}")
        low, high = KINDS[kind].count
        if numbers is not None and not low <= len(numbers) <= high:
            wants = f"give {KINDS[kind].numbers}" if high else "it takes none"
            raise InputError(f"term '{name}' has {len(numbers)} numbers, {wants}")
        for number in numbers or ():
            as_number(number, f"a number of term '{name}'", "", above=0)
        for place in _places(machine, where, kind):
            kinds = wanted.setdefault(place, {})
            if numbers is None:
                kinds.pop(kind, None)
                continue
            kinds[kind] = numbers
            asked.add((place, kind))
    for place, kinds in wanted.items():
        # Dahl's law is Coulomb friction that winds up first
        if "presliding" in kinds and (place, "coulomb") not in asked:
            kinds.pop("coulomb", None)
    return _built(machine, wanted)


def combined(name: str) -> Direction | None:
    """The direction of joints that a motor turns with together, None of a single name.

    Raises:
        InputError: A factor that is no number or 0, or a joint twice.
    """
    if "+" not in name:
        return None
    factors: dict[str, float] = {}
    for part in name.split("+"):
        factor, star, joint = (word.strip() for word in part.rpartition("*"))
        try:
            share = float(factor) if star else 1.0
        except ValueError:
            share = 0.0
        if not share or not math.isfinite(share):
            raise InputError(f"'{name}': '{factor}' is no factor, write q5+0.5*q6")
        if joint in factors:
            raise InputError(f"'{name}' names '{joint}' twice, give it once with its factor")
        factors[joint] = share
    return Direction(name, factors)


def _default(machine: Machine) -> dict[str, dict[str, Numbers]]:
    """Numbers of the default terms, by where and kind."""
    wanted: dict[str, dict[str, Numbers]] = {
        joint: dict.fromkeys(_ACTIVE, ()) for joint in machine.driven_joints
    }
    for joint in machine.joints:
        law = machine.friction.get(joint)
        rough = law is not None and law.coulomb > 0
        kinds = ("coulomb", "viscous") if rough else ("viscous",)
        wanted.setdefault(joint, dict.fromkeys(kinds, ()))
    return wanted


def _places(machine: Machine, where: str, kind: str) -> list[str]:
    """The joints, gas springs or combination that a name is about; none that is locked."""
    if kind == "gas_scale":
        names = [spring.joint for spring in machine.gas_springs]
    elif where not in machine.joints and (direction := combined(where)) is not None:
        return [] if direction.locked(machine) else [where]
    else:
        names = list(machine.joints)
    found = [where] if where in names else fnmatch.filter(names, where)
    if not found and not fnmatch.filter(machine.locks, where):
        raise InputError(f"term '{where}.{kind}': '{where}' is unknown, {known(names, where)}")
    return found


def _built(machine: Machine, wanted: Mapping[str, Mapping[str, Numbers]]) -> list[Term]:
    terms: list[Term] = [Inertial(machine)]
    for where, kinds in wanted.items():
        along = where if where in machine.joints else combined(where) or where
        if "gas_scale" in kinds:
            terms.append(GasScale(machine, where))
        if "rotor_inertia" in kinds:
            terms.append(RotorInertia(machine, along))
        plain = [kind for kind in _ACTIVE if kind in kinds]
        if plain or "stiction" in kinds:
            fading = kinds.get("stiction")
            if fading == ():
                fading = (_stribeck(machine, where),)
            terms.append(friction(machine, along, plain, stribeck=fading or ()))
        if "root" in kinds:
            terms.append(root(machine, along))
        if "presliding" in kinds:
            terms.append(Presliding(machine, along, *kinds["presliding"]))
        if "memory" in kinds:
            terms.append(RestMemory(machine, along, *kinds["memory"]))
    return terms


def _stribeck(machine: Machine, joint: str) -> float:
    """The velocity over which a joint's described stiction fades."""
    law = machine.friction.get(joint)
    if law is None or not law.stiction:
        raise InputError(
            f"term '{joint}.stiction' needs the velocity over which it fades, which the machine "
            "does not have: give it"
        )
    return law.stribeck
