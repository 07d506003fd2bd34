"""Controllers of the forces of active joints."""

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import Scalar
from crane.codegen.symbolic import subtract_vectors
from crane.common.errors import ClosureError, CraneWarning, InputError
from crane.common.samples import Array, as_number, as_sample
from crane.control.control_law import ControlLaw, ControllerInputs
from crane.description import PIGains
from crane.dynamics.hybrid_dynamics import hybrid_dynamics
from crane.machine import Machine
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory


class PI(ControlLaw):
    """One PI controller per driven joint, equation (7) of the reduced-scale forwarder paper.

    tau = K_p e + K_i int e dt, e = q_ref(t) - q_A. Free joints get no force.

    Args:
        machine: The machine.
        reference: Reference of the driven joints, see `add_free_joints`.
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
                f"gains are a {type(gains).__name__}, give them by joint: "
                f"{_gains_example('JOINT')}"
            )
        driven = machine.driven_joints
        for joint in driven:
            if joint not in gains:
                raise InputError(
                    f"no PI gains for driven joint '{joint}' of '{machine.name}', give kp and ki "
                    f"under 'control' of the machine file, or in Python {_gains_example(joint)}"
                )
            if not isinstance(gains[joint], PIGains):
                raise InputError(
                    f"gains of '{joint}' are a {type(gains[joint]).__name__}, give "
                    f"{_gains_example(joint)}"
                )
        super().__init__(machine)
        self.reference: Trajectory = add_free_joints(machine, reference)
        self._initial_integral = (
            None if integral is None else as_sample(integral, len(driven), "integral", driven)
        )
        numbers = [[gains[joint].kp for joint in driven], [gains[joint].ki for joint in driven]]
        self.settings = np.array(numbers, dtype=np.float64).ravel()

    def initial_state(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ControlLaw`."""
        if self._initial_integral is not None:
            return list(self._initial_integral)
        holding_forces = np.array(
            self.select_driven(inputs.inverse([0.0] * len(inputs.q_a), friction=True))
        )
        kp, ki = np.array(self._gains(inputs))
        has_integral_gain = ki > 0
        integral_forces = np.where(
            has_integral_gain, holding_forces - kp * np.array(self._error(inputs)), 0.0
        )
        return list(integral_forces / np.where(has_integral_gain, ki, 1.0))

    def references(self, times: Array) -> Array:
        """See `ControlLaw`."""
        return self.reference.position(times)[:, self.machine.is_driven]

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`; the states are the integrals of the errors."""
        error = self._error(inputs)
        kp, ki = self._gains(inputs)
        forces = [p * e + i * z for p, i, e, z in zip(kp, ki, error, inputs.state, strict=True)]
        return self.expand_driven(forces), error

    def _error(self, inputs: ControllerInputs) -> list[Scalar]:
        return subtract_vectors(inputs.reference, self.select_driven(inputs.q_a))

    def _gains(self, inputs: ControllerInputs) -> tuple[list[Scalar], list[Scalar]]:
        k = len(inputs.reference)
        return inputs.settings[:k], inputs.settings[k : 2 * k]


class ComputedTorque(ControlLaw):
    """Inverse dynamics with a critically damped error: e'' + 2 w e' + w^2 e = 0.

    tau = inverse(q_A, v_A, a_ref + 2 w (v_ref - v_A) + w^2 (q_ref - q_A)) with friction.

    Free joints get no force and follow no reference: what drives the others so while these swing
    is `Dynamics.hybrid`. Where nothing is said to drive another joint (`Machine.undriven_joints`),
    a warning names it and the force that it takes along the reference.

    Args:
        machine: The machine.
        reference: Reference of the driven joints, see `add_free_joints`.
        bandwidth: w [rad/s].
    """

    def __init__(self, machine: Machine, reference: Trajectory, bandwidth: float = 20.0):
        super().__init__(machine)
        self.reference: Trajectory = add_free_joints(machine, reference)
        self.settings = np.array([as_number(bandwidth, "the bandwidth", "rad/s", greater_than=0)])
        if machine.undriven_joints:
            warnings.warn(self._undriven_joints_text(machine), CraneWarning, stacklevel=2)

    def _undriven_joints_text(self, machine: Machine) -> str:
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
        for joint in machine.undriven_joints:
            peak = peaks[machine.active.index(joint)]
            unit = "N" if machine.unit(joint) == "m" else "N m"
            words.append(f"'{joint}'" + (f" (up to {peak:.3g} {unit})" if peak == peak else ""))
        return (
            f"nothing is said to drive {', '.join(words)} of '{machine.name}', computed torque "
            "does so all the same: write an effort above 0 into the <limit> of what is driven, or "
            "describe its cylinder or gains, and lock what is not"
        )

    def references(self, times: Array) -> Array:
        """See `ControlLaw`."""
        return np.concatenate(
            [x[:, self.machine.is_driven] for x in self.reference(times)], axis=1
        )

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        w, k = inputs.settings[0], int(self.machine.is_driven.sum())
        reference_motion = (inputs.reference[i * k : (i + 1) * k] for i in range(3))
        accelerations: list[Scalar] = [
            a_ref + 2.0 * w * (v_ref - v) + w * w * (q_ref - q)
            for q_ref, v_ref, a_ref, q, v in zip(
                *reference_motion,
                self.select_driven(inputs.q_a),
                self.select_driven(inputs.v_a),
                strict=True,
            )
        ]
        tau, _ = hybrid_dynamics(
            inputs.inverse, self.machine.is_driven.tolist(), accelerations, friction=True
        )
        return self.expand_driven(tau), ()


def _gains_example(joint: str) -> str:
    """How gains are given in Python."""
    return f"gains={{'{joint}': crane.PIGains(kp, ki)}}"
