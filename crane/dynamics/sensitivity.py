"""Exact derivatives of inverse and forward dynamics through closed loops, as formulas.

Coordinates q_j of the machine move every body b with a twist J_b,j = dV_b/dv_j. For any holonomic
mechanism, d_j J_k - d_k J_j = J_j x J_k, so what a coordinate does to twists and accelerations are
time derivatives of its own columns,

    d_j V = J_j' + J_j x V,    d_j A = J_j'' + J_j' x V + J_j x A,

and of the wrench f = I A + V x* I V = I A + B V of a body

    d f / d v_j = 2 I J_j' + 2 B J_j,
    d f / d q_j = J_j x* f + I J_j'' + 2 B J_j',
    2 B [u, t] = [2 t x p, 2 (tr(K) t - K t)],    p = sum m r',    K = sum m r' r^T,

with sums over the body's points r (Singh, Russell, Wensing 2022, equations (39) to (46), have the
same for open trees, with other signs and names). Columns hold gamma's derivatives
(`crane.closure.bending`). Joints of one cluster (`crane.closure.clusters`) move with its own
coordinates alone: sums over bodies are taken cluster by cluster, with what hangs on each body as
one inertia.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from crane.closure.bending import Bending, Motions, Rates
from crane.closure.screws import Pair, Vector, by, crossed_wrench, paired, plus
from crane.codegen.derivative import along
from crane.codegen.factors import Positive
from crane.codegen.scalar import (
    Expression,
    Number,
    add,
    cross,
    dot,
    dots,
    scale,
    subtract,
    times,
    transposed,
)  # fmt: skip
from crane.dynamics.inertia import Matrix
from crane.dynamics.traced import Sweep

_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True)
class Matter:
    """What moves as one body: sums over its points at r, which move with r'.

    Attributes:
        mass: sum m.
        first: sum m r (3,).
        tensor: sum m (r^2 - r r^T) (3, 3).
        momentum: sum m r' (3,).
        mixed: tr(K) - K (3, 3), K = sum m r' r^T.
    """

    mass: Number
    first: Vector
    tensor: Matrix
    momentum: Vector
    mixed: Matrix

    @classmethod
    def rigid(cls, mass: Number, centre: Vector, tensor: Matrix, motion: Pair) -> "Matter":
        """A rigid body.

        Args:
            mass: Its mass.
            centre: Its centre of mass.
            tensor: Inertia about it.
            motion: Its twist.
        """
        first = scale(mass, centre)
        square = dot(first, centre)
        inertia = _symmetric(
            lambda r, c: tensor[r][c] - first[r] * centre[c] + (square if r == c else 0.0)
        )
        v, w = motion
        momentum = scale(mass, add(v, cross(w, centre)))
        # second moments about the centre, tr(I) / 2 - I
        half = 0.5 * (tensor[0][0] + tensor[1][1] + tensor[2][2])
        spread = _symmetric(lambda r, c: (half if r == c else 0.0) - tensor[r][c])
        spun = transposed([cross(w, column) for column in spread])
        k = [
            [p * x + more for x, more in zip(centre, row, strict=True)]
            for p, row in zip(momentum, spun, strict=True)
        ]
        sums = [k[1][1] + k[2][2], k[0][0] + k[2][2], k[0][0] + k[1][1]]
        mixed = [[sums[r] if r == c else -k[r][c] for c in range(3)] for r in range(3)]
        return cls(mass, first, inertia, momentum, mixed)

    def __add__(self, other: "Matter") -> "Matter":
        return Matter(
            self.mass + other.mass,
            add(self.first, other.first),
            _symmetric(lambda r, c: self.tensor[r][c] + other.tensor[r][c]),
            add(self.momentum, other.momentum),
            [add(one, two) for one, two in zip(self.mixed, other.mixed, strict=True)],
        )

    def asked(self, acceleration: Pair) -> Pair:
        """I A."""
        a, e = acceleration
        force = add(scale(self.mass, a), cross(e, self.first))
        return force, add(cross(self.first, a), times(self.tensor, e))

    def turned(self, angular: Vector) -> Pair:
        """B of a motion, whose linear part does not matter."""
        return cross(angular, self.momentum), times(self.mixed, angular)

    def turning(self, motion: Pair) -> Vector:
        """What B^T of a motion has for the angular part of another."""
        v, w = motion
        return add(cross(self.momentum, v), times(transposed(self.mixed), w))


@dataclass(frozen=True)
class _Column:
    """What a coordinate does to inverse dynamics within its cluster and on what carries that.

    Attributes:
        by_q: Forces along the cluster's joints, by joint, per unit of the coordinate, but for
            what turns with the joints.
        by_v: Half of those per unit of its velocity.
        shifts: By joint, wrenches that turn with it.
        beyond_q: Wrench on the body that carries the cluster, per unit of the coordinate.
        beyond_v: Half of that per unit of its velocity.
        turned: B^T J_j of all bodies.
    """

    by_q: Rates
    by_v: Rates
    shifts: dict[int, Pair]
    beyond_q: Pair
    beyond_v: Pair
    turned: Vector


class Sensitivity:
    """Derivatives of inverse and forward dynamics at a posture and velocity.

    Of holonomic coordinates, without free-flyers, in the exact formulation.

    Args:
        sweep: The machine.
        bending: Derivatives of its gamma.
        friction: Whether friction brakes.
    """

    def __init__(self, sweep: Sweep, bending: Bending, friction: bool):
        self._sweep, self._bending, self._friction = sweep, bending, friction
        self._columns = sweep.posture.columns
        self._parents, self._n = sweep.posture.geometry.parents, len(sweep.v_a)
        self._home = {i: c for c, x in enumerate(bending.clusters) for i in x.joints}

    @cached_property
    def _velocity(self) -> list[Pair]:
        """Of every body."""
        return self._sweep.motions([0.0] * len(self._parents))[0]

    @cached_property
    def _matters(self) -> dict[int, Matter]:
        """Every body."""
        bodies = enumerate(self._sweep.bodies, start=1)
        return {i: Matter.rigid(*body, self._velocity[i]) for i, body in bodies}

    @cached_property
    def _lumped(self) -> dict[int, Matter]:
        """What every joint moves, but for what hangs on other joints of its cluster."""
        own, whole = dict(self._matters), dict(self._matters)
        for i in range(len(own), 0, -1):
            if parent := self._parents[i]:
                whole[parent] = whole[parent] + whole[i]
                if self._home[parent] != self._home[i]:
                    own[parent] = own[parent] + whole[i]
        return own

    def _gathered(self, c: int, wrenches: dict[int, Pair]) -> dict[int, Pair]:
        """Wrenches on the bodies of a cluster and all beyond them in it, and on its base."""
        out = dict(wrenches)
        for i in reversed(self._bending.clusters[c].joints):
            parent = self._parents[i]
            out[parent] = plus(out[parent], out[i]) if parent in out else out[i]
        return out

    @cached_property
    def _asked(self) -> dict[int, dict[int, Pair]]:
        """By coordinate, wrenches I J_j of its cluster's bodies and what is beyond."""
        return {
            j: self._gathered(
                c, {i: self._lumped[i].asked(self._bending.twists[j][i]) for i in cluster.joints}
            )
            for c, cluster in enumerate(self._bending.clusters)
            for j in self._bending.own[c]
        }

    @cached_property
    def mass(self) -> Matrix:
        """M_A (n, n) = d tau_A / d a_A."""
        out: Matrix = [[0.0] * self._n for _ in range(self._n)]
        gamma, rotors, twists = self._sweep.gamma, self._sweep.rotors, self._bending.twists
        for c, cluster in enumerate(self._bending.clusters):
            own = self._bending.own[c]
            for j in own:
                asked = self._asked[j]
                for k in [k for k in own if k <= j]:
                    total: Number = 0.0
                    for i in cluster.joints:
                        force = paired(self._columns[i], asked[i]) + rotors[i] * gamma[i][j]
                        total = total + gamma[i][k] * force
                    out[k][j] = out[j][k] = total
                for k, body in self._carriers(c):
                    out[k][j] = out[j][k] = paired(twists[k][body], asked[cluster.base])
        return out

    def _carriers(self, c: int) -> list[tuple[int, int]]:
        """The coordinates that carry a cluster, with the body of theirs that it hangs on."""
        out, body = [], self._bending.clusters[c].base
        while body:
            home = self._home[body]
            out += [(k, body) for k in self._bending.own[home]]
            body = self._bending.clusters[home].base
        return out

    def inverse(self, a_a: Sequence[Number]) -> tuple[Matrix, Matrix]:
        """Derivatives (n, n) of tau_A by q_A and v_A at an acceleration a_A (n,)."""
        sweep, bending, size = self._sweep, self._bending, len(self._parents)
        rates = [0.0, *(dot(sweep.gamma[i], a_a) + sweep.drift[i] for i in range(1, size))]
        second = bending.second(sweep.rates, rates)
        motions = tuple(dict(enumerate(x)) for x in sweep.motions(rates))
        whole, forces = self._whole(rates), sweep.forces(self._friction)
        # what the drives of all joints would have to do
        left = subtract(self._along(whole, rates), forces)
        by_q: Matrix = [[0.0] * self._n for _ in range(self._n)]
        by_v: Matrix = [[0.0] * self._n for _ in range(self._n)]
        moved: dict[int, tuple[Motions, Motions]] = {}
        for c, cluster in enumerate(bending.clusters):
            turning = bending.turning(cluster, *motions)
            for j in bending.own[c]:
                moved[j] = bending.columns(cluster, j, turning, second[j])
                found = self._column(c, j, moved[j], whole, second[j])
                self._add_own(c, j, found, left, by_q, by_v)
                self._add_carried(c, j, found, moved, by_q, by_v)
                slopes = self._slopes(c, j, forces)
                for k in range(self._n):
                    column = [sweep.gamma[i][k] for i in range(1, size)]
                    by_q[k][j] = by_q[k][j] - dot(column, slopes[0][1:])
                    by_v[k][j] = by_v[k][j] - dot(column, slopes[1][1:])
        return by_q, by_v

    def _whole(self, rates: Sequence[Number]) -> dict[int, Pair]:
        """By joint, the wrench that all that hangs on it takes to accelerate so."""
        _, accelerations = self._sweep.motions(rates)
        whole: dict[int, Pair] = {}
        for i in range(len(accelerations) - 1, 0, -1):
            matter = self._matters[i]
            wrench = plus(matter.asked(accelerations[i]), matter.turned(self._velocity[i][1]))
            whole[i] = plus(whole[i], wrench) if i in whole else wrench
            if parent := self._parents[i]:
                whole[parent] = plus(whole[parent], whole[i]) if parent in whole else whole[i]
        return whole

    def _along(self, whole: Mapping[int, Pair], rates: Sequence[Number]) -> Vector:
        """Forces along the joints (nb + 1,) that bodies and rotors take to accelerate so."""
        out: Vector = [0.0] * len(rates)
        for i, wrench in whole.items():
            out[i] = paired(self._columns[i], wrench) + self._sweep.rotors[i] * rates[i]
        return out

    def _column(
        self,
        c: int,
        j: int,
        moved: tuple[Motions, Motions],
        whole: Mapping[int, Pair],
        second: Mapping[int, Number],
    ) -> "_Column":
        """What one of a cluster's own coordinates does to the bodies of the cluster."""
        sweep, cluster, (rate, twice) = self._sweep, self._bending.clusters[c], moved
        by_q: dict[int, Pair] = {}
        by_v: dict[int, Pair] = {}
        shifts: dict[int, Pair] = {}
        turned: Vector = [0.0] * 3
        for i in cluster.joints:
            matter, twist = self._lumped[i], self._bending.twists[j][i]
            by_q[i] = plus(matter.asked(twice[i]), matter.turned(scale(2.0, rate[i][1])))
            by_v[i] = plus(matter.asked(rate[i]), matter.turned(twist[1]))
            shifts[i] = by(sweep.gamma[i][j], crossed_wrench(self._columns[i], whole[i]))
            turned = add(turned, matter.turning(twist))
        by_q, by_v = self._gathered(c, by_q), self._gathered(c, by_v)
        first = self._bending.first[j]
        return _Column(
            {
                i: paired(self._columns[i], by_q[i]) + sweep.rotors[i] * second[i]
                for i in cluster.joints
            },
            {
                i: paired(self._columns[i], by_v[i]) + sweep.rotors[i] * first[i]
                for i in cluster.joints
            },
            shifts,
            plus(by_q[cluster.base], *shifts.values()),
            by_v[cluster.base],
            turned,
        )

    def _add_own(
        self, c: int, j: int, found: "_Column", left: Vector, by_q: Matrix, by_v: Matrix
    ) -> None:
        """Rows of the coordinates of the same cluster, gamma's derivative among them."""
        gamma, bending = self._sweep.gamma, self._bending
        joints = bending.clusters[c].joints
        for k in bending.own[c]:
            row = [gamma[i][k] for i in joints]
            bent = bending.pairs.get((min(k, j), max(k, j)), {})
            by_q[k][j] = dot(row, [found.by_q[i] for i in joints])
            by_q[k][j] = by_q[k][j] + dot([left[i] for i in bent], list(bent.values()))
            for i in joints:
                by_q[k][j] = by_q[k][j] + paired(bending.twists[k][i], found.shifts[i])
            by_v[k][j] = 2.0 * dot(row, [found.by_v[i] for i in joints])

    def _add_carried(
        self,
        c: int,
        j: int,
        found: "_Column",
        moved: Mapping[int, tuple[Motions, Motions]],
        by_q: Matrix,
        by_v: Matrix,
    ) -> None:
        """Rows and columns of the coordinates that carry the cluster."""
        asked = self._asked[j][self._bending.clusters[c].base]
        for k, body in self._carriers(c):
            twist = self._bending.twists[k][body]
            rate, twice = (motions[body] for motions in moved[k])
            by_q[k][j] = by_q[k][j] + paired(twist, found.beyond_q)
            by_v[k][j] = by_v[k][j] + 2.0 * paired(twist, found.beyond_v)
            by_q[j][k] = by_q[j][k] + paired(twice, asked) + 2.0 * dot(found.turned, rate[1])
            back = paired(rate, asked) + dot(found.turned, twist[1])
            by_v[j][k] = by_v[j][k] + 2.0 * back

    def forward(self, tau: Sequence[Number]) -> tuple[Matrix, Matrix, Matrix]:
        """Derivatives (n, n) of a_A by q_A, v_A and tau_A.

        With M_A a_A + h = tau_A, d a_A = M_A^-1 (d tau_A - d inverse at a_A).
        """
        sweep = self._sweep
        mass = Positive(self.mass)
        right = add(tau, sweep.projected(sweep.forces(self._friction)))
        bias = sweep.projected(self._along(self._whole(sweep.drift), sweep.drift))
        by_q, by_v = self.inverse(mass.solve(subtract(right, bias)))
        inverse = mass.inverted
        back = [scale(-1.0, row) for row in inverse]
        columns = transposed([[*q, *v] for q, v in zip(by_q, by_v, strict=True)])
        rows = [dots(row, columns) for row in back]
        return [row[: self._n] for row in rows], [row[self._n :] for row in rows], inverse

    def _slopes(self, c: int, j: int, forces: Vector) -> tuple[Vector, Vector]:
        """What forces along the joints change by with q_j and with v_j (nb + 1,)."""
        sweep, joints = self._sweep, self._bending.clusters[c].joints
        at = {i: sweep.q[i - 1] for i in joints}
        rates = {i: rate for i in joints if isinstance(rate := sweep.rates[i], Expression)}
        by_q = {x.index: sweep.gamma[i][j] for i, x in at.items() if isinstance(x, Expression)}
        by_q |= {rate.index: self._bending.first[j][i] for i, rate in rates.items()}
        by_v = {rate.index: sweep.gamma[i][j] for i, rate in rates.items()}
        return along(forces, by_q), along(forces, by_v)


def _symmetric(entry: Callable[[int, int], Number]) -> Matrix:
    out: Matrix = [[0.0] * 3 for _ in range(3)]
    for r, c in _UPPER:
        out[r][c] = out[c][r] = entry(r, c)
    return out
