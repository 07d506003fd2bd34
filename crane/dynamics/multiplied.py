"""A cluster of joints that gives way joint by joint, its loops by forces; see `recursion`."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from crane.closure.clusters import Cluster
from crane.closure.screws import NONE, Pair, Vector, by, carried, paired, plus, shifted
from crane.codegen.factors import Positive
from crane.codegen.scalar import Number, dot
from crane.dynamics.inertia import halved
from crane.dynamics.moving import Hung, Moving, hang


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
        self._forces = {i: [NONE] * len(self._rows) for i in (cluster.base, *cluster.joints)}
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
        moving, axis = self._moving, self._moving.posture.axes(i)
        parent, arm = moving.posture.geometry.parents[i], moving.posture.arms[i]
        inertia, wrench = moving.all_on(i, inside)
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
