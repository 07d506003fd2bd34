"""A discrete PI controller that moves a plant, using only the sensor readings."""

import math
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen import Scalar
from crane.common.errors import (
    ClosureError,
    CraneError,
    CraneWarning,
    InputError,
    SimulationError,
    suggest_names,
)
from crane.common.samples import Array, as_number, as_seed
from crane.control import PI, ControlLaw, ControllerInputs
from crane.dynamics import Dynamics
from crane.formats import load
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.motion.limit_violations import limit_violation_message
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory
from crane.recordings.recording import FORCE_UNITS, VELOCITY_UNITS, Recording
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.integrators import FixedStepIntegrator
from crane.simulation.integration.python_stepper import IntegrationHaltError, explain_halt
from rig.plant import Tolerances, drawn
from rig.sensors import Sensors, default_sensors

_LONGEST = 1e-3  # substep [s]
_STABLE = 2.0  # fastest rate times substep; Runge-Kutta of fourth order bears 2.785
_CUTOFF = 5.0  # [Hz] of the measured velocity


class Rig:
    """A virtual rig: a plant that nobody knows exactly, sensors, drivers, a controller.

    Args:
        machine: The model. A payload has to be among the changes it was loaded with; what
            `Machine.with_payload` put on it, and locked joints, cannot be carried over.
        seed: Of everything random. The first run of a rig is the same bit for bit for the same
            seed, and so is the second.
        tolerances: See there.
        sensors: By active joint, in place of `default_sensors`.

    Attributes:
        machine: The model.
        plant: The machine that moves.
        changes: How the plant differs from the machine's files, by the names of
            `crane.description.parameters`.
        sensors: By active joint.
        errors: (n,) relative errors of the currents' gains.
        limits: (n,) largest forces of the active joints [N], [N m]: the smaller of the joint's
            effort and of what the driver's current gives by equation (8).

    Raises:
        InputError: Wrong seed, sensors of an unknown joint, a machine that cannot be loaded
            again, friction that jumps, or a plant that does not close.
    """

    def __init__(
        self,
        machine: Machine,
        seed: int,
        tolerances: Tolerances = Tolerances(),  # noqa: B008
        sensors: Mapping[str, Sensors] | None = None,
    ):
        seed = as_seed(seed)
        for joint in sensors or {}:
            if joint not in machine.active:
                raise InputError(f"sensors of '{joint}', {suggest_names(machine.active, joint)}")
        self.machine, self.seed, self._runs = machine, seed, 0
        self.sensors = {
            joint: (sensors or {}).get(joint) or default_sensors(machine, joint)
            for joint in machine.active
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CraneWarning)  # told when the machine was loaded
            if load(machine.load_name, machine.parameter_changes).model != machine.model:
                raise InputError(
                    f"'{machine.name}' has a payload or locked joints that loading it again does "
                    "not give, load it with a change of payload.mass and without locks"
                )
            self.changes = drawn(machine, tolerances, np.random.default_rng([seed, 0]))
            try:
                plant = load(machine.load_name, self.changes)
            except CraneError as error:
                raise InputError(f"the plant of seed {seed} does not close: {error}") from None
        self.plant = plant.replace(
            forces=machine.forces,
            gas_springs=machine.gas_springs,
            ropes=machine.ropes,
            end_stops=machine.end_stops,
        )
        random = np.random.default_rng([seed, 1])
        self.errors = np.array(
            [random.choice([-1, 1]) * random.uniform(*s.error) for s in self.sensors.values()]
        )
        self.limits = np.array(
            [
                min(
                    machine.model.effortLimit[machine.column(joint)],
                    s.gain * (s.driver - s.no_load),
                )
                for joint, s in self.sensors.items()
            ]
        )

    def run(self, path: Trajectory, step: float = 1e-3, *, label: str = "") -> Recording:
        """Let the rig follow a path and record it.

        Every `step` the controller reads the sensors and sets forces, which hold until the next:

            tau_k = K_p e_k + K_i z_k,   z_k+1 = z_k + e_k step,   e = q_ref - q_measured,

        equation (7) with the gains of the machine file, cut off at `limits`. z_0 carries the
        model's weight. Between, the plant is integrated by Runge-Kutta of fourth order in equal
        substeps of at most a millisecond, as many as the friction's slope asks for.

        `q` is measured; `v` is its central difference after a Butterworth filter of second order
        and 5 Hz, run forth and back; `tau` is equation (8) of the measured current. That current
        has no sign. The paper puts the sign of the motion back; here it is the sign of the
        command, which the controller knows and which is that of the force also where the load
        drives the actuator, as when it lowers.

        Args:
            path: Reference of the driven joints, see `add_free_joints`; the plant starts on it at
                rest.
            step: Sampling interval [s].
            label: Name of the motion to put into the recording.

        Returns:
            Recording with the channels reference_, command_ (before the cut-off), current_
            (measured, unsigned), true_, true_velocity_, true_force_<joint>; where there is a tip,
            tip_x, y, z of the model at the measured coordinates, true_tip_x, y, z of the plant.

        Raises:
            InputError: The path has other joints, the step is no part of its duration or too
                long for the filter, or the label is not one line of text.
            LimitError: The path starts outside of the limits.
            SimulationError: The plant reached a posture it cannot go on from.
        """
        machine, plant, n = self.machine, self.plant, len(self.machine.active)
        if not (isinstance(label, str) and label.isprintable() and label == label.strip()):
            raise InputError(f"label {label!r} is not one line of text")
        step = as_number(step, "the step", "s", greater_than=0)
        path = add_free_joints(machine, path)
        count = round(path.duration / step)
        if count < 1 or abs(count * step - path.duration) > 1e-9 * path.duration:
            raise InputError(f"the step of {step:g} s is no part of {path.duration:g} s")
        if step * _CUTOFF >= 0.25:
            raise InputError(f"the step is {step:g} s, give less than {0.25 / _CUTOFF:g} s")
        time = step * np.arange(count + 1, dtype=np.float64)
        reference = path.position(time)
        if reference.shape[1] != n:
            raise InputError(
                f"the path is of {reference.shape[1]} joints, '{machine.name}' has {n}"
            )
        plant.check_limits(reference[0], "the start of the path")
        if text := limit_violation_message(machine, path):
            warnings.warn(text, CraneWarning, stacklevel=2)
        for closure in (machine.closure, plant.closure):
            # what was solved before shows in the last bits of what is solved next: start afresh
            closure.solve(closure.home[closure.active], initial_guess=closure.home)
        random = np.random.default_rng([self.seed, 2, self._runs])
        self._runs += 1
        noise = random.standard_normal((2, count + 1, n))
        measured, command, force, postures, v = self._follow(path, reference, noise[0], step)
        current, tau = self._currents(force, np.sign(command), noise[1])
        q = postures[:, plant.closure.active]
        channels: dict[str, Array] = {}
        units: dict[str, str] = {}
        for i, joint in enumerate(machine.active):
            unit = machine.unit(joint)
            for name, values, of in (
                ("reference", reference, unit), ("command", command, FORCE_UNITS[unit]),
                ("current", current, "A"), ("true", q, unit),
                ("true_velocity", v, VELOCITY_UNITS[unit]),
                ("true_force", force, FORCE_UNITS[unit]),
            ):  # fmt: skip
                if joint not in machine.free or name in ("true", "true_velocity"):
                    channels[f"{name}_{joint}"], units[f"{name}_{joint}"] = values[:, i], of
        if machine.tip is not None:
            known_tip, tip = Kinematics(machine).position(measured), Kinematics(plant)
            true_tip = tip.positions_at_configurations(postures)
            for name, points in (("tip", known_tip), ("true_tip", true_tip)):
                for axis, values in zip("xyz", points.T, strict=True):
                    channels[f"{name}_{axis}"], units[f"{name}_{axis}"] = values, "m"
        return Recording(
            time=time,
            joints=machine.active,
            q=measured,
            v=_velocity(measured, step),
            tau=tau,
            units={joint: machine.unit(joint) for joint in machine.active},
            channels=channels,
            channel_units=units,
            machine=machine.load_expression,
            task=": ".join(filter(None, (f"virtual rig, seed {self.seed}", label))),
            free=machine.free,
        )

    def _follow(
        self, path: Trajectory, reference: Array, noise: Array, step: float
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Measured coordinates, commands, forces, postures (., nq) and velocities, all (., n)."""
        control, sensors = PI(self.machine, path), list(self.sensors.values())
        kp, ki = (self.machine.expand_driven(x, "gains") for x in np.split(control.settings, 2))
        noise = noise * [s.noise for s in sensors]
        plant, dynamics = self.plant, Dynamics(self.plant)
        n, nq, active = len(plant.active), plant.model.nq, plant.closure.active
        held, substeps = _Held(plant), _substeps(dynamics, reference, step)
        chart, h = Chart.from_dynamics(dynamics, held, 0), step / substeps
        steps = FixedStepIntegrator(chart)
        steps.set_chart_limits(np.array([np.inf, -np.inf]))  # the rig stays away from dead centres
        state = np.concatenate([plant.closure.solve(reference[0]), np.zeros(n + 2)])
        now = chart.state_layout.view(state)
        rows = np.empty((substeps, chart.row_layout.size))
        integral = self.machine.expand_driven(control.start(reference[0]), "the integral")
        measured, command, force = (np.empty_like(reference) for _ in range(3))
        postures, v = np.empty((len(reference), nq)), np.empty_like(reference)
        for k in range(len(reference)):
            q_a = now.q[active] + noise[k]
            measured[k] = [s.position(x) for s, x in zip(sensors, q_a, strict=True)]
            error = reference[k] - measured[k]
            command[k] = kp * error + ki * integral
            integral = integral + step * error
            force[k] = np.minimum(np.maximum(command[k], -self.limits), self.limits)
            postures[k], v[k] = now.q, now.v_a
            held.settings[:] = force[k, plant.is_driven]
            if k < len(reference) - 1:
                times = k * step + h * np.arange(substeps, dtype=np.float64)
                try:
                    steps.run(times, state, h, rows)
                except IntegrationHaltError as halt:
                    before = step * np.arange(k + 1.0), postures[: k + 1, active]
                    raise explain_halt(plant, halt, *before, path) from None
        return measured, command, force, postures, v

    def _currents(self, force: Array, sign: Array, noise: Array) -> tuple[Array, Array]:
        """Measured currents (N, n) [A], and the forces that equation (8) makes of them."""
        current, tau = np.empty_like(force), np.empty_like(force)
        for i, s in enumerate(self.sensors.values()):
            true = np.abs(force[:, i]) / s.gain + s.no_load
            current[:, i] = s.current(true * (1 + self.errors[i]) + s.current_noise * noise[:, i])
            tau[:, i] = sign[:, i] * s.gain * (current[:, i] - s.no_load)
        return current, tau


class _Held(ControlLaw):
    """Forces that hold until they are set again."""

    def __init__(self, machine: Machine):
        super().__init__(machine)
        self.settings = np.zeros(len(machine.driven_joints))

    def law(self, inputs: ControllerInputs) -> tuple[Sequence[Scalar], Sequence[Scalar]]:
        return self.expand_driven(inputs.settings), ()


def _velocity(q: Array, step: float) -> Array:
    """Central differences (N, n) of the filtered coordinates."""
    from scipy.signal import butter, sosfiltfilt

    low_pass = butter(2, _CUTOFF, fs=1 / step, output="sos")
    pad = min(len(q) - 1, round(1 / (_CUTOFF * step)))
    return np.gradient(sosfiltfilt(low_pass, q, axis=0, padlen=pad), step, axis=0)


def _substeps(dynamics: Dynamics, reference: Array, step: float) -> int:
    """Substeps with which Runge-Kutta is stable.

    The fastest rate is the largest eigenvalue of M_A^-1 gamma^T D gamma, D the slopes of friction
    at rest: viscous, and (coulomb + stiction) / smoothing where it does not stick.
    """
    machine, fastest = dynamics.machine, 0.0
    slopes = np.zeros(machine.model.nv)
    for joint, f in machine.friction.items():
        smoothed = f.breakaway_force / f.smoothing if f.smoothing else 0.0
        slopes[machine.column(joint)] = f.viscous + smoothed
    # the plant goes no farther than its limits, wherever its reference is
    within = np.clip(reference[:: max(1, len(reference) // 100)], machine.lower, machine.upper)
    try:
        postures = machine.closure.solve(within)
    except ClosureError as error:
        raise SimulationError(f"the path leads where the loops do not close: {error}") from None
    for q in postures:
        gamma = machine.closure.gamma(q)
        damping = gamma.T @ (slopes[:, None] * gamma)
        mass = dynamics.mass_matrix(q[machine.closure.active])
        rates = np.linalg.eigvals(np.linalg.solve(mass, damping))
        fastest = max(fastest, float(np.abs(rates).max()))
    return max(1, math.ceil(step * max(fastest / _STABLE, 1.0 / _LONGEST) * (1.0 - 1e-9)))
