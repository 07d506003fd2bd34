"""tau = W beta: the drives' forces as linear functions of a machine's parameters."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_samples
from crane.dynamics.joint_forces import JointForces
from crane.identification.mechanics.inertial_terms import InertialTerm, body_names
from crane.identification.mechanics.model_term import ModelTerm, MotionSamples
from crane.identification.mechanics.term_selection import TermChanges, select_terms
from crane.machine import Machine


class IdentificationModel:
    """The parameters of a machine and their linear effect on the drives' forces.

        tau_A = W(q_A, v_A, a_A) beta + known,

    known = gamma^T (I_r a - f) with the passive forces f and the rotor inertias I_r of the machine
    that no term scales.

    Args:
        machine: The machine.
        terms: Groups of columns; or what is to be estimated beside or instead of what its
            description asks for, by name, see `select_terms`.
        known_forces: Samples -> (N, n), in the place of these forces.

    Attributes:
        names: (p,) of the parameters.
        nominal: (p,) values by the machine's description.
        nonnegative: (p,) whether a parameter cannot be negative.
        bodies: Names of the bodies, whose inertial parameters are the first 10 nb columns, or ()
            where the model has none.

    Raises:
        InputError: Two parameters of the same name.
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
        repeated_names = {name for name in self.names if self.names.count(name) > 1}
        if repeated_names:
            raise InputError(
                f"two terms have the parameter '{sorted(repeated_names)[0]}', keep one"
            )
        self.nominal = np.concatenate([term.nominal for term in self.terms])
        self.nonnegative = tuple(sign for term in self.terms for sign in term.nonnegative)
        has_bodies = isinstance(self.terms[0], InertialTerm)
        self.bodies = body_names(machine) if has_bodies else ()
        estimated_springs = {
            name.removesuffix(".gas_scale") for name in self.names if name.endswith(".gas_scale")
        }
        fixed_springs = tuple(
            spring for spring in machine.gas_springs if spring.joint not in estimated_springs
        )
        self._joint_forces = JointForces(machine.replace(gas_springs=fixed_springs))
        estimated_rotors = [
            joint for joint in machine.joints if f"{joint}.rotor_inertia" in self.names
        ]
        self._rotor_inertias = np.array(machine.model.armature)
        self._rotor_inertias[[machine.column(joint) for joint in estimated_rotors]] = 0.0
        self._known_forces_function = known_forces

    def samples(
        self,
        q_a: ArrayLike,
        v_a: ArrayLike,
        a_a: ArrayLike,
        step: float | None = None,
        starts: Sequence[int] = (0,),
    ) -> MotionSamples:
        """Close the loops along a motion, (N, n) each; see `MotionSamples`."""
        active = self.machine.active
        q_a, v_a, a_a = (
            np.atleast_2d(as_samples(x, len(active), name, active))
            for x, name in ((q_a, "q_a"), (v_a, "v_a"), (a_a, "a_a"))
        )
        closure = self.machine.closure
        q = closure.solve(q_a)
        return MotionSamples(q_a, v_a, a_a, q, closure.gamma(q), step, starts)

    def regressor(self, samples: MotionSamples) -> Array:
        """W (N, n, p)."""
        return np.concatenate([term.columns(samples) for term in self.terms], axis=2)

    def known_forces(self, samples: MotionSamples) -> Array:
        """Forces (N, n) that no parameter changes: tau = W beta + known."""
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
