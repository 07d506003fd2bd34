"""tau = W beta: the drives' forces as linear functions of a machine's parameters."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_samples
from crane.dynamics.joint_forces import JointForces
from crane.identification.mechanics.inertias import Inertial, body_names
from crane.identification.mechanics.term import Samples, Term
from crane.identification.mechanics.terms import Changes, terms_of
from crane.machine import Machine


class Model:
    """The parameters of a machine and their linear effect on the drives' forces.

        tau_A = W(q_A, v_A, a_A) beta + known,

    known = gamma^T (I_r a - f) with the passive forces f and the rotor inertias I_r of the machine
    that no term scales.

    Args:
        machine: The machine.
        terms: Groups of columns; or what is to be estimated beside or instead of what its
            description asks for, by name, see `terms_of`.
        known: Samples -> (N, n), in the place of these forces.

    Attributes:
        names: (p,) of the parameters.
        nominal: (p,) values by the machine's description.
        signs: (p,) whether a parameter cannot be negative.
        bodies: Names of the bodies, whose inertial parameters are the first 10 nb columns, or ()
            where the model has none.

    Raises:
        InputError: Two parameters of the same name.
    """

    def __init__(
        self,
        machine: Machine,
        terms: Sequence[Term] | Changes | None = None,
        known: Callable[[Samples], Array] | None = None,
    ):
        self.machine = machine
        if terms is None or isinstance(terms, Mapping):
            terms = terms_of(machine, terms or {})
        self.terms = list(terms)
        self.terms.sort(key=lambda term: not isinstance(term, Inertial))
        self.names = tuple(name for term in self.terms for name in term.names)
        twice = {name for name in self.names if self.names.count(name) > 1}
        if twice:
            raise InputError(f"two terms have the parameter '{sorted(twice)[0]}', keep one")
        self.nominal = np.concatenate([term.nominal for term in self.terms])
        self.signs = tuple(sign for term in self.terms for sign in term.signs)
        has_bodies = isinstance(self.terms[0], Inertial)
        self.bodies = body_names(machine) if has_bodies else ()
        scaled = {
            name.removesuffix(".gas_scale") for name in self.names if name.endswith(".gas_scale")
        }
        rest = tuple(spring for spring in machine.gas_springs if spring.joint not in scaled)
        self._forces = JointForces(machine.replace(gas_springs=rest))
        estimated = [joint for joint in machine.joints if f"{joint}.rotor_inertia" in self.names]
        self._rotors = np.array(machine.model.armature)
        self._rotors[[machine.column(joint) for joint in estimated]] = 0.0
        self._given = known

    def samples(
        self,
        q_a: ArrayLike,
        v_a: ArrayLike,
        a_a: ArrayLike,
        step: float | None = None,
        starts: Sequence[int] = (0,),
    ) -> Samples:
        """Close the loops along a motion, (N, n) each; see `Samples`."""
        active = self.machine.active
        q_a, v_a, a_a = (
            np.atleast_2d(as_samples(x, len(active), name, active))
            for x, name in ((q_a, "q_a"), (v_a, "v_a"), (a_a, "a_a"))
        )
        closure = self.machine.closure
        q = closure.solve(q_a)
        return Samples(q_a, v_a, a_a, q, closure.gamma(q), step, starts)

    def regressor(self, at: Samples) -> Array:
        """W (N, n, p)."""
        return np.concatenate([term.columns(at) for term in self.terms], axis=2)

    def known(self, at: Samples) -> Array:
        """Forces (N, n) that no parameter changes: tau = W beta + known."""
        if self._given is not None:
            return self._given(at)
        v = np.einsum("kij,kj->ki", at.gamma, at.v_a)
        force = -self._forces.passive(at.q, v)
        if self._rotors.any():
            drift = self.machine.closure.drift(at.q, v)
            force += self._rotors * (np.einsum("kij,kj->ki", at.gamma, at.a_a) + drift)
        return np.einsum("kij,ki->kj", at.gamma, force)
