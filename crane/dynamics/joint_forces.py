"""Forces along joints and distances: friction, springs, dampers, gas, end stops, ropes."""

from collections import Counter

import numpy as np

from crane.common.samples import Array
from crane.description import ForceElement, Friction, GasSpring, Rope
from crane.dynamics.lengths import Lengths, Pair
from crane.machine import Machine

_LAW = (
    "coulomb", "coulomb_offset", "viscous", "viscous_offset", "sharpness", "stiction", "stribeck",
    "slip", "held", "pace",
    "stiffness", "damping", "constant", "slack",
    "stop", "stop_damping", "lower", "upper",
    "gas", "gas_share", "gas_rest", "gas_exponent",
)  # fmt: skip
_MODES = slice(_LAW.index("slip"), _LAW.index("pace") + 1)
_SPRING = slice(_LAW.index("stiffness"), _LAW.index("slack") + 1)
_STOP = slice(_LAW.index("stop"), _LAW.index("upper") + 1)
_GAS = slice(_LAW.index("gas"), len(_LAW))
TRACE = 1e-6  # of a joint that sticks by what a circuit adds alone, for it never to be none
AT_REST = 5e-10  # velocity of a machine that is none
STILL = 1e-9  # acceleration of a joint that is none [rad/s^2], [m/s^2]
_JUMP = 1e300  # sharpness of a sign that is not smoothed


class JointForces:
    """Friction and passive forces of a machine, as forces along the joints of its tree.

    A passive force acts along a coordinate: that of a joint, or the distance of two frames. The
    law is the same; what acts along a distance l acts on the joints with F dl/dv.

    The laws stand here in numpy and once more as formulas, `effects` of
    `crane.dynamics.law`, on purpose: each is what checks the other.

    Args:
        machine: The machine whose `friction`, `forces`, `gas_springs`, `ropes` and `end_stops`
            act.

    Attributes:
        lengths: The distances that something acts along; m of them.
        sticking: Columns of the joints whose friction sticks.
        gripped: Columns of the joints whose Coulomb friction a circuit adds to.
        grip: (nv,) how much that is at present [N], [N m]; see `set_grip`.
        moving: 0 where friction holds the whole machine at rest, else 1; see `set_modes`.
        table: (nv + m, 22) per joint, then per distance: Coulomb friction, its offset, viscous
            friction, its offset, one over the smoothing velocity, stiction, one over its velocity,
            and where it sticks, the sign of the slip or the share of the limit that it has at
            rest, whether it is held, and one over a velocity of the machine (`set_modes`);
            stiffness, damping, constant force, energy of the spring at q = 0; stiffness and
            damping of the end stops, lower and upper limit; force of a gas spring at rest, its
            area over its volume there, where that is, exponent. A rope is an end stop.
    """

    def __init__(self, machine: Machine):
        rows, pairs = _rows(machine)
        self._joints, self.lengths = machine.model.nv, Lengths(machine, pairs)
        table = self.table = np.zeros((self._joints + len(pairs), len(_LAW)))
        self.sticking, self.moving = sticking(machine), 1.0
        self.gripped, self.grip = gripped(machine), np.zeros(self._joints)
        every = dict.fromkeys(machine.joints, Friction()) | dict(machine.friction)
        for joint, friction in every.items():
            column = machine.column(joint)
            alone = column in self.sticking and not friction.sticks
            table[column, :7] = (
                TRACE if alone else friction.coulomb,
                friction.coulomb_offset,
                friction.viscous,
                friction.viscous_offset,
                1.0 / friction.smoothing if friction.smoothing else _JUMP,
                friction.stiction,
                1.0 / friction.stribeck,
            )
        for stop in machine.end_stops:
            i = machine.column(stop.joint)
            lower, upper = machine.coordinates.lower, machine.coordinates.upper
            table[i, _STOP] = stop.stiffness, stop.damping, lower[i], upper[i]
        table[:, _GAS] = 0.0, 1.0, 0.0, 1.0
        for row, item in zip(rows, machine.elements, strict=True):
            match item:
                case ForceElement():
                    # springs of one joint add up: sum k (q - rest) = K q - sum k rest
                    table[row, _SPRING] += (
                        item.stiffness,
                        item.damping,
                        item.force + item.stiffness * item.rest,
                        0.5 * item.stiffness * item.rest**2,
                    )
                case GasSpring():
                    table[row, _GAS] = (
                        item.area * item.pressure,
                        item.area / item.volume,
                        item.rest,
                        item.exponent,
                    )
                case Rope():
                    table[row, _STOP] = item.stiffness, item.damping, 0.0, item.length
        (
            self._stiffness, self._damping, self._constant, self._slack,
            self._stop, self._stop_damping, self._lower, self._upper,
            self._gas, self._gas_share, self._gas_rest, self._gas_exponent,
        ) = np.ascontiguousarray(table[:, _SPRING.start :].T)  # fmt: skip

    @property
    def breakaway(self) -> Array:
        """(k,) how much friction of the joints that stick can differ from its offset at rest."""
        return self._own_breakaway + self.grip[list(self.sticking)]

    @property
    def _own_breakaway(self) -> Array:
        """The same without what a circuit adds."""
        law = self.table[list(self.sticking)]
        limits: Array = law[:, _LAW.index("coulomb")] + law[:, _LAW.index("stiction")]
        return limits

    def held(self, share: Array) -> Array:
        """(k,) friction at rest of the joints that stick, with shares (k,) of its limit."""
        offset: Array = self.table[list(self.sticking), _LAW.index("coulomb_offset")]
        return offset + share * self.breakaway

    @property
    def modes(self) -> tuple[Array, Array, Array]:
        """(k,) each, as `set_modes` has them."""
        slip, held, pace = self.table[list(self.sticking), _MODES].T
        return slip, held, pace

    def set_modes(self, slip: Array, held: Array, pace: Array, moving: bool) -> None:
        """Say what the joints do whose friction sticks.

        Args:
            slip: (k,) signs of their slips, or shares of the limit that those at rest have.
            held: (k,) 1 where a joint is kept at rest by what that takes, else 0.
            pace: (k,) one over velocities of the machine.
            moving: Whether anything moves.
        """
        self.moving = float(moving)
        self.table[list(self.sticking), _MODES] = np.column_stack([slip, held, pace])

    def set_grip(self, grip: Array) -> None:
        """Say what a circuit adds to the Coulomb friction of the joints `gripped` (g,)."""
        self.grip[list(self.gripped)] = grip

    def friction(self, v: Array, modes: bool = False) -> Array:
        """Drive force that friction consumes at every joint.

        tau_F = (F_C + F_S e^-(v / v_S)^2) s + D_C + F_V v + D_V v s with s = tanh(v / smoothing)
        or sign(v): equation (5) of the reduced-scale forwarder paper with the sign that brakes,
        and stiction.

        Args:
            v: (nv,) [m/s], [rad/s].
            modes: Whether s of the joints whose friction sticks is what `set_modes` says, and F_C
                has what a circuit adds.

        Returns:
            (nv,) [N], [N m].
        """
        law = self.table[: self._joints].T
        coulomb, coulomb_offset, viscous, viscous_offset, sharpness, stiction, stribeck = law[:7]
        sign = np.tanh(v * sharpness)
        if modes:
            here = list(self.sticking)
            sign[here] = self.table[here, _LAW.index("slip")]
            coulomb = coulomb + self.grip
        sticking = stiction * np.exp(-((v * stribeck) ** 2))
        return (coulomb + sticking) * sign + coulomb_offset + (viscous + viscous_offset * sign) * v

    def starting(self, v: Array, a: Array) -> Array:
        """Friction of joints at rest that sticks and is to give way, against their acceleration.

        Args:
            v: (nv,) or (N, nv) [m/s], [rad/s].
            a: (nv,) or (N, nv) [m/s^2], [rad/s^2].

        Returns:
            (nv,) or (N, nv) beside `friction`, (F_C + F_S) sign(a) where v = 0 [N], [N m].
        """
        here = list(self.sticking)
        out = np.zeros_like(v)
        starts = (v[..., here] == 0) & (np.abs(a[..., here]) > STILL)
        out[..., here] = np.where(starts, np.sign(a[..., here]) * self._own_breakaway, 0.0)
        return out

    def passive(self, q: Array, v: Array) -> Array:
        """Force of springs, dampers, constant forces, gas, end stops and ropes on every joint.

        f = force - stiffness (q - rest) - damping v, and at end stops, d beyond the limit,
        f = -+ stiffness d max(0, 1 + damping d') (Hunt and Crossley, 1975), and of gas springs
        f = area pressure (V0 / V)^exponent.

        Args:
            q: (nq,) or (N, nq) [m], [rad].
            v: (nv,) or (N, nv) [m/s], [rad/s].

        Returns:
            (nv,) or (N, nv) [N], [N m].
        """
        return self._on_joints(*self.along(q, v))

    def along(self, q: Array, v: Array) -> tuple[Array, Array]:
        """`passive` by what it acts along.

        Args:
            q: (nq,) or (N, nq) [m], [rad].
            v: (nv,) or (N, nv) [m/s], [rad/s].

        Returns:
            Forces along joints, then distances (nv + m,) or (N, nv + m) [N], [N m], and dl/dv of
            the distances.
        """
        lengths, slopes = self.lengths.at(q)
        rates = np.einsum("...ki,...i->...k", slopes, v)
        q, v = np.concatenate([q, lengths], axis=-1), np.concatenate([v, rates], axis=-1)
        over, under = np.maximum(0.0, q - self._upper), np.maximum(0.0, self._lower - q)
        stopping = under * np.maximum(0.0, 1 - self._stop_damping * v) - over * np.maximum(
            0.0, 1 + self._stop_damping * v
        )
        springs = self._constant - self._stiffness * q - self._damping * v
        return springs + self._stop * stopping + self._gas_law(q), slopes

    def gas(self, q: Array) -> Array:
        """Force of the gas springs on every joint.

        Args:
            q: (nq,) or (N, nq) [m], [rad].

        Returns:
            (nv,) or (N, nv) [N], [N m].
        """
        lengths, slopes = self.lengths.at(q)
        return self._on_joints(self._gas_law(np.concatenate([q, lengths], axis=-1)), slopes)

    def _on_joints(self, along: Array, slopes: Array) -> Array:
        """Forces along joints and distances (nv + m,) as forces along joints (nv,)."""
        joints = along[..., : self._joints]
        return joints + np.einsum("...ki,...k->...i", slopes, along[..., self._joints :])

    def _gas_law(self, q: Array) -> Array:
        """Of the gas along joints and distances (nv + m,)."""
        out = np.zeros_like(q)
        here = np.flatnonzero(self._gas)
        swollen = 1.0 + self._gas_share[here] * (q[..., here] - self._gas_rest[here])
        out[..., here] = self._gas[here] * swollen ** -self._gas_exponent[here]
        return out

    def potential(self, q: Array) -> float:
        """Energy stored in springs, constant forces, gas, end stops and ropes [J].

        Args:
            q: (nq,) [m], [rad].
        """
        q = np.concatenate([q, self.lengths.at(q)[0]])
        depth = np.maximum(0.0, np.maximum(q - self._upper, self._lower - q))
        here = np.flatnonzero(self._gas)
        swollen = 1.0 + self._gas_share[here] * (q[here] - self._gas_rest[here])
        less = 1.0 - self._gas_exponent[here]
        work = np.where(
            less == 0, np.log(swollen), (swollen**less - 1) / np.where(less == 0, 1.0, less)
        )
        return float(
            -(self._gas[here] / self._gas_share[here]) @ work
            + 0.5 * self._stiffness @ q**2
            - self._constant @ q
            + self._slack.sum()
            + 0.5 * self._stop @ depth**2
        )


def sticking(machine: Machine) -> tuple[int, ...]:
    """Columns of the joints whose friction sticks, in order.

    By their own law, or by what a circuit adds to it where that is not smoothed.
    """
    laws = machine.friction.items()
    found = {machine.column(joint) for joint, law in laws if law.sticks}
    smooth = {machine.column(joint) for joint, law in laws if law.smoothing}
    return tuple(sorted(found | set(gripped(machine)) - smooth))


def gripped(machine: Machine) -> tuple[int, ...]:
    """Columns of the joints `Hydraulics.gripped`, in their order."""
    joints = machine.hydraulics.gripped if machine.hydraulics is not None else ()
    return tuple(machine.column(joint) for joint in joints)


def _rows(machine: Machine) -> tuple[list[int], list[Pair]]:
    """The row of the table that each element is in, and the frames of the rows after the joints.

    Springs between the same frames share one, as those on one joint do, and so do a spring, a gas
    spring and a rope; of two gas springs or ropes each has its own.
    """
    found: dict[tuple[Pair, int], int] = {}
    alike: Counter[tuple[str, Pair]] = Counter()
    rows = []
    for item in machine.elements:
        if item.between is None:
            rows.append(machine.column(item.joint))
            continue
        number = alike[item.kind, item.between]
        if not isinstance(item, ForceElement):
            alike[item.kind, item.between] += 1
        rows.append(found.setdefault((item.between, number), machine.model.nv + len(found)))
    return rows, [pair for pair, _ in found]
