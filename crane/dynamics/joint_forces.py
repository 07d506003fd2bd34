"""Forces along single joints: friction, springs, dampers, constant forces, end stops."""

import numpy as np

from crane.common.samples import Array
from crane.machine import Machine

_LAW = (
    "coulomb", "coulomb_offset", "viscous", "viscous_offset", "sharpness", "stiction", "stribeck",
    "stiffness", "damping", "constant", "slack",
    "stop", "stop_damping", "lower", "upper",
    "gas", "gas_share", "gas_rest", "gas_exponent",
)  # fmt: skip
_JUMP = 1e300  # sharpness of a sign that is not smoothed


class JointForces:
    """Friction and passive forces of all joints of a machine, in tree coordinates.

    The laws stand here in numpy and once more as formulas, `Sweep._law` of
    `crane.dynamics.traced`, on purpose: each is what checks the other.

    Args:
        machine: The machine whose `friction`, `forces`, `gas_springs` and `end_stops` act.

    Attributes:
        table: (nv, 19) per joint: Coulomb friction, its offset, viscous friction, its offset, one
            over the smoothing velocity, stiction, one over its velocity; stiffness, damping,
            constant force, energy of the spring at q = 0; stiffness and damping of the end stops,
            lower and upper limit; force of a gas spring at rest, its area over its volume there,
            where that is, exponent.
    """

    def __init__(self, machine: Machine):
        table = self.table = np.zeros((machine.model.nv, len(_LAW)))
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
        for element in machine.forces:
            # springs of one joint add up: sum k (q - rest) = K q - sum k rest
            table[machine.column(element.joint), 7:11] += (
                element.stiffness,
                element.damping,
                element.force + element.stiffness * element.rest,
                0.5 * element.stiffness * element.rest**2,
            )
        for stop in machine.end_stops:
            i = machine.column(stop.joint)
            lower, upper = machine.coordinates.lower, machine.coordinates.upper
            table[i, 11:15] = stop.stiffness, stop.damping, lower[i], upper[i]
        table[:, 15:] = 0.0, 1.0, 0.0, 1.0
        for gas in machine.gas_springs:
            table[machine.column(gas.joint), 15:] = (
                gas.area * gas.pressure,
                gas.area / gas.volume,
                gas.rest,
                gas.exponent,
            )
        (
            self._coulomb, self._coulomb_offset, self._viscous, self._viscous_offset,
            self._sharpness, self._stiction, self._stribeck,
            self._stiffness, self._damping, self._constant, self._slack,
            self._stop, self._stop_damping, self._lower, self._upper,
            self._gas, self._gas_share, self._gas_rest, self._gas_exponent,
        ) = np.ascontiguousarray(table.T)  # fmt: skip

    def friction(self, v: Array) -> Array:
        """Drive force that friction consumes at every joint.

        tau_F = (F_C + F_S e^-(v / v_S)^2) s + D_C + F_V v + D_V v s with s = tanh(v / smoothing):
        equation (5) of the reduced-scale forwarder paper with the sign that brakes, and stiction.

        Args:
            v: (nv,) [m/s], [rad/s].

        Returns:
            (nv,) [N], [N m].
        """
        sign = np.tanh(v * self._sharpness)
        sticking = self._stiction * np.exp(-((v * self._stribeck) ** 2))
        return (
            (self._coulomb + sticking) * sign
            + self._coulomb_offset
            + (self._viscous + self._viscous_offset * sign) * v
        )

    def passive(self, q: Array, v: Array) -> Array:
        """Force of springs, dampers, constant forces and end stops on every joint.

        f = force - stiffness (q - rest) - damping v, and at end stops, d beyond the limit,
        f = -+ stiffness d max(0, 1 + damping d') (Hunt and Crossley, 1975), and of gas springs
        f = area pressure (V0 / V)^exponent.

        Args:
            q: (nq,) or (N, nq) [m], [rad].
            v: (nv,) or (N, nv) [m/s], [rad/s].

        Returns:
            (nv,) or (N, nv) [N], [N m].
        """
        over, under = np.maximum(0.0, q - self._upper), np.maximum(0.0, self._lower - q)
        stopping = under * np.maximum(0.0, 1 - self._stop_damping * v) - over * np.maximum(
            0.0, 1 + self._stop_damping * v
        )
        springs = self._constant - self._stiffness * q - self._damping * v
        return springs + self._stop * stopping + self.gas(q)

    def gas(self, q: Array) -> Array:
        """Force of the gas springs on every joint.

        Args:
            q: (nq,) or (N, nq) [m], [rad].

        Returns:
            (nv,) or (N, nv) [N], [N m].
        """
        out = np.zeros_like(q)
        here = np.flatnonzero(self._gas)
        swollen = 1.0 + self._gas_share[here] * (q[..., here] - self._gas_rest[here])
        out[..., here] = self._gas[here] * swollen ** -self._gas_exponent[here]
        return out

    def potential(self, q: Array) -> float:
        """Energy stored in springs, constant forces, gas and end stops [J].

        Args:
            q: (nq,) [m], [rad].
        """
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
