"""Identification model tau = W beta: drive forces as linear functions of parameters."""

import fnmatch
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, check_name, suggest_names
from crane.common.samples import Array, as_number, as_samples
from crane.description.estimation_settings import TermValues
from crane.dynamics.joint_forces import JointForces
from crane.identification.mechanics.model_terms import (
    ForceDirection,
    FrictionalMemory,
    GasSpringTerm,
    InertialTerm,
    ModelTerm,
    MotionSamples,
    PreslidingFriction,
    RotorInertiaTerm,
    body_names,
    friction_term,
    root_friction_term,
)
from crane.machine.machine import Machine

TermChanges = Mapping[str, TermValues | None]
"""Values of a term by name, () if it has none; None removes the term."""
_FRICTION_KINDS = ("coulomb", "coulomb_offset", "viscous", "viscous_offset")


class IdentificationModel:
    """Identification model: drive forces as linear functions of the parameters of a machine.

        tau_A = W(q_A, v_A, a_A) beta + known,

    with known = gamma^T (I_r a - f), the passive forces f and rotor inertias I_r of the machine
    that are not estimated by a term.

    Args:
        machine: The machine.
        terms: Terms of the model; or changes of the default terms by name, see `select_terms`.
        known_forces: Function samples -> (N, n) in place of these known forces.

    Attributes:
        names: (p,) names of the parameters.
        nominal: (p,) values by the description of the machine.
        nonnegative: (p,) whether a parameter must not be negative.
        bodies: Names of the bodies, whose inertial parameters are the first 10 nb columns; ()
            without bodies.

    Raises:
        InputError: Two parameters have the same name.
    """

    def __init__(
        self,
        machine: Machine,
        terms: Sequence[ModelTerm] | TermChanges | None = None,
        known_forces: Callable[[MotionSamples], Array] | None = None,
    ):
        self.machine = machine
        if terms is None or isinstance(terms, Mapping):
            terms = select_terms(machine, terms or {})
        self.terms = list(terms)
        self.terms.sort(key=lambda term: not isinstance(term, InertialTerm))
        self.names = tuple(name for term in self.terms for name in term.names)
        for name in sorted(self.names):
            if self.names.count(name) > 1:
                raise InputError(f"two terms have the parameter '{name}', keep one")
        self.nominal = np.concatenate([term.nominal for term in self.terms])
        self.nonnegative = tuple(sign for term in self.terms for sign in term.nonnegative)
        self.bodies = body_names(machine) if isinstance(self.terms[0], InertialTerm) else ()
        fixed_springs = tuple(
            x for x in machine.gas_springs if f"{x.joint}.gas_scale" not in self.names
        )
        self._joint_forces = JointForces(machine.replace(gas_springs=fixed_springs))
        self._rotor_inertias = np.array(machine.model.armature)
        for joint in machine.joints:
            if f"{joint}.rotor_inertia" in self.names:
                self._rotor_inertias[machine.column(joint)] = 0.0
        self._known_forces_function = known_forces

    def samples(
        self,
        q_a: ArrayLike,
        v_a: ArrayLike,
        a_a: ArrayLike,
        step: float | None = None,
        starts: Sequence[int] = (0,),
    ) -> MotionSamples:
        """Close the loops along a motion (N, n); see `MotionSamples`."""
        active = self.machine.active
        q_a, v_a, a_a = (
            np.atleast_2d(as_samples(x, len(active), name, active))
            for x, name in ((q_a, "q_a"), (v_a, "v_a"), (a_a, "a_a"))
        )
        closure = self.machine.closure
        q = closure.solve(q_a)
        return MotionSamples(q_a, v_a, a_a, q, closure.gamma(q), step, starts)

    def regressor(self, samples: MotionSamples) -> Array:
        """Regressor W (N, n, p)."""
        return np.concatenate([term.columns(samples) for term in self.terms], axis=2)

    def known_forces(self, samples: MotionSamples) -> Array:
        """Known forces (N, n), independent of the parameters: tau = W beta + known."""
        if self._known_forces_function is not None:
            return self._known_forces_function(samples)
        v = np.einsum("kij,kj->ki", samples.gamma, samples.v_a)
        force = -self._joint_forces.passive_forces(samples.q, v)
        if self._rotor_inertias.any():
            drift = self.machine.closure.drift(samples.q, v)
            force += self._rotor_inertias * (
                np.einsum("kij,kj->ki", samples.gamma, samples.a_a) + drift
            )
        return np.einsum("kij,ki->kj", samples.gamma, force)


TERM_KINDS = {
    **dict.fromkeys((*_FRICTION_KINDS, "root", "rotor_inertia", "gas_scale"), (0, 0, "")),
    "stiction": (0, 2, "the Stribeck velocities"),
    "presliding": (1, 1, "the characteristic distance"),
    "memory": (2, 2, "the time constant and the characteristic speed"),
}
"""Least and largest number of values of a kind of term, and what they are."""


def default_terms(machine: Machine) -> list[ModelTerm]:
    """Default terms: bodies, and friction of driven (four kinds) and other joints (viscous)."""
    return _build_terms(machine, _default_kinds(machine))


def select_terms(machine: Machine, changes: TermChanges) -> list[ModelTerm]:
    """Terms of a model: default terms, those of the machine's `estimation`, and changes.

    A name is WHERE.KIND. WHERE is a joint, a pattern of joints (q*), or active joints with factors
    that a motor turns together (q5+q6, q6+0.5*q5); KIND is one of `TERM_KINDS`.

    Args:
        machine: The machine.
        changes: Changes as in a machine file under `identification`, `terms`; later ones take
            precedence.

    Raises:
        InputError: A name is unknown, or values are not valid or not positive.
    """
    values_by_element, requested = _default_kinds(machine), set()
    for name, values in (*machine.estimation.terms.items(), *changes.items()):
        where, _, kind = name.rpartition(".")
        check_name(kind, TERM_KINDS, f"term '{name}': '{kind}' is unknown")
        if not where:
            raise InputError(f"term '{name}' does not say of what, write q1.{kind} or q*.{kind}")
        low, high, description = TERM_KINDS[kind]
        if values is not None and not low <= len(values) <= high:
            hint = f"give {description}" if high else "it takes none"
            raise InputError(f"term '{name}' has {len(values)} values, {hint}")
        for number in values or ():
            as_number(number, f"a value of term '{name}'", "", greater_than=0)
        for element in _matching_elements(machine, where, kind):
            kinds = values_by_element.setdefault(element, {})
            if values is None:
                kinds.pop(kind, None)
                continue
            kinds[kind] = values
            requested.add((element, kind))
    for element, kinds in values_by_element.items():
        # Dahl's law replaces Coulomb friction
        if "presliding" in kinds and (element, "coulomb") not in requested:
            kinds.pop("coulomb", None)
    return _build_terms(machine, values_by_element)


def parse_combination(name: str) -> ForceDirection | None:
    """Direction of joints that a motor turns together, None for a single name.

    Raises:
        InputError: A factor is no number or 0, or a joint is named twice.
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
    return ForceDirection(name, factors)


def _default_kinds(machine: Machine) -> dict[str, dict[str, TermValues]]:
    """Values of the default terms by element and kind."""
    values_by_element: dict[str, dict[str, TermValues]] = {
        joint: dict.fromkeys(_FRICTION_KINDS, ()) for joint in machine.driven_joints
    }
    for joint in machine.joints:
        law = machine.friction.get(joint)
        kinds = ("coulomb", "viscous") if law is not None and law.coulomb > 0 else ("viscous",)
        values_by_element.setdefault(joint, dict.fromkeys(kinds, ()))
    return values_by_element


def _matching_elements(machine: Machine, where: str, kind: str) -> list[str]:
    """Joints, gas springs or combination that a name refers to, without locked ones."""
    if kind == "gas_scale":
        names = [spring.joint for spring in machine.gas_springs]
    elif where not in machine.joints and (direction := parse_combination(where)) is not None:
        is_locked = not machine.locked_joints.keys().isdisjoint(direction.factors or ())
        return [] if is_locked else [where]
    else:
        names = list(machine.joints)
    found = [where] if where in names else fnmatch.filter(names, where)
    if not found and not fnmatch.filter(machine.locked_joints, where):
        raise InputError(
            f"term '{where}.{kind}': '{where}' is unknown, {suggest_names(names, where)}"
        )
    return found


def _build_terms(
    machine: Machine, values_by_element: Mapping[str, Mapping[str, TermValues]]
) -> list[ModelTerm]:
    terms: list[ModelTerm] = [InertialTerm(machine)]
    for where, kinds in values_by_element.items():
        direction = where if where in machine.joints else parse_combination(where) or where
        if "gas_scale" in kinds:
            terms.append(GasSpringTerm(machine, where))
        if "rotor_inertia" in kinds:
            terms.append(RotorInertiaTerm(machine, direction))
        friction_kinds = [kind for kind in _FRICTION_KINDS if kind in kinds]
        if friction_kinds or "stiction" in kinds:
            stribeck = kinds.get("stiction", ())
            if "stiction" in kinds and not stribeck:
                law = machine.friction.get(where)
                if law is None or not law.stiction:
                    raise InputError(
                        f"term '{where}.stiction' needs the velocity over which it fades, which "
                        "the machine does not have: give it"
                    )
                stribeck = (law.stribeck,)
            terms.append(friction_term(machine, direction, friction_kinds, stribeck=stribeck))
        if "root" in kinds:
            terms.append(root_friction_term(machine, direction))
        if "presliding" in kinds:
            terms.append(PreslidingFriction(machine, direction, *kinds["presliding"]))
        if "memory" in kinds:
            terms.append(FrictionalMemory(machine, direction, *kinds["memory"]))
    return terms
