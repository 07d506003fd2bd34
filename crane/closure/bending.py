"""How gamma changes as a machine moves, as formulas.

A row w of the loop equations has w . (J_2,j - J_1,j) = 0 for the columns J_j = dV/dv_j of the two
bodies that it joins. Moved along q_k, and along the motion once and twice:

    (d_k w) . dJ_j + w . d_k dJ_j = 0,
    w'' . dJ_j + 2 w' . dJ_j' + w . dJ_j'' = 0,    dJ_j = J_2,j - J_1,j,

which are equations for d_k gamma_j and gamma_j'', each solved like gamma itself. Coordinates move
the joints of their own cluster alone (`crane.closure.clusters`), so motions count from the body
that carries it.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

from crane.closure.clusters import Cluster
from crane.closure.screws import NONE, Pair, Vector, by, crossed, minus, paired, plus
from crane.closure.traced import Bodies, Loops, Row
from crane.codegen.scalar import Number, add, cross, dot, scale

Motions = dict[int, Pair]  # by body
Rates = dict[int, Number]  # by joint


class Bending:
    """Derivatives of gamma at a traced closed posture, of holonomic coordinates.

    Args:
        posture: Bodies.
        loops: Loops at that posture.
        clusters: All of them, each behind the one that carries it.
        v_a: (n,).

    Attributes:
        own: Coordinates of each cluster.
        twists: By coordinate, columns J_j of the bodies of its cluster.
        pairs: d gamma_j / d q_k by (k, j), k <= j of one cluster, by joint.
        first: gamma_j' by coordinate, by joint.
    """

    def __init__(
        self,
        posture: Bodies,
        loops: Loops,
        clusters: Sequence[Cluster],
        v_a: Sequence[Number],
    ):
        self._posture, self._loops, self.clusters = posture, loops, clusters
        self._v_a, self._columns = v_a, posture.columns
        self.own = [cluster.own(loops.active_joints) for cluster in clusters]
        self.twists: dict[int, Motions] = {}
        self.pairs: dict[tuple[int, int], Rates] = {}
        self.first: dict[int, Rates] = {}
        for cluster, own in zip(clusters, self.own, strict=True):
            for j in own:
                gamma = {i: loops.gamma[i][j] for i in cluster.joints}
                self.twists[j] = self.summed(
                    cluster, {i: by(gamma[i], self._columns[i]) for i in cluster.joints}
                )
            tied = self._tied(cluster)
            for j in own if tied else ():
                for k in own:
                    if k <= j:
                        self.pairs[k, j] = self._along(cluster, tied, k, j)
            for j in own:
                bent = [(self.pairs[min(k, j), max(k, j)], v_a[k]) for k in own if tied]
                self.first[j] = {
                    i: dot([rates[i] for rates, _ in bent], [v for _, v in bent])
                    for i in cluster.joints
                }

    @cached_property
    def drift(self) -> Vector:
        """(nb + 1,) accelerations of the joints at a_A = 0: gamma' v_A."""
        out: Vector = [0.0] * len(self._columns)
        for j, rates in self.first.items():
            for i, rate in rates.items():
                out[i] = out[i] + rate * self._v_a[j]
        return out

    def second(self, rates: Sequence[Number], accelerations: Sequence[Number]) -> dict[int, Rates]:
        """gamma_j'' by coordinate, by joint.

        Args:
            rates: (nb + 1,) velocities of the joints.
            accelerations: (nb + 1,).
        """
        n, loops = len(self._v_a), self._loops
        sides: list[Vector] = [[0.0] * n for _ in loops.rows]
        for cluster, own in zip(self.clusters, self.own, strict=True):
            tied = self._tied(cluster)
            if not tied:
                continue
            velocity, acceleration = self._moved(cluster, rates, accelerations)
            turning = self.turning(cluster, velocity, acceleration)
            rows = {r: _twice(loops.rows[r], velocity, acceleration) for r in tied}
            for j in own:
                rate, known = self.columns(cluster, j, turning, dict.fromkeys(cluster.joints, 0.0))
                for r, (once, twice) in rows.items():
                    sides[r][j] = -1.0 * (
                        _across(twice, self.twists[j], loops.rows[r])
                        + 2.0 * _across(once, rate, loops.rows[r])
                        + _across(loops.rows[r].wrench, known, loops.rows[r])
                    )
        held: dict[int, Vector] = {joint: [0.0] * n for joint in loops.active_joints}
        solved, _ = loops.solve(held, sides)
        return {
            j: {i: solved[i][j] for i in cluster.joints}
            for cluster, own in zip(self.clusters, self.own, strict=True)
            for j in own
        }

    def _moved(
        self, cluster: Cluster, rates: Sequence[Number], accelerations: Sequence[Number]
    ) -> tuple[Motions, Motions]:
        """Velocities and accelerations of a cluster's bodies, from the one that carries it."""
        velocity: Motions = {cluster.base: NONE}
        acceleration: Motions = {cluster.base: NONE}
        for i in cluster.joints:
            parent, column = self._posture.geometry.parents[i], self._columns[i]
            velocity[i] = plus(velocity[parent], by(rates[i], column))
            turned = by(rates[i], crossed(velocity[i], column))
            acceleration[i] = plus(acceleration[parent], by(accelerations[i], column), turned)
        return velocity, acceleration

    def turning(
        self, cluster: Cluster, velocity: Mapping[int, Pair], acceleration: Mapping[int, Pair]
    ) -> dict[int, tuple[Pair, Pair]]:
        """Of a cluster's joints, whose bodies move so, s' and s'' of their columns s."""
        out = {}
        for i in cluster.joints:
            once = crossed(velocity[i], self._columns[i])
            twice = plus(crossed(acceleration[i], self._columns[i]), crossed(velocity[i], once))
            out[i] = once, twice
        return out

    def columns(
        self,
        cluster: Cluster,
        j: int,
        turning: Mapping[int, tuple[Pair, Pair]],
        second: Mapping[int, Number],
    ) -> tuple[Motions, Motions]:
        """J_j' and J_j'' of a cluster's bodies, from the one that carries it.

        Args:
            cluster: Which.
            j: One of its own coordinates.
            turning: s' and s'' by joint.
            second: gamma_j'' by joint.
        """
        once, twice = {}, {}
        for i in cluster.joints:
            gamma, first, (rate, rate_twice) = (
                self._loops.gamma[i][j],
                self.first[j][i],
                turning[i],
            )
            once[i] = plus(by(gamma, rate), by(first, self._columns[i]))
            twice[i] = plus(
                by(gamma, rate_twice), by(2.0 * first, rate), by(second[i], self._columns[i])
            )
        return self.summed(cluster, once), self.summed(cluster, twice)

    def summed(self, cluster: Cluster, parts: Mapping[int, Pair]) -> Motions:
        """Sums of motions that joints add, from the body that carries the cluster."""
        out: Motions = {cluster.base: NONE}
        for i in cluster.joints:
            out[i] = plus(out[self._posture.geometry.parents[i]], parts[i])
        return out

    def _tied(self, cluster: Cluster) -> list[int]:
        """Loop equations of a cluster."""
        return [
            r
            for r, row in enumerate(self._loops.rows)
            if any(joint in cluster.joints for joint in row.slopes)
        ]

    def _along(self, cluster: Cluster, tied: Sequence[int], k: int, j: int) -> Rates:
        """Derivative of gamma_j by q_k, by joint."""
        mover = self.twists[k]
        parts = {
            i: by(self._loops.gamma[i][j], crossed(mover[i], self._columns[i]))
            for i in cluster.joints
        }
        bent = self.summed(cluster, parts)
        sides: list[Vector] = [[0.0] for _ in self._loops.rows]
        for r in tied:
            row = self._loops.rows[r]
            one, two = row.bodies
            rate = row.rate(_of(mover, one), _of(mover, two))
            across = _across(row.wrench, bent, row) + _across(rate, self.twists[j], row)
            sides[r] = [-1.0 * across]
        held: dict[int, Vector] = {joint: [0.0] for joint in self._loops.active_joints}
        solved, _ = self._loops.solve(held, sides)
        return {i: solved[i][0] for i in cluster.joints}


def _twice(row: Row, velocity: Motions, acceleration: Motions) -> tuple[Pair, Pair]:
    """First and second time derivative of a row's wrench, w' and w''."""
    one, two = row.bodies
    first, second = _of(velocity, one), _of(velocity, two)
    (_, e1), (a2, e2) = _of(acceleration, one), _of(acceleration, two)
    axis_rate, arm_rate = row.rates(first, second)
    axis = add(cross(e1, row.axis), cross(first[1], axis_rate))
    arm = add(cross(e2, row.arm), cross(second[1], arm_rate))
    if row.moves:
        arm = add(arm, a2)
    if row.steady:
        axis = [0.0] * 3
    moment = add(
        cross(arm, row.axis), scale(2.0, cross(arm_rate, axis_rate)), cross(row.arm, axis)
    )
    return row.rate(first, second), (axis if row.moves else [0.0] * 3, moment)


def _across(wrench: Pair, motions: Motions, row: Row) -> Number:
    """What a wrench does between the two bodies of a row."""
    one, two = row.bodies
    return paired(wrench, minus(_of(motions, two), _of(motions, one)))


def _of(motions: Motions, body: int) -> Pair:
    """A body's motion; none of what no joint of the cluster moves."""
    return motions.get(body, NONE)
