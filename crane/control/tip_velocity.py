"""Velocity of the boom's tip, commanded through the valves."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_sample
from crane.control.valve_commands import SampledCommand, require_circuit
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.trajectory import Trajectory

_DEAD_BAND_SMOOTHING = 1e-3  # opening over which the dead band is jumped
_LIMIT_MARGIN = 1e-3  # of a stroke: a joint so close to its limit goes no further


class TipVelocity(SampledCommand):
    """The tip's velocity is asked for, the valves open as far as the flows need.

    Once per period, with J the reduced Jacobian of the tip and W the strokes squared, joints
    shared out by the least-norm solution

        v_A = W J^T (J W J^T)^+ x',    Q = A |v_A|,    y = Q / (c sqrt(dp)),

    dp the compensator's margin at the inlet or what the supply leaves of it, and at the outlet,
    where the load drives the cylinder and thereby sets its speed, the pressure that the load
    makes. The dead band is jumped. There is no feedback of the tip's position: the operator
    closes that loop. Joints at their limits are left out, and all slow down together where a
    valve is asked for more than it has.

    Args:
        machine: The machine, its tip given.
        velocity: (t) -> (3,) of the tip in the world [m/s], or a trajectory of the tip.
        period: [s].

    Raises:
        InputError: No tip, no valves, or a trajectory that was not given for the tip.
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
        """Active velocities (n,) for one of the tip (3,), as far as joints within limits give it.

        Args:
            q_a: (n,) [m], [rad].
            tip_velocity: (3,) [m/s].
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
            if v[i] > 0:
                inlet, inlet_area, outlet, outlet_area = (
                    valve.c1,
                    cylinder.area_a,
                    valve.c2,
                    cylinder.area_b,
                )
                inlet_pressure_drop = supply.pressure - a
            else:
                inlet, inlet_area, outlet, outlet_area = (
                    valve.c4,
                    cylinder.area_b,
                    valve.c3,
                    cylinder.area_a,
                )
                inlet_pressure_drop = supply.pressure - b
            drop = max(
                min(inlet_pressure_drop, valve.margin) if valve.margin else inlet_pressure_drop,
                1e5,
            )
            opening_size = inlet_area * abs(v[i]) / (inlet * np.sqrt(drop))
            if force * v[i] < 0:
                load = max(abs(force) / outlet_area, 1e5)
                opening_size = min(
                    opening_size, outlet_area * abs(v[i]) / (outlet * np.sqrt(load))
                )
            opening[i] = np.copysign(opening_size, v[i]) if v[i] else 0.0
        opening /= max(1.0, np.abs(opening).max())
        openings = dict(zip(self._circuit.joints, opening, strict=True))
        signals = []
        for spool in self._circuit.spools.values():
            y = openings[spool.joint]
            u = y * (1.0 - spool.dead_band) + spool.dead_band * np.tanh(y / _DEAD_BAND_SMOOTHING)
            signals.append(spool.neutral + (spool.full - spool.neutral) * u)
        return np.array(signals)
