"""State of a live view: one closed configuration, and playback of a recording."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import ClosureError, InputError, check_name
from crane.common.samples import Array, as_number
from crane.dynamics.dynamics import Dynamics
from crane.machine.machine import Machine
from crane.machine.payload import Payload
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces.workspace_patch import follow_branch, last_closed_configuration
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import DISPLAY_UNITS
from crane.view.page.page_motion import recorded_configurations
from crane.view.page.scene import round_up_to_nice


class Playback:
    """Active coordinates and forces of a recording, interpolated in time.

    Args:
        machine: The recorded machine.
        recording: The recording.

    Attributes:
        start: Time of the first sample [s].
        end: Time of the last sample [s].
        configurations: (N, nq) closed configurations of all samples [m], [rad].

    Raises:
        RecordingError: The recording lacks an active joint of the machine.
        ClosureError: The loops cannot be closed at a sample.
    """

    def __init__(self, machine: Machine, recording: Recording):
        rows = np.arange(len(recording.time))
        self.configurations = recorded_configurations(machine, recording, rows)
        columns = [recording.joints.index(joint) for joint in machine.active]
        self._time = recording.time
        self._coordinates, self._forces = recording.q[:, columns], recording.tau[:, columns]
        self.start, self.end = float(self._time[0]), float(self._time[-1])

    def interpolate(self, time: float) -> tuple[Array, Array]:
        """Return active coordinates (n,) [m], [rad] and forces (n,) [N], [N m] at a time [s].

        Values are interpolated linearly between samples.
        """
        q_a, forces = (
            np.array([np.interp(time, self._time, column) for column in values.T])
            for values in (self._coordinates, self._forces)
        )
        return q_a, forces


_STEP_COUNT = 128  # of a move, so that none jumps over a gap of the branch
_UNLIMITED_ANGLE_RANGE, _UNLIMITED_STROKE_RANGE = (
    np.pi,
    1.0,
)  # how far a slider goes to both sides of home without limits [rad], [m]


@dataclass(frozen=True, eq=False)
class Readout:
    """A closed configuration with tip, forces and loop conditions.

    Attributes:
        configuration: (nq,) coordinates [m], [rad].
        q_a: (n,) active coordinates [m], [rad].
        tip: (3,) position of the tip [m]; None without a tip.
        gravity: (n,) active forces that hold the weight and the payload [N], [N m].
        largest_gain: Entry of gamma with the largest magnitude among the passive joints
            [m/m], [rad/m], [m/rad], [rad/rad]; 0 without any.
        gain_joints: Passive and active joint of this entry; empty without any.
        condition_number: Condition number of J_P, the passive columns of the loops' Jacobian in SI
            units; 1 without loops. It is infinite at a singular configuration.
        weakest_loop: Loop that constrains the passive joints least; empty without loops.
        residual: Largest loop equation [m], [rad].
        refusal: Reason why the last move was not completed; empty if it was.
    """

    configuration: Array
    q_a: Array
    tip: Array | None
    gravity: Array
    largest_gain: float
    gain_joints: tuple[str, ...]
    condition_number: float
    weakest_loop: str
    residual: float
    refusal: str = ""


class Session:
    """A machine that is moved joint by joint.

    Args:
        machine: The machine.

    Attributes:
        machine: The machine without payload.
        lower: (n,) lower ends of the sliders [m], [rad].
        upper: (n,) upper ends of the sliders [m], [rad].
        readout: Configuration with its forces.
        payload_mass: Mass at the tip [kg].
        max_payload: Largest payload that a slider offers [kg]: half of the moving mass, or a
            little more, as a round number.
    """

    def __init__(self, machine: Machine):
        self.machine = machine
        self.payload_mass = 0.0
        self._dynamics = Dynamics(machine, backend="pinocchio")
        self._kinematics = None if machine.tip is None else Kinematics(machine)
        home = machine.home[machine.closure.active]
        default_ranges = np.array(
            [
                _UNLIMITED_ANGLE_RANGE if machine.unit(x) == "rad" else _UNLIMITED_STROKE_RANGE
                for x in machine.active
            ]
        )
        self.lower = np.where(np.isfinite(machine.lower), machine.lower, home - default_ranges)
        self.upper = np.where(np.isfinite(machine.upper), machine.upper, home + default_ranges)
        self.max_payload = round_up_to_nice(
            sum(inertia.mass for inertia in list(machine.model.inertias)[1:]) / 2
        )
        self.readout = self._compute_readout(machine.home)

    def move(self, joint: str, value: float) -> Readout:
        """Move one active joint; all others are held.

        If the loops cannot be closed at the value, the machine moves as far towards it as
        possible, and the readout states the reason.

        Args:
            joint: Active joint.
            value: Coordinate within the range of the slider [m], [rad].

        Raises:
            InputError: The joint is unknown, or the value is not finite or out of range.
        """
        active = self.machine.active
        check_name(joint, active, f"'{joint}' is no active joint")
        index = active.index(joint)
        unit = self.machine.unit(joint)
        value = as_number(value, f"the value of {joint}", unit)
        lower, upper = self.lower[index], self.upper[index]
        tolerance = 1e-9 * (upper - lower)
        if not lower - tolerance <= value <= upper + tolerance:
            raise InputError(
                f"{joint} = {value:.6g} {unit} is outside of {lower:.6g} to {upper:.6g}, "
                "choose a value within"
            )
        target = self.readout.q_a.copy()
        target[index] = value
        if not self.machine.closure.is_compiled:
            return self.set_active_coordinates(target)
        q = self.readout.configuration
        path = np.linspace(self.readout.q_a, target, _STEP_COUNT + 1)[1:]
        while len(path):
            closed = follow_branch(self.machine, q, path)
            q, path = np.vstack([q, closed])[-1], path[len(closed) :]
            if not len(path):
                break
            q, is_reached = last_closed_configuration(self.machine, q, path[0])  # by smaller steps
            path = path[1:] if is_reached else path[:0]
        readout = self._compute_readout(q)
        if readout.q_a[index] != value:
            shown_unit, scale = DISPLAY_UNITS[unit]
            readout = replace(
                readout,
                refusal=f"{joint} stops at {scale * readout.q_a[index]:.4g} {shown_unit}: beyond "
                f"it loop '{readout.weakest_loop}' leaves its assembly branch or cannot be closed",
            )
        self.readout = readout
        return readout

    def set_active_coordinates(self, q_a: ArrayLike) -> Readout:
        """Set all active coordinates (n,).

        The machine does not move if the loops cannot be closed there.
        """
        try:
            self.readout = self._compute_readout(
                self.machine.closure.solve(q_a, initial_guess=self.readout.configuration)
            )
        except ClosureError as error:
            self.readout = replace(self.readout, refusal=str(error))
        return self.readout

    def go_home(self) -> Readout:
        """Move to the home configuration."""
        self.readout = self._compute_readout(self.machine.home)
        return self.readout

    def set_payload(self, mass: float) -> Readout:
        """Set the mass of the payload at the tip [kg].

        Raises:
            InputError: The machine has no tip, or the mass is negative or not finite.
        """
        if self.machine.tip is None:
            raise InputError(f"machine '{self.machine.name}' has no tip to hang a load on")
        self._dynamics = Dynamics(
            self.machine.with_payload(Payload(self.machine.tip, mass)), backend="pinocchio"
        )
        self.payload_mass = float(mass)
        self.readout = replace(
            self._compute_readout(self.readout.configuration), refusal=self.readout.refusal
        )
        return self.readout

    def tip_positions(self, q: Array) -> Array:
        """Return tip positions (N, 3) [m] at closed configurations (N, nq); (0, 3) if no tip."""
        if self._kinematics is None:
            return np.empty((0, 3))
        return self._kinematics.positions_at_configurations(q)

    def _compute_readout(self, q: Array) -> Readout:
        """Return the readout of a closed configuration (nq,).

        Raises:
            SingularConfigurationError: The passive joints are not determined.
        """
        machine, closure = self.machine, self.machine.closure
        gamma = closure.gamma(q)
        gains = np.abs(gamma[closure.passive])
        gain, gain_of = 0.0, tuple[str, ...]()
        if gains.any():
            row, column = np.unravel_index(int(gains.argmax()), gains.shape)
            gain = float(gamma[closure.passive[row], column])
            gain_of = (machine.joints[closure.passive[row]], machine.active[column])
        condition, weakest = self._loop_condition(q)
        q_a = np.array(q[closure.active])
        zero_velocity = np.zeros(len(q_a))
        return Readout(
            configuration=np.array(q),
            q_a=q_a,
            tip=None
            if self._kinematics is None
            else self._kinematics.position_at_configuration(q),
            gravity=self._dynamics.evaluate_closed("gravity", q, zero_velocity, zero_velocity),
            largest_gain=gain,
            gain_joints=gain_of,
            condition_number=condition,
            weakest_loop=weakest,
            residual=float(closure.residual(q)),
        )

    def _loop_condition(self, q: Array) -> tuple[float, str]:
        """Return the condition number of J_P, and the loop that constrains least.

        Lengths are scaled by the characteristic length, to compare metres and radians.
        """
        closure = self.machine.closure
        equations, rows = closure.equations, closure.structure.independent_rows
        if not len(rows):
            return 1.0, ""
        left_singular_vectors, singular_values, _ = np.linalg.svd(
            equations.evaluate_scaled(q)[1][rows][:, closure.passive]
        )
        condition = singular_values[0] / singular_values[-1] if singular_values[-1] > 0 else np.inf
        return float(condition), equations.names[
            int(
                np.bincount(
                    equations.loop_of_row[rows], left_singular_vectors[:, -1] ** 2
                ).argmax()
            )
        ]
