"""Valve signals that command the velocity of the tip."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_sample
from crane.control.valve_commands import SampledCommand, require_circuit
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.trajectory import Trajectory

_DEAD_BAND_SMOOTHING = 1e-3  # opening over which the signal crosses the dead band
_LIMIT_MARGIN = 1e-3  # share of the stroke within which a joint is at its limit
_MIN_PRESSURE_DROP = 1e5  # least pressure drop that an edge is assumed to have [Pa]


class TipVelocity(SampledCommand):
    """Valve command that opens the valves for a velocity of the tip.

    Once per period, with J the reduced Jacobian of the tip and W the squares of the strokes, the
    joint velocities are the least-norm solution

        v_A = W J^T (J W J^T)^+ x',    Q = A |v_A|,    y = Q / (c sqrt(dp)).

    At the inlet, dp is the margin of the compensator, or what the supply leaves of it. At the
    outlet, which sets the speed where the load drives the cylinder, it is the pressure of the
    load. The signals jump over the dead band. The position of the tip is not fed back: the
    operator closes that loop. Joints at their limits are not used, and all velocities are reduced
    where a valve would have to open more than fully.

    Args:
        machine: A machine with a tip.
        velocity: (t) -> (3,) velocity of the tip in the world [m/s], or a trajectory of the tip.
        period: Sampling period [s].

    Raises:
        InputError: No tip, no valves, or a trajectory of joints.
    """

    def __init__(
        self,
        machine: Machine,
        velocity: Callable[[float], ArrayLike] | Trajectory,
        period: float = 0.01,
    ):
        super().__init__(self._valve_signals, machine, period)
        if isinstance(velocity, Trajectory):
            if velocity.tip is None:
                raise InputError("the trajectory is not one of the tip, give one in x, y, z")
            self.reference = velocity
            curve = velocity.tip
            self._tip_velocity: Callable[[float], ArrayLike] = lambda time: curve(time)[1]
        else:
            self._tip_velocity = velocity
        self._machine, self._kinematics = machine, Kinematics(machine)
        self._circuit = require_circuit(machine)
        self._active_indices = [machine.active.index(joint) for joint in self._circuit.joints]
        self._joint_ranges = machine.upper - machine.lower

    def joint_velocities(self, q_a: Array, tip_velocity: Array) -> Array:
        """Active velocities (n,) for a velocity of the tip, by the joints within their limits.

        Args:
            q_a: (n,) active coordinates [m], [rad].
            tip_velocity: (3,) velocity of the tip [m/s].
        """
        jacobian = self._kinematics.jacobian(q_a)
        is_usable = np.zeros(len(q_a), dtype=bool)
        is_usable[self._active_indices] = True
        lower, upper = self._machine.lower, self._machine.upper
        while True:
            weight = np.where(is_usable, self._joint_ranges, 0.0)
            v = weight * (np.linalg.pinv(jacobian * weight, rcond=1e-3) @ tip_velocity)
            margin = _LIMIT_MARGIN * self._joint_ranges
            is_at_limit = is_usable & (
                ((v < 0) & (q_a <= lower + margin)) | ((v > 0) & (q_a >= upper - margin))
            )
            if not is_at_limit.any():
                return v
            is_usable &= ~is_at_limit

    def _valve_signals(self, time: float, q_a: Array, v_a: Array, pressures: Array) -> Array:
        tip_velocity = as_sample(
            self._tip_velocity(time), 3, f"the tip's velocity at t = {time:g} s"
        )
        v = self.joint_velocities(q_a, tip_velocity)[self._active_indices]
        supply = self._circuit.supply
        opening = np.zeros(len(v))
        for i, joint in enumerate(self._circuit.joints):
            valve, cylinder = self._circuit.valves[joint], self._circuit.cylinders[joint]
            a, b = pressures[i]
            force = cylinder.area_a * a - cylinder.area_b * b
            areas, pressure = (cylinder.area_a, cylinder.area_b), a
            inlet, outlet = valve.c1, valve.c2
            if v[i] <= 0:
                areas, pressure, inlet, outlet = areas[::-1], b, valve.c4, valve.c3
            drop = min(supply.pressure - pressure, valve.margin or np.inf)
            size = areas[0] * abs(v[i]) / (inlet * np.sqrt(max(drop, _MIN_PRESSURE_DROP)))
            if force * v[i] < 0:
                size = min(
                    size,
                    areas[1]
                    * abs(v[i])
                    / (outlet * np.sqrt(max(abs(force) / areas[1], _MIN_PRESSURE_DROP))),
                )
            opening[i] = np.copysign(size, v[i]) if v[i] else 0.0
        opening /= max(1.0, np.abs(opening).max())
        openings = dict(zip(self._circuit.joints, opening, strict=True))
        signals = []
        for spool in self._circuit.spools.values():
            y = openings[spool.joint]
            u = y * (1.0 - spool.dead_band) + spool.dead_band * np.tanh(y / _DEAD_BAND_SMOOTHING)
            signals.append(spool.neutral + (spool.full - spool.neutral) * u)
        return np.array(signals)
