"""Forward dynamics by recursion over clusters of joints, as traced formulas.

At a reference acceleration of the joints, inverse dynamics tells what wrenches the bodies need;
what the joints accelerate more follows from the forces. From the outermost cluster inwards, what
hangs on a body answers what it accelerates more, A = [a, e], with the wrench

    F = I A + p

whose articulated inertia I and bias p take in that everything beyond gives way; from the world
outwards the accelerations follow. The number of operations grows with the number of bodies
(Featherstone 2008, section 7.3). A cluster that loops tie together gives way as a whole, in one of
two ways which say the same:

- `Projected`: by its independent coordinates, through gamma (Jain 2012; Chignoli et al. 2023).
  Exact whatever the masses are.
- `Multiplied`: joint by joint, with the forces of its loops as unknowns that are found where the
  cluster hangs. Takes as many operations as it has joints, but every joint must move a mass.

Accelerations are those of the point on the joint's axis that is the origin of its body, in
directions of the trunk.
"""

import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.closure.clusters import Cluster, clusters_of
from crane.closure.traced import Bodies, Loops, MovingBodies
from crane.codegen.factors import Positive
from crane.codegen.scalar import Number, add, dot, scale
from crane.dynamics.inertia import (
    Inertia,
    Pair,
    Vector,
    by,
    carried,
    halved,
    paired,
    plus,
    shifted,
)  # fmt: skip
from crane.machine import Machine

Hanging = tuple[Inertia, Pair]  # an inertia, and the wrench that it asks for at rest
_NONE: Pair = ([0.0] * 3, [0.0] * 3)
Plan = tuple[tuple[Cluster, bool], ...]
# independent coordinates of a machine up to which solving with M_A takes fewer operations, and of
# a cluster up to which `Projected` does
_FEW, _TIED = 5, 6
_LIGHT = 1e-6  # of a joint's inertia: what others do not move of it


def planned(machine: Machine) -> Plan:
    """How forward dynamics goes through a machine's clusters.

    Returns:
        The clusters, each behind the one that carries it, and whether by the forces of its loops
        (`Multiplied`); none where solving with M_A takes fewer operations.
    """
    if len(machine.active) <= _FEW:
        return ()
    active = {int(column) + 1 for column in machine.closure.active}
    light = _light(machine)

    def by_forces(cluster: Cluster) -> bool:
        if len(cluster.joints) == 1:
            return True
        return len(active & set(cluster.joints)) > _TIED and not light & set(cluster.joints)

    return tuple(
        (cluster, by_forces(cluster)) for cluster in clusters_of(machine.closure.equations)
    )


def _light(machine: Machine) -> set[int]:
    """Joints that move next to no mass of their own, once those beyond them give way.

    Recursion joint by joint divides by what is left of the inertia.
    """
    model = machine.model
    data = model.createData()
    mass = pin.crba(model, data, machine.coordinates.configuration(machine.home))
    pin.cholesky.decompose(model, data)
    return set((np.flatnonzero(~(_LIGHT * np.diag(mass) < data.D)) + 1).tolist())


@dataclass(frozen=True)
class Moving:
    """A machine in motion, whose joints accelerate with `reference` and something more.

    Attributes:
        posture: Its bodies.
        loops: Its loops.
        motion: Velocities, for the loops' second derivatives.
        reference: (nb + 1,) accelerations of the joints that `wrenches` belong to: what the loops
            ask for at a_A = 0 where clusters are projected, else 0.
        masses: Of every body mass, lever from its origin to the COM, inertia about the COM.
        wrenches: Of every body, about its COM, what it takes to accelerate it so, weight included.
        rotors: (nb + 1,) rotor inertias of the joints.
        forces: (nb + 1,) forces along the joints, those of the drives included.
    """

    posture: Bodies
    loops: Loops
    motion: MovingBodies
    reference: Vector
    masses: Sequence[tuple[Number, Vector, list[Vector]]]
    wrenches: Sequence[Pair]
    rotors: Vector
    forces: Vector

    def axis(self, i: int) -> Pair:
        """How the origin and the directions of a body move per unit of its joint's motion."""
        along = self.posture.axis(i)
        return (_NONE[0], along) if self.posture.geometry.revolute[i] else (along, _NONE[0])

    def force(self, i: int) -> Number:
        """What is left along a joint for more than the reference."""
        return self.forces[i] - self.rotors[i] * self.reference[i]

    def rigid(self, i: int, arm: Vector) -> Hanging:
        """Inertia and wrench of a body, referred to the point from which `arm` leads to it."""
        mass, lever, tensor = self.masses[i - 1]
        lever = add(arm, lever)
        return Inertia.rigid(mass, lever, tensor), carried(self.wrenches[i - 1], lever)

    def all_on(self, i: int, arm: Vector, hung: "Hung") -> Hanging:
        """A body and what hangs on it, referred to the point from which `arm` leads to it."""
        inertia, wrench = self.rigid(i, arm)
        if i not in hung:
            return inertia, wrench
        return inertia + hung[i][0].carried(arm), plus(wrench, carried(hung[i][1], arm))

    def moved(self, i: int, carrier: Pair, rate: Number) -> Pair:
        """What a body accelerates more, from what its parent does."""
        return plus(shifted(carrier, self.posture.arms[i]), by(rate, self.axis(i)))


Hung = dict[int, Hanging]  # what hangs on bodies, by their number, at their origin


def accelerations(moving: Moving, plan: Plan) -> Vector:
    """Accelerations (nb + 1,) of all joints.

    Args:
        moving: The machine.
        plan: See `planned`.
    """
    hung: Hung = {}
    answers: list[Projected | Multiplied] = []
    for cluster, by_forces in reversed(plan):
        answer = (Multiplied if by_forces else Projected)(moving, cluster, hung)
        answers.append(answer)
        hang(hung, cluster.base, answer.inertia, answer.bias)
    out = list(moving.reference)
    bodies = [_NONE] * len(out)
    for answer in reversed(answers):
        for i, rate in answer.rates(bodies):
            parent = moving.posture.geometry.parents[i]
            out[i], bodies[i] = out[i] + rate, moving.moved(i, bodies[parent], rate)
    return out


def hang(hung: Hung, body: int, inertia: Inertia, bias: Pair) -> None:
    """Let something hang on a body."""
    if body in hung:
        inertia, bias = hung[body][0] + inertia, plus(hung[body][1], bias)
    hung[body] = inertia, bias


class Projected:
    """A cluster that gives way by its independent coordinates.

    With W_b the motion of body b per unit of these,

        D = sum W_b^T I_b W_b,  U = sum I_b W_b,  u = tau - sum W_b^T p_b
        I = sum I_b - U D^-1 U^T,  p = sum p_b + U D^-1 u

    all referred to the origin of the body that the cluster hangs on.

    Args:
        moving: The machine.
        cluster: Which.
        hung: What hangs on its bodies.

    Attributes:
        inertia: I.
        bias: p.
    """

    def __init__(self, moving: Moving, cluster: Cluster, hung: Hung):
        self._moving, self._cluster = moving, cluster
        loops = moving.loops
        own = [k for k, joint in enumerate(loops.active_joints) if joint in cluster.joints]
        self._gamma = {i: [loops.gamma[i][k] for k in own] for i in cluster.joints}
        links = list(self._links(hung))
        answers = [[link.inertia.of(way) for way in link.ways] for link in links]
        columns = [plus(_NONE, *(answer[k] for answer in answers)) for k in range(len(own))]
        self._factors = Positive(
            [[self._mass(links, answers, k, j) for j in range(k + 1)] for k in range(len(own))]
        )
        pull = [self._pull(links, k) for k in range(len(own))]
        self._columns, self._pulls = columns, pull
        inertia = functools.reduce(Inertia.__add__, (link.inertia for link in links))
        self.inertia = inertia.less(halved(self._factors, columns), self._factors.inverse)
        given = [by(x, u) for x, u in zip(self._factors.solve(pull), columns, strict=True)]
        self.bias = plus(*(link.wrench for link in links), *given)

    def _links(self, hung: Hung) -> Iterator["_Link"]:
        """The bodies as seen from the cluster's base."""
        moving, base = self._moving, self._cluster.base
        still = [_NONE] * len(next(iter(self._gamma.values())))
        arms, ways = {base: _NONE[0]}, {base: still}
        for i, factors in self._gamma.items():
            parent = moving.posture.geometry.parents[i]
            arms[i] = add(arms[parent], moving.posture.arms[i])
            axis = shifted(moving.axis(i), scale(-1.0, arms[i]))
            ways[i] = [
                plus(way, by(x, axis)) for way, x in zip(ways[parent], factors, strict=True)
            ]
            yield _Link(ways[i], *moving.all_on(i, arms[i], hung))

    def _mass(
        self, links: "Sequence[_Link]", answers: Sequence[Sequence[Pair]], k: int, j: int
    ) -> Number:
        """An entry of D."""
        total: Number = 0.0
        for link, answer in zip(links, answers, strict=True):
            total = total + paired(answer[j], link.ways[k])
        for i, row in self._gamma.items():
            total = total + self._moving.rotors[i] * row[k] * row[j]
        return total

    def _pull(self, links: "Sequence[_Link]", k: int) -> Number:
        """An entry of u."""
        total: Number = 0.0
        for i, row in self._gamma.items():
            total = total + self._moving.force(i) * row[k]
        for link in links:
            total = total - paired(link.wrench, link.ways[k])
        return total

    def rates(self, bodies: Sequence[Pair]) -> Iterator[tuple[int, Number]]:
        """What the joints accelerate more, by joint, from what the body that carries them does.

        Args:
            bodies: What all bodies accelerate more than with the reference.
        """
        base = bodies[self._cluster.base]
        right = [
            pull - paired(column, base)
            for pull, column in zip(self._pulls, self._columns, strict=True)
        ]
        x = self._factors.solve(right)
        for i, row in self._gamma.items():
            yield i, dot(row, x)


@dataclass(frozen=True)
class _Link:
    """A body of a cluster, referred to the cluster's base; see `Projected`.

    Attributes:
        ways: W_b, by column.
        inertia: I_b.
        wrench: p_b.
    """

    ways: list[Pair]
    inertia: Inertia
    wrench: Pair


class Multiplied:
    """A cluster that gives way joint by joint, its loops by their forces.

    A joint with the axis s, and for the force of every loop equation a further right side, whose
    force along the joint is the equation's slope J:

        D = s^T I s,  U = I s,  u = tau - s^T p,  u_r = J_r - s^T P_r
        I' = I - U U^T / D,  p' = p + U u / D,  P_r' = P_r + U u_r / D

    At the base the equations J a = -b of all joints give the forces l:

        L l = -b - sum u_r u / D + P^T A,  L = sum u_r u_r^T / D
        I = I' + P L^-1 P^T,  p = p' + P L^-1 (-b - sum u_r u / D)

    Args:
        moving: The machine.
        cluster: Which.
        hung: What hangs on its bodies.

    Attributes:
        inertia: I.
        bias: p.
    """

    def __init__(self, moving: Moving, cluster: Cluster, hung: Hung):
        self._moving, self._cluster = moving, cluster
        joints = set(cluster.joints)
        self._rows = [row for row in moving.loops.rows if joints & row.slopes.keys()]
        self._steps: dict[int, _Step] = {}
        self._forces = {i: [_NONE] * len(self._rows) for i in (cluster.base, *cluster.joints)}
        inside = {i: hung[i] for i in cluster.joints if i in hung}
        for i in reversed(cluster.joints):
            self._give_way(i, inside)
        inertia, bias = inside[cluster.base]
        steps = self._steps.values()
        count = range(len(self._rows))
        self._factors = Positive(
            [
                [
                    _sum(step.sides[r] * step.sides[c] * step.inverse for step in steps)
                    for c in count
                ]
                for r in count
            ]
        )
        self._open = [
            -moving.motion.bend(row) - _sum(x.sides[r] * x.pull * x.inverse for x in steps)
            for r, row in enumerate(self._rows)
        ]
        columns = self._forces[cluster.base]
        stiff = [-1.0 * x for x in self._factors.inverse]
        self.inertia = inertia.less(halved(self._factors, columns), stiff)
        found = self._factors.solve(self._open)
        self.bias = plus(bias, *(by(x, p) for x, p in zip(found, columns, strict=True)))

    def _give_way(self, i: int, inside: Hung) -> None:
        """A joint, and what it hands to the body that carries it."""
        moving, axis = self._moving, self._moving.axis(i)
        parent, arm = moving.posture.geometry.parents[i], moving.posture.arms[i]
        inertia, wrench = moving.all_on(i, _NONE[0], inside)
        column = inertia.of(axis)
        inverse = 1.0 / (paired(axis, column) + moving.rotors[i])
        pull = moving.force(i) - paired(axis, wrench)
        sides = [
            row.slopes.get(i, 0.0) - paired(axis, force)
            for row, force in zip(self._rows, self._forces[i], strict=True)
        ]
        self._steps[i] = _Step(column, inverse, pull, sides)
        given = plus(wrench, by(pull * inverse, column))
        hang(inside, parent, inertia.less([column], [inverse]).carried(arm), carried(given, arm))
        self._forces[parent] = [
            plus(old, carried(plus(force, by(side * inverse, column)), arm))
            for old, force, side in zip(self._forces[parent], self._forces[i], sides, strict=True)
        ]

    def rates(self, bodies: Sequence[Pair]) -> Iterator[tuple[int, Number]]:
        """What the joints accelerate more, by joint, from what the body that carries them does.

        Args:
            bodies: What all bodies accelerate more than with the reference, those of the cluster
                as they become known.
        """
        base = bodies[self._cluster.base]
        columns = self._forces[self._cluster.base]
        right = [x + paired(p, base) for x, p in zip(self._open, columns, strict=True)]
        forces = self._factors.solve(right)
        for i in self._cluster.joints:
            step = self._steps[i]
            parent = bodies[self._moving.posture.geometry.parents[i]]
            pushed = step.pull + dot(step.sides, forces)
            carrier = shifted(parent, self._moving.posture.arms[i])
            yield i, (pushed - paired(step.column, carrier)) * step.inverse


@dataclass(frozen=True)
class _Step:
    """A joint of a cluster; see `Multiplied`.

    Attributes:
        column: U.
        inverse: 1 / D.
        pull: u.
        sides: u_r, by loop equation.
    """

    column: Pair
    inverse: Number
    pull: Number
    sides: Vector


def _sum(numbers: Iterable[Number]) -> Number:
    total: Number = 0.0
    for number in numbers:
        total = total + number
    return total
