"""Parts of a model that is linear in its parameters, and what they are computed from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from crane.common.errors import InputError, suggest_names
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array
from crane.dynamics.frame_jacobians import FrameDistances
from crane.machine import Machine


@dataclass(frozen=True, eq=False, repr=False)
class MotionSamples(OneLineRepr):
    """A closed motion.

    Attributes:
        q_a: (N, n) active coordinates [m], [rad].
        v_a: (N, n).
        a_a: (N, n).
        q: (N, nq) all coordinates.
        gamma: (N, nv, n).
        step: From one to the next [s], None where they do not follow each other in time.
        starts: Indices where recordings begin: what depends on the past starts anew there.
        term_states: Of a part of a longer motion, what each term that depends on the past has kept
            of the part before, by term; it puts there (anew, not in place) what the next one
            needs.
    """

    q_a: Array
    v_a: Array
    a_a: Array
    q: Array
    gamma: Array
    step: float | None = None
    starts: Sequence[int] = (0,)
    term_states: dict[object, Any] = field(default_factory=dict)


class ModelTerm(Protocol):
    """Some columns of W.

    Attributes:
        names: (k,) of its parameters.
        nominal: (k,) their values by the machine's description.
        nonnegative: (k,) whether a parameter cannot be negative.
    """

    names: tuple[str, ...]
    nominal: Array
    nonnegative: tuple[bool, ...]

    def columns(self, samples: MotionSamples) -> Array:
        """(N, n, k)."""


@dataclass(frozen=True)
class ForceDirection:
    """Along what a force acts: a joint of the tree, active joints together, or a distance.

    Attributes:
        name: The joint's, or what to call the combination (a motor that turns with two joints) or
            the distance.
        factors: By active joint; None for the joint `name`.
        between: Two links whose distance it is.
    """

    name: str
    factors: Mapping[str, float] | None = None
    between: tuple[str, str] | None = None

    def has_locked_joint(self, machine: Machine) -> bool:
        """Whether it combines joints one of which is locked."""
        return any(joint in machine.locked_joints for joint in self.factors or ())

    def coordinate(self, machine: Machine, samples: MotionSamples) -> Array:
        """(N,) [m], [rad]."""
        if self.between is not None:
            return FrameDistances(machine, [self.between]).evaluate(samples.q)[0][:, 0]
        if self.factors is None:
            return samples.q[:, machine.column(self.name)]
        return np.einsum("ij,ij->i", self.jacobian(machine, samples), samples.q_a)

    def jacobian(self, machine: Machine, samples: MotionSamples) -> Array:
        """(N, n) derivative of the direction's coordinate by q_A."""
        if self.between is not None:
            length_derivatives = FrameDistances(machine, [self.between]).evaluate(samples.q)[1]
            return np.einsum("ki,kij->kj", length_derivatives[:, 0], samples.gamma)
        if self.factors is None:
            return samples.gamma[:, machine.column(self.name)]
        row = np.zeros(len(machine.active))
        for joint, factor in self.factors.items():
            if joint not in machine.active:
                raise InputError(
                    f"'{self.name}' combines '{joint}', which is not active, "
                    f"{suggest_names(machine.active, joint)}"
                )
            row[machine.active.index(joint)] = factor
        return np.broadcast_to(row, samples.v_a.shape)


def resolve_direction(machine: Machine, given: str | ForceDirection) -> ForceDirection:
    """The direction of a joint's name, or the one given; raises for what is not there."""
    direction = ForceDirection(given) if isinstance(given, str) else given
    if direction.between is not None:
        for link in direction.between:
            machine.frame(link)
    elif direction.factors is None:
        machine.column(direction.name)
    return direction
