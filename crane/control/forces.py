"""Controllers of the forces of active joints."""

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import Number
from crane.codegen.scalar import subtract
from crane.common.errors import ClosureError, CraneWarning, InputError
from crane.common.samples import Array, as_number, as_sample
from crane.control.base import At, Law
from crane.description import PIGains
from crane.dynamics.hybrid import hybrid
from crane.machine import Machine
from crane.motion.curves import Trajectory
from crane.motion.trajectories import with_free


class PI(Law):
    """One PI controller per driven joint, equation (7) of the reduced-scale forwarder paper.

    tau = K_p e + K_i int e dt, e = q_ref(t) - q_A. Free joints get no force.

    Args:
        machine: The machine.
        reference: Reference of the driven joints, see `with_free`.
        gains: `PIGains` by driven joint, as {"X1": crane.PIGains(kp, ki)}; those of the machine
            file if not given.
        integral: (k,) int e dt of the driven joints at the start [m s], [rad s]. If not given, it
            carries the machine's weight, as it does when a machine under control stands still;
            with zeros the machine falls until the integrals have grown.

    Raises:
        InputError: No gains for a joint, or something else than `PIGains`.
    """

    def __init__(
        self,
        machine: Machine,
        reference: Trajectory,
        gains: Mapping[str, PIGains] | None = None,
        integral: ArrayLike | None = None,
    ):
        gains = machine.control if gains is None else gains
        if not isinstance(gains, Mapping):
            raise InputError(
                f"gains are a {type(gains).__name__}, give them by joint: {_form('JOINT')}"
            )
        driven = machine.driven_joints
        for joint in driven:
            if joint not in gains:
                raise InputError(
                    f"no PI gains for driven joint '{joint}' of '{machine.name}', give kp and ki "
                    f"under 'control' of the machine file, or in Python {_form(joint)}"
                )
            if not isinstance(gains[joint], PIGains):
                raise InputError(
                    f"gains of '{joint}' are a {type(gains[joint]).__name__}, give {_form(joint)}"
                )
        super().__init__(machine)
        self.reference: Trajectory = with_free(machine, reference)
        self._integral = (
            None if integral is None else as_sample(integral, len(driven), "integral", driven)
        )
        numbers = [[gains[joint].kp for joint in driven], [gains[joint].ki for joint in driven]]
        self.settings = np.array(numbers, dtype=np.float64).ravel()

    def begin(self, at: At) -> Sequence[Number]:
        """See `Law`."""
        if self._integral is not None:
            return list(self._integral)
        weight = np.array(self.of_driven(at.inverse([0.0] * len(at.q_a), friction=True)))
        kp, ki = np.array(self._gains(at))
        able = ki > 0
        held = np.where(able, weight - kp * np.array(self._error(at)), 0.0)
        return list(held / np.where(able, ki, 1.0))

    def references(self, times: Array) -> Array:
        """See `Law`."""
        return self.reference.position(times)[:, self.machine.driven]

    def law(self, at: At) -> tuple[Sequence[Number], Sequence[Number]]:
        """See `Law`; the states are the integrals of the errors."""
        error = self._error(at)
        kp, ki = self._gains(at)
        forces = [p * e + i * z for p, i, e, z in zip(kp, ki, error, at.state, strict=True)]
        return self.spread(forces), error

    def _error(self, at: At) -> list[Number]:
        return subtract(at.reference, self.of_driven(at.q_a))

    def _gains(self, at: At) -> tuple[list[Number], list[Number]]:
        k = len(at.reference)
        return at.settings[:k], at.settings[k : 2 * k]


class ComputedTorque(Law):
    """Inverse dynamics with a critically damped error: e'' + 2 w e' + w^2 e = 0.

    tau = inverse(q_A, v_A, a_ref + 2 w (v_ref - v_A) + w^2 (q_ref - q_A)) with friction.

    Free joints get no force and follow no reference: what drives the others so while these swing
    is `Dynamics.hybrid`. Where nothing is said to drive another joint (`Machine.undriven`), a
    warning names it and the force that it takes along the reference.

    Args:
        machine: The machine.
        reference: Reference of the driven joints, see `with_free`.
        bandwidth: w [rad/s].
    """

    def __init__(self, machine: Machine, reference: Trajectory, bandwidth: float = 20.0):
        super().__init__(machine)
        self.reference: Trajectory = with_free(machine, reference)
        self.settings = np.array([as_number(bandwidth, "the bandwidth", "rad/s", above=0)])
        if machine.undriven:
            warnings.warn(self._needed(machine), CraneWarning, stacklevel=2)

    def _needed(self, machine: Machine) -> str:
        """What to say of joints that are moved though nothing drives them."""
        reference = self.reference
        try:
            peaks = np.abs(
                self._dynamics.inverse(
                    *reference(np.linspace(0.0, reference.duration, 201)), friction=True
                )
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

    def references(self, times: Array) -> Array:
        """See `Law`."""
        return np.concatenate([x[:, self.machine.driven] for x in self.reference(times)], axis=1)

    def law(self, at: At) -> tuple[Sequence[Number], Sequence[Number]]:
        """See `Law`."""
        w, k = at.settings[0], int(self.machine.driven.sum())
        motion = (at.reference[i * k : (i + 1) * k] for i in range(3))
        wanted: list[Number] = [
            a_ref + 2.0 * w * (v_ref - v) + w * w * (q_ref - q)
            for q_ref, v_ref, a_ref, q, v in zip(
                *motion, self.of_driven(at.q_a), self.of_driven(at.v_a), strict=True
            )
        ]
        tau, _ = hybrid(at.inverse, self.machine.driven.tolist(), wanted, friction=True)
        return self.spread(tau), ()


def _form(joint: str) -> str:
    """How gains are given in Python."""
    return f"gains={{'{joint}': crane.PIGains(kp, ki)}}"
