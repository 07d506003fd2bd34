"""Forces along joints and distances: friction, springs, dampers, gas, end stops, ropes."""

from collections import Counter

import numpy as np

from crane.common.samples import Array
from crane.description import ForceElement, GasSpring, Rope
from crane.dynamics.lengths import Lengths, Pair
from crane.machine import Machine

_LAW = (
    "coulomb", "coulomb_offset", "viscous", "viscous_offset", "sharpness", "stiction", "stribeck",
    "stiffness", "damping", "constant", "slack",
    "stop", "stop_damping", "lower", "upper",
    "gas", "gas_share", "gas_rest", "gas_exponent",
)  # fmt: skip
_JUMP = 1e300  # sharpness of a sign that is not smoothed


class JointForces:
    """Friction and passive forces of a machine, as forces along the joints of its tree.

    A passive force acts along a coordinate: that of a joint, or the distance of two frames. The
    law is the same; what acts along a distance l acts on the joints with F dl/dv.

    The laws stand here in numpy and once more as formulas, `Sweep._law` of
    `crane.dynamics.traced`, on purpose: each is what checks the other.

    Args:
        machine: The machine whose `friction`, `forces`, `gas_springs`, `ropes` and `end_stops`
            act.

    Attributes:
        lengths: The distances that something acts along; m of them.
        table: (nv + m, 19) per joint, then per distance: Coulomb friction, its offset, viscous
            friction, its offset, one over the smoothing velocity, stiction, one over its velocity;
            stiffness, damping, constant force, energy of the spring at q = 0; stiffness and
            damping of the end stops, lower and upper limit; force of a gas spring at rest, its
            area over its volume there, where that is, exponent. A rope is an end stop.
    """

    def __init__(self, machine: Machine):
        rows, pairs = _rows(machine)
        self._joints, self.lengths = machine.model.nv, Lengths(machine, pairs)
        table = self.table = np.zeros((self._joints + len(pairs), len(_LAW)))
        table[:, _LAW.index("sharpness")] = 1.0
        for joint, friction in machine.friction.items():
            table[machine.column(joint), :7] = (
                friction.coulomb,
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
            table[i, 11:15] = stop.stiffness, stop.damping, lower[i], upper[i]
        table[:, 15:] = 0.0, 1.0, 0.0, 1.0
        for row, item in zip(rows, machine.elements, strict=True):
            match item:
                case ForceElement():
                    # springs of one joint add up: sum k (q - rest) = K q - sum k rest
                    table[row, 7:11] += (
                        item.stiffness,
                        item.damping,
                        item.force + item.stiffness * item.rest,
                        0.5 * item.stiffness * item.rest**2,
                    )
                case GasSpring():
                    table[row, 15:] = (
                        item.area * item.pressure,
                        item.area / item.volume,
                        item.rest,
                        item.exponent,
                    )
                case Rope():
                    table[row, 11:15] = item.stiffness, item.damping, 0.0, item.length
        (
            self._stiffness, self._damping, self._constant, self._slack,
            self._stop, self._stop_damping, self._lower, self._upper,
            self._gas, self._gas_share, self._gas_rest, self._gas_exponent,
        ) = np.ascontiguousarray(table[:, 7:].T)  # fmt: skip

    def friction(self, v: Array) -> Array:
        """Drive force that friction consumes at every joint.

        tau_F = (F_C + F_S e^-(v / v_S)^2) s + D_C + F_V v + D_V v s with s = tanh(v / smoothing):
        equation (5) of the reduced-scale forwarder paper with the sign that brakes, and stiction.

        Args:
            v: (nv,) [m/s], [rad/s].

        Returns:
            (nv,) [N], [N m].
        """
        law = self.table[: self._joints].T
        coulomb, coulomb_offset, viscous, viscous_offset, sharpness, stiction, stribeck = law[:7]
        sign = np.tanh(v * sharpness)
        sticking = stiction * np.exp(-((v * stribeck) ** 2))
        return (coulomb + sticking) * sign + coulomb_offset + (viscous + viscous_offset * sign) * v

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
        lengths, slopes = self.lengths.at(q)
        rates = np.einsum("...ki,...i->...k", slopes, v)
        q, v = np.concatenate([q, lengths], axis=-1), np.concatenate([v, rates], axis=-1)
        over, under = np.maximum(0.0, q - self._upper), np.maximum(0.0, self._lower - q)
        stopping = under * np.maximum(0.0, 1 - self._stop_damping * v) - over * np.maximum(
            0.0, 1 + self._stop_damping * v
        )
        springs = self._constant - self._stiffness * q - self._damping * v
        return self._on_joints(springs + self._stop * stopping + self._gas_law(q), slopes)

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
