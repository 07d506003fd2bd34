"""Controllers of the active forces: base class of control laws, PI control, computed torque."""

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen.symbolic import Scalar, subtract_vectors, where_positive
from crane.common.errors import ClosureError, CraneWarning, InputError
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, as_number, as_sample
from crane.description.sensors import FORCE_UNITS
from crane.description.specification import PIGains
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.external_forces import static_active_forces
from crane.dynamics.inertial_force_formulas import hybrid_dynamics
from crane.machine.machine import Machine
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory


class Controller(Protocol):
    """Interface of a controller for `simulate`, which also accepts (t, q_a, v_a) -> tau_a.

    A controller may have a `reference` trajectory, from which `simulate` takes start and duration.
    """

    def start(self, q_a: Array) -> Array:
        """Initial controller states (k,), which are integrated with the state of the machine."""

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """Active forces (n,) [N], [N m], and rates (k,) of the controller states."""


class ControllerInputs(NamedTuple):
    """Inputs of a control law at an instant: floats, or formulas while it is traced.

    Attributes:
        q_a: (n,) active coordinates [m], [rad].
        v_a: (n,) active velocities [m/s], [rad/s].
        state: (k,) states of the controller.
        settings: (s,) its `settings`.
        reference: (c,) its `references` at the instant.
        inverse: Function (a_a, friction) of accelerations (n,) that gives the active forces (n,)
            [N], [N m], see `Dynamics.inverse`.
        gravity: Function that gives the active forces (n,) [N], [N m] which balance gravity.
    """

    q_a: list[Scalar]
    v_a: list[Scalar]
    state: list[Scalar]
    settings: list[Scalar]
    reference: list[Scalar]
    inverse: Callable[..., list[Scalar]]
    gravity: Callable[..., list[Scalar]]


class ControlLaw(OneLineRepr):
    """Base class of controllers whose law is evaluated with floats and traced as formulas.

    A subclass implements `law`. It also implements `initial_state` if it has states, `references`
    if it depends on time, and sets `settings` if it has parameters and `reference` if it follows a
    trajectory.

    Args:
        machine: The machine.

    Attributes:
        reference: The reference trajectory, or None.
        settings: (s,) parameters that can change without a new compilation. All other constants of
            a law become part of the machine code.
        period: Time between calls of `update` [s]; 0 for no calls.
        reference_units: Names and units of its `references`, for programs that are exported, as
            those of `settings` and states; empty for numbers as names.
        setting_units: Names and units of `settings`.
        state_units: Names and units of the states.
    """

    reference: Trajectory | None = None
    period: float = 0.0
    settings: Array = np.zeros(0)
    reference_units: Mapping[str, str] = MappingProxyType({})
    setting_units: Mapping[str, str] = MappingProxyType({})
    state_units: Mapping[str, str] = MappingProxyType({})

    def __init__(self, machine: Machine):
        self.machine = machine

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """Active forces (n,) [N], [N m], 0.0 of free joints, and rates (k,) of the states.

        Args:
            inputs: Floats or formulas: `q_a`, `v_a` (n,), `state` (k,), `settings` (s,),
                `reference` (c,), and the functions `inverse(a_a, friction)` and `gravity()` of
                `Dynamics`.
        """
        raise NotImplementedError

    def update(self, time: float, q: Array, v_a: Array, state: Array) -> None:
        """Set the references of the next period.

        Args:
            time: [s].
            q: (nq,) configuration.
            v_a: (n,) active velocities.
            state: (k,) states of the controller.
        """
        return

    def select_driven(self, values: Sequence[Scalar]) -> list[Scalar]:
        """Values of the driven joints, from those of all active joints (n,)."""
        return list(itertools.compress(values, self.machine.is_driven))

    def expand_driven(self, forces: Sequence[Scalar]) -> list[Scalar]:
        """Forces (n,) of all active joints, from those of the driven joints."""
        remaining = iter(forces)
        return [next(remaining) if driven else 0.0 for driven in self.machine.is_driven]

    def initial_state(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """Initial states (k,) of the controller for a machine at rest; empty by default.

        Args:
            inputs: Floats. `inputs.inverse` is less the external forces at time 0, so that a
                machine with a load is held still like one with a payload.
        """
        return ()

    def references(self, times: Array) -> Array:
        """Inputs that depend on time alone, (N, c) at times (N,) [s]; none by default."""
        return np.zeros((len(times), 0))

    def for_machine(self, machine: Machine) -> "ControlLaw":
        """The same law for another machine with the same joints."""
        found = copy(self)
        found.machine = machine
        vars(found).pop("_dynamics", None)
        return found

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        # compiling does not pay for a single configuration
        return self.start_closed(
            Dynamics(self.machine, backend="pinocchio"), self.machine.closure.solve(q_a)
        )

    def start_closed(
        self, dynamics: Dynamics, q: Array, contact_states: Array | None = None
    ) -> Array:
        """`start` at a closed configuration (nq,), with exact dynamics.

        Args:
            dynamics: Dynamics of the machine.
            q: (nq,) configuration.
            contact_states: States of the external forces; zeros if not given.
        """
        q_a = q[self.machine.closure.active]
        zeros, evaluate = np.zeros_like(q_a), dynamics.tree_dynamics.evaluate
        # the machine of a run may have more external forces than that of the law
        static_forces = static_active_forces(dynamics.machine, q, contact_states)

        def inverse(a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
            quantity = "inverse with friction" if friction else "inverse"
            return (evaluate(quantity, q, zeros, np.array(a_a)) - static_forces).tolist()

        inputs = self.inputs_at(0.0, q_a, zeros, np.zeros(0))._replace(
            inverse=inverse, gravity=lambda: evaluate("gravity", q, zeros, zeros).tolist()
        )
        return np.array(self.initial_state(inputs), dtype=np.float64)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        tau, rate = self.law(self.inputs_at(time, q_a, v_a, state))
        return np.array(tau, dtype=np.float64), np.array(rate, dtype=np.float64)

    def inputs_at(self, time: float, q_a: Array, v_a: Array, state: Array) -> ControllerInputs:
        """Inputs at a time [s] as floats, from q_a (n,), v_a (n,) and states (k,)."""

        def inverse(a_a: Sequence[Scalar], friction: bool) -> list[Scalar]:
            return self._dynamics.inverse(
                q_a, v_a, np.array(a_a, dtype=np.float64), friction
            ).tolist()

        references = self.references(np.array([time]))[0].tolist()
        return ControllerInputs(
            q_a.tolist(), v_a.tolist(), state.tolist(), self.settings.tolist(), references,
            inverse, lambda: self._dynamics.gravity(q_a).tolist(),
        )  # fmt: skip

    @cached_property
    def _dynamics(self) -> Dynamics:
        return Dynamics(self.machine)


class ZeroForce(ControlLaw):
    """A controller without active forces."""

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`."""
        return [0.0] * len(inputs.v_a), ()


class FunctionController:
    """A Python function as a controller.

    Args:
        function: (t, q_a, v_a) -> tau_a, of all active joints or of the driven joints.
        machine: The machine.
    """

    def __init__(self, function: Callable[[float, Array, Array], Array], machine: Machine):
        self._function, self._machine = function, machine

    def start(self, q_a: Array) -> Array:
        """See `Controller`."""
        return np.zeros(0)

    def __call__(self, time: float, q_a: Array, v_a: Array, state: Array) -> tuple[Array, Array]:
        """See `Controller`."""
        forces = self._function(time, q_a.copy(), v_a.copy())
        label, machine = f"the controller's force at t = {time:g} s", self._machine
        if machine.free and np.shape(forces) == (machine.is_driven.sum(),):
            return machine.expand_driven(forces, label), state
        return as_sample(forces, len(machine.active), label, machine.active), state


def controller_reference(controller: Controller, machine: Machine) -> Trajectory | None:
    """The reference of a controller for all active joints; None if it has none."""
    reference = getattr(controller, "reference", None)
    return None if reference is None else add_free_joints(machine, reference)


def motion_units(units: Mapping[str, str], order: int) -> dict[str, str]:
    """Names and units of references: coordinates, by name, and derivatives up to an order."""
    return {
        f"reference_{derivative}{name}": unit + per
        for derivative, per in (("", ""), ("velocity_", "/s"), ("acceleration_", "/s2"))[
            : order + 1
        ]
        for name, unit in units.items()
    }


class PI(ControlLaw):
    """One PI controller per driven joint, equation (7) of the reduced-scale forwarder paper.

    tau = K_p e + K_i int e dt, e = q_ref(t) - q_A. Free joints get no force.

    Args:
        machine: The machine.
        reference: Trajectory of the driven joints, see `add_free_joints`.
        gains: `PIGains` by driven joint, as {"X1": crane.description.PIGains(kp, ki)}; those of
            the machine file if not given.
        integral: (k,) initial values of int e dt of the driven joints [m s], [rad s]. By default
            they balance gravity, as those of a controlled machine that stands still. With zeros
            the machine falls until the integrals have grown.

    Raises:
        InputError: A joint has no gains, or they are no `PIGains`.
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
        self.settings = np.array(
            [*(gains[joint].kp for joint in driven), *(gains[joint].ki for joint in driven)],
            dtype=np.float64,
        )
        units = {joint: machine.unit(joint) for joint in driven}
        self.reference_units = motion_units(units, 0)
        self.setting_units = {
            **{f"{joint}_kp": f"{FORCE_UNITS[unit]}/{unit}" for joint, unit in units.items()},
            **{f"{joint}_ki": f"{FORCE_UNITS[unit]}/({unit} s)" for joint, unit in units.items()},
        }
        self.state_units = {
            f"error_integral_{joint}": f"{unit} s" for joint, unit in units.items()
        }

    def initial_state(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ControlLaw`."""
        if self._initial_integral is not None:
            return list(self._initial_integral)
        forces = self.select_driven(inputs.inverse([0.0] * len(inputs.q_a), friction=True))
        columns = zip(forces, *self._gains(inputs), self._error(inputs), strict=True)
        return [
            where_positive(ki, force - kp * error, 0.0) / where_positive(ki, ki, 1.0)
            for force, kp, ki, error in columns
        ]

    def references(self, times: Array) -> Array:
        """See `ControlLaw`."""
        return self.reference.position(times)[:, self.machine.is_driven]

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        """See `ControlLaw`; the states are the integrals of the errors."""
        error = self._error(inputs)
        kp, ki = self._gains(inputs)
        return self.expand_driven(
            [p * e + i * z for p, i, e, z in zip(kp, ki, error, inputs.state, strict=True)]
        ), error

    def _error(self, inputs: ControllerInputs) -> list[Scalar]:
        return subtract_vectors(inputs.reference, self.select_driven(inputs.q_a))

    def _gains(self, inputs: ControllerInputs) -> tuple[list[Scalar], list[Scalar]]:
        k = len(inputs.reference)
        return inputs.settings[:k], inputs.settings[k : 2 * k]


class ComputedTorque(ControlLaw):
    """Inverse dynamics with a critically damped error: e'' + 2 w e' + w^2 e = 0.

    tau = inverse(q_A, v_A, a_ref + 2 w (v_ref - v_A) + w^2 (q_ref - q_A)) with friction.

    Free joints get no force and follow no reference; the forces of driven joints are then those
    of `Dynamics.hybrid`. If an active joint has no drive in the description
    (`Machine.undriven_joints`), a warning names it and its largest force along the reference.

    Args:
        machine: The machine.
        reference: Trajectory of the driven joints, see `add_free_joints`.
        bandwidth: w [rad/s].
    """

    def __init__(self, machine: Machine, reference: Trajectory, bandwidth: float = 20.0):
        super().__init__(machine)
        self.reference: Trajectory = add_free_joints(machine, reference)
        self.settings = np.array([as_number(bandwidth, "the bandwidth", "rad/s", greater_than=0)])
        self.setting_units = {"bandwidth": "rad/s"}
        self.reference_units = motion_units({x: machine.unit(x) for x in machine.driven_joints}, 2)
        if not machine.undriven_joints:
            return
        motion = self.reference(np.linspace(0.0, self.reference.duration, 201))
        try:
            peaks = np.abs(self._dynamics.inverse(*motion, friction=True)).max(axis=0)
        except ClosureError:  # the simulation reports where
            peaks = np.full(len(machine.active), np.nan)
        words = []
        for joint in machine.undriven_joints:
            peak = peaks[machine.active.index(joint)]
            unit = "N" if machine.unit(joint) == "m" else "N m"
            words.append(f"'{joint}'" + (f" (up to {peak:.3g} {unit})" if peak == peak else ""))
        warnings.warn(
            f"nothing is said to drive {', '.join(words)} of '{machine.name}', computed torque "
            "does so all the same: write an effort above 0 into the <limit> of what is driven, "
            "or describe its cylinder or gains, and lock what is not",
            CraneWarning,
            stacklevel=2,
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
            inputs.inverse,
            self.machine.is_driven.tolist(),
            accelerations,
            friction=True,
            held=self.machine.held,
        )
        return self.expand_driven(tau), ()


def _gains_example(joint: str) -> str:
    return f"gains={{'{joint}': crane.description.PIGains(kp, ki)}}"
