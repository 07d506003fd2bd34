"""Forward dynamics by recursion over clusters of joints, as traced formulas.

From the outermost cluster inwards, what hangs on a body answers its acceleration A = [a, e] with
the wrench

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
directions of the trunk; weights are an acceleration of the world.
"""

import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from crane.closure.clusters import Cluster, clusters_of
from crane.closure.traced import Bodies, Loops, MovingBodies
from crane.codegen.factors import Positive
from crane.codegen.scalar import Number, add, cross, dot, scale, times
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
    """A machine in motion, before it is known how it accelerates.

    Attributes:
        posture: Its bodies.
        loops: Its loops.
        motion: Velocities, for the loops' second derivatives.
        rates: (nb + 1,) joint velocities.
        drift: (nb + 1,) accelerations of the joints at a_A = 0.
        gravity: (3,) in the trunk's directions.
        masses: Of every body mass, lever from its origin to the COM, inertia about the COM.
        rotors: (nb + 1,) rotor inertias of the joints.
        forces: (nb + 1,) forces along the joints, those of the drives included.
    """

    posture: Bodies
    loops: Loops
    motion: MovingBodies
    rates: Vector
    drift: Vector
    gravity: Vector
    masses: Sequence[tuple[Number, Vector, list[Vector]]]
    rotors: Vector
    forces: Vector

    @functools.cached_property
    def axes(self) -> list[Pair]:
        """The motion of each body's origin and directions per unit of its joint's."""
        revolute = self.posture.geometry.revolute
        axes = [_NONE[0], *(self.posture.axis(i) for i in range(1, len(revolute)))]
        return [
            (_NONE[0], axis) if turns else (axis, _NONE[0])
            for axis, turns in zip(axes, revolute, strict=True)
        ]

    @functools.cached_property
    def turning(self) -> list[Vector]:
        """Angular velocities."""
        return [angular for _, angular in self.motion.velocity]

    @functools.cached_property
    def bent(self) -> list[Pair]:
        """What each body accelerates beyond its parent while no joint does."""
        out = [_NONE]
        geometry = self.posture.geometry
        for i, parent in enumerate(geometry.parents[1:], start=1):
            if i in geometry.flying:
                out.append(_NONE if i in geometry.massless else (self._flown(i), _NONE[0]))
                continue
            spin, arm = self.turning[parent], self.posture.arms[i]
            linear, angular = by(self.rates[i], self.axes[i])
            bent = add(cross(spin, cross(spin, arm)), scale(2.0, cross(spin, linear)))
            out.append((bent, cross(spin, angular)))
        return out

    def _flown(self, i: int) -> Vector:
        """What the origin of a free-flyer accelerates while its twist in its axes stays."""
        parts = [scale(self.rates[j], self.axes[j][0]) for j in range(i - 5, i - 2)]
        return cross(self.turning[i], add(*parts))

    def rigid(self, i: int, arm: Vector) -> Hanging:
        """Inertia of a body, and the wrench that its turning asks for.

        Args:
            i: Which.
            arm: From the point that both refer to, to the body's origin.
        """
        mass, lever, tensor = self.masses[i - 1]
        spin, lever_there = self.turning[i], add(arm, lever)
        force = scale(mass, cross(spin, cross(spin, lever)))
        moment = add(cross(spin, times(tensor, spin)), cross(lever_there, force))
        return Inertia.rigid(mass, lever_there, tensor), (force, moment)

    def all_on(self, i: int, arm: Vector, hung: "Hung") -> Hanging:
        """A body and what hangs on it, referred to the point from which `arm` leads to it."""
        inertia, wrench = self.rigid(i, arm)
        if i not in hung:
            return inertia, wrench
        return inertia + hung[i][0].carried(arm), plus(wrench, carried(hung[i][1], arm))

    def moved(self, i: int, carrier: Pair, rate: Number) -> Pair:
        """Acceleration of a body whose joint accelerates, from that of its parent."""
        return plus(shifted(carrier, self.posture.arms[i]), self.bent[i], by(rate, self.axes[i]))


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
    bodies = [(scale(-1.0, moving.gravity), _NONE[0])] * len(moving.rates)
    out: Vector = [0.0] * len(moving.rates)
    for answer in reversed(answers):
        for i, rate in answer.rates(bodies):
            parent = moving.posture.geometry.parents[i]
            out[i], bodies[i] = rate, moving.moved(i, bodies[parent], rate)
    return out


def hang(hung: Hung, body: int, inertia: Inertia, bias: Pair) -> None:
    """Let something hang on a body."""
    if body in hung:
        inertia, bias = hung[body][0] + inertia, plus(hung[body][1], bias)
    hung[body] = inertia, bias


class Projected:
    """A cluster that gives way by its independent coordinates.

    With W_b the motion of body b per unit of these and c_b its acceleration without them,

        D = sum W_b^T I_b W_b,  U = sum I_b W_b,  u = tau - sum W_b^T (p_b + I_b c_b)
        I = sum I_b - U D^-1 U^T,  p = sum (p_b + I_b c_b) + U D^-1 u

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
        wrenches = [plus(link.wrench, link.inertia.of(link.bent)) for link in links]
        columns = [plus(_NONE, *(answer[k] for answer in answers)) for k in range(len(own))]
        self._factors = Positive(
            [[self._mass(links, answers, k, j) for j in range(k + 1)] for k in range(len(own))]
        )
        pull = [self._pull(links, wrenches, k) for k in range(len(own))]
        self._columns, self._pulls = columns, pull
        inertia = functools.reduce(Inertia.__add__, (link.inertia for link in links))
        self.inertia = inertia.less(halved(self._factors, columns), self._factors.inverse)
        given = [by(x, u) for x, u in zip(self._factors.solve(pull), columns, strict=True)]
        self.bias = plus(*wrenches, *given)

    def _links(self, hung: Hung) -> Iterator["_Link"]:
        """The bodies as seen from the cluster's base."""
        moving, base = self._moving, self._cluster.base
        still = [_NONE] * len(next(iter(self._gamma.values())))
        arms, ways, bent = {base: _NONE[0]}, {base: still}, {base: _NONE}
        for i, factors in self._gamma.items():
            parent = moving.posture.geometry.parents[i]
            arms[i] = add(arms[parent], moving.posture.arms[i])
            back = scale(-1.0, arms[i])
            axis = shifted(moving.axes[i], back)
            ways[i] = [
                plus(way, by(x, axis)) for way, x in zip(ways[parent], factors, strict=True)
            ]
            bent[i] = moving.moved(i, bent[parent], moving.drift[i])
            yield _Link(ways[i], shifted(bent[i], back), *moving.all_on(i, arms[i], hung))

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

    def _pull(self, links: "Sequence[_Link]", wrenches: Sequence[Pair], k: int) -> Number:
        """An entry of u."""
        moving = self._moving
        total: Number = 0.0
        for i, row in self._gamma.items():
            force = moving.forces[i] - moving.rotors[i] * moving.drift[i]
            total = total + force * row[k]
        for link, wrench in zip(links, wrenches, strict=True):
            total = total - paired(wrench, link.ways[k])
        return total

    def rates(self, bodies: Sequence[Pair]) -> Iterator[tuple[int, Number]]:
        """Accelerations of the joints, by joint, from that of the body that carries them.

        Args:
            bodies: Accelerations of all bodies.
        """
        base = bodies[self._cluster.base]
        right = [
            pull - paired(column, base)
            for pull, column in zip(self._pulls, self._columns, strict=True)
        ]
        x = self._factors.solve(right)
        for i, row in self._gamma.items():
            yield i, dot(row, x) + self._moving.drift[i]


@dataclass(frozen=True)
class _Link:
    """A body of a cluster, referred to the cluster's base; see `Projected`.

    Attributes:
        ways: W_b, by column.
        bent: c_b.
        inertia: I_b.
        wrench: p_b.
    """

    ways: list[Pair]
    bent: Pair
    inertia: Inertia
    wrench: Pair


class Multiplied:
    """A cluster that gives way joint by joint, its loops by their forces.

    A joint with the axis s, and for the force of every loop equation a further right side, whose
    force along the joint is the equation's slope J:

        D = s^T I s,  U = I s,  u = tau - s^T (p + I c),  u_r = J_r - s^T P_r
        I' = I - U U^T / D,  p' = p + I c + U u / D,  P_r' = P_r + U u_r / D

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
        moving, axis = self._moving, self._moving.axes[i]
        parent, arm = moving.posture.geometry.parents[i], moving.posture.arms[i]
        inertia, wrench = moving.all_on(i, _NONE[0], inside)
        column = inertia.of(axis)
        inverse = 1.0 / (paired(axis, column) + moving.rotors[i])
        wrench = plus(wrench, inertia.of(moving.bent[i]))
        pull = moving.forces[i] - paired(axis, wrench)
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
        """Accelerations of the joints, by joint, from that of the body that carries them.

        Args:
            bodies: Accelerations of all bodies, those of the cluster as they become known.
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
