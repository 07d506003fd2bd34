"""Velocity of the boom's tip, commanded through the valves."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError
from crane.common.samples import Array, as_sample
from crane.control.valves import Sampled, circuit_of
from crane.machine import Machine
from crane.motion.curves import Trajectory
from crane.motion.kinematics import Kinematics

_EASE = 1e-3  # opening over which the dead band is jumped
_NEAR = 1e-3  # of a stroke: a joint so close to its limit goes no further


class TipVelocity(Sampled):
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
        super().__init__(self._signals, machine, period)
        if isinstance(velocity, Trajectory):
            if velocity.tip is None:
                raise InputError("the trajectory is not one of the tip, give one in x, y, z")
            self.reference = velocity
            curve = velocity.tip
            self._velocity: Callable[[float], ArrayLike] = lambda time: curve(time)[1]
        else:
            self._velocity = velocity
        self._machine, self._tip = machine, Kinematics(machine)
        self._circuit = circuit_of(machine)
        self._which = [machine.active.index(joint) for joint in self._circuit.joints]
        self._span = machine.upper - machine.lower

    def velocities(self, q_a: Array, wanted: Array) -> Array:
        """Active velocities (n,) for one of the tip (3,), as far as joints within limits give it.

        Args:
            q_a: (n,) [m], [rad].
            wanted: (3,) [m/s].
        """
        jacobian = self._tip.jacobian(q_a)
        free = np.zeros(len(q_a), dtype=bool)
        free[self._which] = True
        lower, upper = self._machine.lower, self._machine.upper
        while True:
            weight = np.where(free, self._span, 0.0)
            v = weight * (np.linalg.pinv(jacobian * weight, rcond=1e-3) @ wanted)
            edge = _NEAR * self._span
            stuck = free & (((v < 0) & (q_a <= lower + edge)) | ((v > 0) & (q_a >= upper - edge)))
            if not stuck.any():
                return v
            free &= ~stuck

    def _signals(self, time: float, q_a: Array, v_a: Array, pressures: Array) -> Array:
        wanted = as_sample(self._velocity(time), 3, f"the tip's velocity at t = {time:g} s")
        v = self.velocities(q_a, wanted)[self._which]
        supply = self._circuit.supply
        opening = np.zeros(len(v))
        for i, joint in enumerate(self._circuit.joints):
            valve, cylinder = self._circuit.valves[joint], self._circuit.cylinders[joint]
            a, b = pressures[i]
            force = cylinder.area_a * a - cylinder.area_b * b
            if v[i] > 0:
                inlet, into, outlet, out = valve.c1, cylinder.area_a, valve.c2, cylinder.area_b
                before = supply.pressure - a
            else:
                inlet, into, outlet, out = valve.c4, cylinder.area_b, valve.c3, cylinder.area_a
                before = supply.pressure - b
            drop = max(min(before, valve.margin) if valve.margin else before, 1e5)
            size = into * abs(v[i]) / (inlet * np.sqrt(drop))
            if force * v[i] < 0:
                load = max(abs(force) / out, 1e5)
                size = min(size, out * abs(v[i]) / (outlet * np.sqrt(load)))
            opening[i] = np.copysign(size, v[i]) if v[i] else 0.0
        opening /= max(1.0, np.abs(opening).max())
        openings = dict(zip(self._circuit.joints, opening, strict=True))
        signals = []
        for spool in self._circuit.spools.values():
            y = openings[spool.joint]
            u = y * (1.0 - spool.dead_band) + spool.dead_band * np.tanh(y / _EASE)
            signals.append(spool.neutral + (spool.full - spool.neutral) * u)
        return np.array(signals)
