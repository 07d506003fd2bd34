"""Transmission between the actuators of a closed machine and the joints of its tree."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, check_name
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_number, as_sample
from crane.description.external_forces import WRENCH_COMPONENTS
from crane.dynamics.frame_jacobians import FrameJacobians
from crane.machine.machine import Machine

_FIELD_NAMES = ("position", "velocity", "effort")
# least singular value of the map from actuators to joints, per the largest
_SINGULARITY_TOLERANCE = 1e-9


@dataclass(frozen=True)
class JointState:
    """State of all joints, with the fields of `sensor_msgs/JointState`.

    Attributes:
        name: Names of all k joints.
        position: (k,) [m], [rad].
        velocity: (k,) [m/s], [rad/s]; empty if that of an actuator is unknown.
        effort: (k,) [N], [N m], forces of the actuators at their joints, zero elsewhere; empty if
            that of an actuator is unknown.
    """

    name: tuple[str, ...]
    position: Array
    velocity: Array
    effort: Array


class Transmission(OneLineRepr):
    """Positions, velocities and forces between the actuators and the joints of the tree.

    It is a transmission in the sense of ros2_control, with ratios that the loops determine. With
    the active joints q_A, gamma = dq/dq_A, the forces tau at all joints of the tree, and the
    Jacobian J and wrench w of a link,

        q = f(q_A),    v = gamma v_A,    f_A = gamma^T tau = gamma^T J^T w,

    so that f_A^T v_A = tau^T v. `update` takes the state of the actuators and closes the loops on
    the branch of home; forces are mapped in the configuration of the last update. A ball joint is
    three joints here, with Cardan angles R_x R_y R_z and their rates. The six freedoms of a
    floating base are not joints: the base is fixed in its home placement.

    Args:
        machine: The machine.

    Attributes:
        machine: The machine.
        actuators: Names of the n active joints.
        joints: Names of the k joints of the tree.
        state: The last state of all joints; None until the position of each active joint is known.
    """

    def __init__(self, machine: Machine):
        self.machine = machine
        self.state: JointState | None = None
        floating_joints = {
            x for i in machine.coordinates.floating_base_columns for x in machine.joints[i : i + 6]
        }
        self.actuators = tuple(joint for joint in machine.active if joint not in floating_joints)
        self.joints = tuple(joint for joint in machine.joints if joint not in floating_joints)
        self._joint_columns = np.array([machine.column(x) for x in self.joints], dtype=np.intp)
        self._actuator_columns = np.array(
            [machine.active.index(x) for x in self.actuators], dtype=np.intp
        )
        self._received_values = np.full((3, len(self.actuators)), np.nan)  # one row per field
        self._gamma: Array | None = None
        self._jacobians = FrameJacobians(machine)

    def _one_line(self) -> str:
        return (
            f"Transmission of '{self.machine.name}': {', '.join(self.actuators)} to "
            f"{len(self.joints)} joints"
        )

    @property
    def unknown_actuators(self) -> tuple[str, ...]:
        """Active joints whose position is not known yet."""
        return tuple(np.array(self.actuators)[np.isnan(self._received_values[0])].tolist())

    def update(
        self,
        name: Sequence[str],
        position: Sequence[float] = (),
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> JointState | None:
        """Update the state from a message about actuators, as in `sensor_msgs/JointState`.

        The names may be any of the active joints in any order; the others keep their values. Other
        joints and values that are NaN (not measured) are ignored. A message replaces all values of
        the joints that it names: a missing velocity or effort becomes unknown, a missing position
        is kept.

        Args:
            name: Names of k joints.
            position: k positions [m], [rad], or none.
            velocity: k velocities [m/s], [rad/s], or none.
            effort: k forces [N], [N m], or none.

        Returns:
            The state of all joints, with loops closed to rounding; None if the message has no
            active joint, or the position of one is not known yet.

        Raises:
            InputError: A field has another length than the names, or an infinite value.
            ClosureError: The loops do not close on the branch of home. The state does not change.
        """
        fields = zip((position, velocity, effort), _FIELD_NAMES, strict=True)
        field_arrays = [_field_array(values, len(name), what) for values, what in fields]
        index_pairs = [
            (self.actuators.index(joint), i)
            for i, joint in enumerate(name)
            if joint in self.actuators
        ]
        if not index_pairs:
            return None
        columns, message_indices = np.array(index_pairs).T
        received_values = self._received_values.copy()
        message_values = np.array(field_arrays)[:, message_indices]
        received_values[1:, columns] = message_values[1:]
        is_measured = ~np.isnan(message_values[0])
        received_values[0, columns[is_measured]] = message_values[0, is_measured]
        state = None if np.isnan(received_values[0]).any() else self._close_loops(*received_values)
        self._received_values = received_values
        return state

    def _close_loops(self, q_a: Array, v_a: Array, f_a: Array) -> JointState:
        closure = self.machine.closure
        active_coordinates = closure.home[closure.active]
        active_coordinates[self._actuator_columns] = q_a
        q = closure.solve(active_coordinates)
        positions, rates = self.machine.coordinates.cardan_angles(q)
        gamma = (rates @ closure.gamma(q))[np.ix_(self._joint_columns, self._actuator_columns)]
        effort = np.zeros(len(q))
        effort[closure.active[self._actuator_columns]] = f_a
        velocity, effort = gamma @ v_a, effort[self._joint_columns]
        self._gamma, self._configuration = gamma, q
        self.state = JointState(
            self.joints,
            positions[self._joint_columns],
            *(np.empty(0) if np.isnan(x).any() else x for x in (velocity, effort)),
        )
        return self.state

    def joint_to_actuator(self, effort: Mapping[str, float]) -> dict[str, float]:
        """Forces of the actuators that are equivalent to forces at joints: gamma^T tau.

        For forces of a controller or of inverse dynamics of the tree.

        Args:
            effort: Forces by joint [N], [N m]; default zero.

        Returns:
            Forces by active joint [N], [N m].

        Raises:
            InputError: A joint is unknown, or there is no state yet.
        """
        gamma, tau = self._known_gamma(), np.zeros(len(self.joints))
        for joint, value in effort.items():
            tau[self._joint_index(joint)] = as_number(value, f"effort of {joint}", "")
        return dict(zip(self.actuators, (gamma.T @ tau).tolist(), strict=True))

    def actuator_to_joint(
        self, effort: Mapping[str, float], joints: Sequence[str]
    ) -> dict[str, float]:
        """Forces at chosen joints that are equivalent to forces of the actuators.

        They solve G^T tau = f_A with the rows G of gamma for these joints: for example moments at
        the pins of the booms in place of cylinder forces.

        Args:
            effort: Forces by active joint [N], [N m]; default zero.
            joints: Names of as many joints as there are active ones.

        Returns:
            By joint [N], [N m].

        Raises:
            InputError: Names are unknown, there is no state yet, or the joints do not determine
                the motion of the machine in this configuration.
        """
        gamma, f_a = self._known_gamma(), np.zeros(len(self.actuators))
        for joint, value in effort.items():
            check_name(joint, self.actuators, f"'{joint}' is not active")
            f_a[self.actuators.index(joint)] = as_number(value, f"effort of {joint}", "")
        joint_indices = [self._joint_index(joint) for joint in joints]
        units = self.machine.closure.units
        joint_units = units[self._joint_columns[joint_indices]]
        active_units = units[self.machine.closure.active[self._actuator_columns]]
        scaled_gamma = gamma[joint_indices] / joint_units[:, None] * active_units
        singular_values = np.linalg.svd(scaled_gamma, compute_uv=False)
        if (
            len(joint_indices) != len(f_a)
            or not singular_values[-1] > _SINGULARITY_TOLERANCE * singular_values[0]
        ):
            raise InputError(
                f"{', '.join(joints) or 'no joint'} do not determine the motion of the machine "
                f"here, give {len(f_a)} independent joints"
            )
        tau = np.linalg.solve(scaled_gamma.T, f_a * active_units) / joint_units
        return dict(zip(joints, tau.tolist(), strict=True))

    def wrench_to_actuator(self, wrench: ArrayLike, link: str | None = None) -> dict[str, float]:
        """Forces of the actuators that are equivalent to a wrench on a link: gamma^T J^T w.

        Actuators that balance the wrench exert the negative of it.

        Args:
            wrench: (6,) force [N] and moment about the origin of the link [N m], in the axes of
                the root link.
            link: The link; default the tip.

        Returns:
            Forces by active joint [N], [N m].

        Raises:
            InputError: The link is unknown, there is no tip, or no state yet.
        """
        gamma = self._known_gamma()
        if (frame := link or self.machine.tip) is None:
            raise InputError(f"machine '{self.machine.name}' has no tip, name a link")
        self.machine.frame(frame)
        wrench_array = as_sample(wrench, 6, f"the wrench on '{frame}'", WRENCH_COMPONENTS)
        self._jacobians.set_configuration(self._configuration)
        tau = (self._jacobians.jacobian(frame).T @ wrench_array)[self._joint_columns]
        return dict(zip(self.actuators, (gamma.T @ tau).tolist(), strict=True))

    def _known_gamma(self) -> Array:
        if self._gamma is None:
            raise InputError(
                "the configuration is not known yet, update it with "
                f"{', '.join(self.unknown_actuators)}"
            )
        return self._gamma

    def _joint_index(self, joint: str) -> int:
        check_name(joint, self.joints, f"joint '{joint}' is unknown")
        return self.joints.index(joint)


def _field_array(values: Sequence[float], count: int, label: str) -> Array:
    """Values (count,) of a field, NaN if it is empty."""
    if not len(values):
        return np.full(count, np.nan)
    array = np.asarray(values, dtype=float)
    if array.shape != (count,):
        raise InputError(
            f"{label} has {len(values)} values for {count} names, give one each or none"
        )
    if np.isinf(array).any():
        raise InputError(f"{label} has an infinite value, give NaN for what is not measured")
    return array
