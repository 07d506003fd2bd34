"""Controllers of the forces of active joints."""

import warnings
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import Number
from crane.common.errors import ClosureError, CraneWarning, InputError
from crane.common.samples import Array, as_number, as_sample
from crane.control.base import Traced
from crane.description import PIGains
from crane.dynamics import Dynamics
from crane.machine import Machine
from crane.motion.trajectories import Path


class PI:
    """One PI controller per active joint, equation (7) of the reduced-scale forwarder paper.

    tau = K_p e + K_i int e dt, e = q_ref(t) - q_A.

    Args:
        machine: The machine.
        path: Reference of the active joints.
        gains: By active joint; those of the machine file if not given.
        integral: (n,) int e dt at the start [m s], [rad s]. If not given, it carries the
            machine's weight, as it does when a machine under control stands still; with zeros
            the machine falls until the integrals have grown.

    Raises:
        InputError: No gains for a joint.
    """

    def __init__(
        self,
        machine: Machine,
        path: Path,
        gains: Mapping[str, PIGains] | None = None,
        integral: ArrayLike | None = None,
    ):
        gains = machine.control if gains is None else gains
        for joint in machine.active:
            if joint not in gains:
                raise InputError(
                    f"no PI gains for active joint '{joint}' of '{machine.name}', give kp and ki "
                    "under 'control' of the machine file"
                )
        self.path: Path | None = path
        self._machine, self._reference = machine, path
        names = machine.active
        self._integral = (
            None if integral is None else as_sample(integral, len(names), "integral", names)
        )
        self._kp = np.array([gains[joint].kp for joint in machine.active])
        self._ki = np.array([gains[joint].ki for joint in machine.active])
        self.settings = np.concatenate([self._kp, self._ki])
        self.columns = len(machine.active)

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        if self._integral is not None:
            return self._integral
        rest = np.zeros_like(q_a)
        once = Dynamics(self._machine, path="pinocchio")
        weight = once.inverse(q_a, rest, rest, friction=True)
        error = self._reference(0.0)[0] - q_a
        able = self._ki > 0
        return np.where(able, weight - self._kp * error, 0.0) / np.where(able, self._ki, 1.0)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`; the states are the integrals of the errors."""
        error = self._reference.position(time) - q_a
        return self._kp * error + self._ki * state, error

    def references(self, times: Array) -> Array:
        """See `TracedController`."""
        return self._reference.position(times)

    def trace(self, at: Traced) -> tuple[list[Number], list[Number]]:
        """See `TracedController`."""
        n = self.columns
        columns = self._machine.closure.active
        error = [x - at.q[i] for x, i in zip(at.reference, columns, strict=True)]
        tau = [
            kp * e + ki * z
            for kp, ki, e, z in zip(at.settings[:n], at.settings[n:], error, at.state, strict=True)
        ]
        return tau, error


class ComputedTorque:
    """Inverse dynamics with a critically damped error: e'' + 2 w e' + w^2 e = 0.

    tau = inverse(q_A, v_A, a_ref + 2 w (v_ref - v_A) + w^2 (q_ref - q_A)) with friction.

    It moves all active joints. Where nothing is said to drive one (`Machine.undriven`), a warning
    names it and the force that it takes along the path.

    Args:
        machine: The machine.
        path: Reference of the active joints.
        bandwidth: w [rad/s].
    """

    def __init__(self, machine: Machine, path: Path, bandwidth: float = 20.0):
        bandwidth = as_number(bandwidth, "the bandwidth", "rad/s", above=0)
        self.path: Path | None = path
        self._reference, self._bandwidth = path, bandwidth
        self._dynamics = Dynamics(machine)
        self._active = machine.closure.active
        self.settings = np.array([float(bandwidth)])
        self.columns = 3 * len(machine.active)
        if machine.undriven:
            warnings.warn(self._needed(machine), CraneWarning, stacklevel=2)

    def _needed(self, machine: Machine) -> str:
        """What to say of joints that are moved though nothing drives them."""
        path = self._reference
        try:
            peaks = np.abs(
                self._dynamics.inverse(*path(np.linspace(0.0, path.duration, 201)), friction=True)
            ).max(axis=0)
        except ClosureError:  # the simulation will say where
            peaks = np.full(len(machine.active), np.nan)
        words = []
        for joint in machine.undriven:
            peak = peaks[machine.active.index(joint)]
            unit = "N" if machine.unit(joint) == "m" else "N m"
            words.append(f"'{joint}'" + (f" (up to {peak:.3g} {unit})" if peak == peak else ""))
        return (
            f"nothing is said to drive {', '.join(words)} of '{machine.name}', computed torque "
            "does so all the same: write an effort above 0 into the <limit> of what is driven, or "
            "describe its cylinder or gains, and lock what is not"
        )

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        return np.zeros(0)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        q_ref, v_ref, a_ref = self._reference(time)
        wanted = a_ref + 2 * self._bandwidth * (v_ref - v_a) + self._bandwidth**2 * (q_ref - q_a)
        return self._dynamics.inverse(q_a, v_a, wanted, friction=True), state

    def references(self, times: Array) -> Array:
        """See `TracedController`."""
        return np.concatenate(self._reference(times), axis=1)

    def trace(self, at: Traced) -> tuple[list[Number], list[Number]]:
        """See `TracedController`."""
        w, n, reference = at.settings[0], len(at.v_a), at.reference
        q_a = [at.q[i] for i in self._active]
        wanted = [
            a_ref + 2.0 * w * (v_ref - v) + w * w * (q_ref - x)
            for q_ref, v_ref, a_ref, x, v in zip(
                reference[:n], reference[n : 2 * n], reference[2 * n :], q_a, at.v_a, strict=True
            )
        ]
        return at.sweep.inverse(wanted, friction=True), at.state
