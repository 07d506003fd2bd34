"""Linear model of a machine about an operating point."""

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import CraneWarning, InputError, check_name
from crane.common.progress import progress_reporter
from crane.common.samples import Array, as_samples
from crane.description.machine_parameters import unknown_parameter_text
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.external_forces import ExternalForces
from crane.formats.machine_loading import MachineVariants, load
from crane.machine.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.simulation.linear.linear_drive import LinearizedDrive
from crane.simulation.linear.linear_model import LinearModel
from crane.simulation.linear.trim import find_trim

_DIFFERENCE_STEP = 2e-4  # in coordinate units: nine digits remain


def external_force_derivatives(machine: Machine, q_a: Array, v_a: Array) -> tuple[Array, Array]:
    """External forces along the active joints at time 0, and their derivatives.

    The derivatives are differences of fourth order. Forces with states
    (`ExternalForce.state_count`) are left out, with a warning.

    Args:
        machine: The machine.
        q_a: (n,) active coordinates.
        v_a: (n,) active velocities.

    Returns:
        gamma^T J^T w (n,), and its derivatives (n, 2 n) by q_A and v_A.
    """
    memoryless = [force for force in machine.external_forces if not force.state_count]
    excluded_names = [force.name for force in machine.external_forces if force.state_count]
    if excluded_names:
        warnings.warn(
            f"{machine.name}: forces that remember their way have no linear model, left out: "
            f"{', '.join(excluded_names)}",
            CraneWarning,
            stacklevel=3,
        )
    closure, forces, n = machine.closure, ExternalForces(machine, memoryless), len(q_a)

    def active_forces(x: Array) -> Array:
        q = closure.solve(x[:n])
        gamma = closure.gamma(q)
        applied = forces.generalized_forces(0.0, q, gamma @ x[n:], np.zeros(0))
        return np.asarray(gamma.T @ applied.generalized_forces)

    x, derivatives = np.concatenate([q_a, v_a]), np.zeros((n, 2 * n))
    units = closure.units[closure.active]
    steps = _DIFFERENCE_STEP * np.concatenate([units, units / closure.characteristic_time])
    for i, h in enumerate(np.diag(steps) if memoryless else ()):
        once, twice = (active_forces(x + k * h) - active_forces(x - k * h) for k in (1, 2))
        derivatives[:, i] = (8 * once - twice) / (12 * steps[i])
    return active_forces(x), derivatives


def linearize(
    machine: Machine | str | Path,
    operating_point: Mapping[str, float] | ArrayLike | None = None,
    *,
    velocity: Mapping[str, float] | ArrayLike | None = None,
    drive: str | None = None,
    outputs: Sequence[str] | None = None,
    pressures: Mapping[str, tuple[float, float]] | None = None,
) -> LinearModel:
    """Linear model of a machine about an operating point: x' = A x + B u, y = C x + D u.

    The operating point is trimmed: forces, or pressures and valve signals, keep the velocities
    constant. Matrices are exact derivatives through the closed loops
    (`Dynamics.derivatives`), the circuit's by its formulas; those of external forces, which
    act as at time 0, by differences. Friction that sticks is that of small
    motions which have begun: at rest its viscous part alone, in motion the side that it is on.
    The integrals of a circuit, such as the pumped oil, are no states.

    Args:
        machine: The machine, or an argument of `crane.load`.
        operating_point: Active coordinates [m], [rad], by joint or (n,); home for those that are
            not named.
        velocity: Their velocities [m/s], [rad/s], likewise; at rest if not given.
        drive: "valves" or "forces"; valves if not given where the machine has any.
        outputs: Names of outputs: joints, `JOINT_velocity` of active ones, `tip_x`,
            `JOINT_force`, and channels of the circuit such as `pressure_JOINT_a`; if not given,
            the active joints, the tip, and with valves the pressures of the chambers.
        pressures: Of the chambers A and B [Pa] by joint, of which that of the loaded side is
            changed to what holds the machine; if not given, the other side is at the tank's
            pressure, where its valve would begin to let oil in: the model is that of the valve
            closed.

    Returns:
        Matrices with the names of states, inputs and outputs, the operating point, and the modes.

    Raises:
        InputError: A name is unknown, the operating point is outside of the limits, or the drive
            does not exist.
        ClosureError: The loops do not close at the operating point.
        SimulationError: The machine cannot be trimmed at the operating point.
    """
    if not isinstance(machine, Machine):
        machine = load(machine)
    if drive is not None:
        check_name(drive, ("valves", "forces"), f"drive '{drive}' is unknown")
    valves = machine.hydraulics is not None if drive is None else drive == "valves"
    if valves and machine.hydraulics is None:
        raise InputError(f"'{machine.name}' has no valves, take the drive 'forces'")
    home = machine.home[machine.closure.active]
    q_a = machine.check_limits(_values_by_joint(machine, operating_point, home, "at"), "at")
    v_a = _values_by_joint(machine, velocity, np.zeros(len(home)), "velocity")
    if machine.coordinates.is_rotation_vector[machine.closure.active].any() and v_a.any():
        raise InputError(
            "a machine with active rotation vectors is linearized at rest, leave velocities out"
        )
    dynamics = Dynamics(machine)
    q = machine.closure.solve(q_a)
    linearized_drive = LinearizedDrive(machine, dynamics, q, valves, pressures)
    external_force, external_jacobian = external_force_derivatives(machine, q_a, v_a)
    drive_states, u = find_trim(dynamics, linearized_drive, q_a, v_a, external_force)
    n, k, m = len(q_a), len(drive_states), len(u)
    values, drive_jacobian = linearized_drive.evaluate(q_a, v_a, drive_states, u)
    tau = values[:n] + external_force
    dynamics_derivatives = dynamics.derivatives("forward", q_a, v_a, tau, friction=True)
    by_tau = dynamics_derivatives["tau_a"]
    size = 2 * n + k
    a, b = np.zeros((size, size)), np.zeros((size, m))
    a[:n, n : 2 * n] = np.eye(n)
    a[n : 2 * n] = by_tau @ drive_jacobian[:n, :size]
    a[n : 2 * n, : 2 * n] += by_tau @ external_jacobian
    a[n : 2 * n, :n] += dynamics_derivatives["q_a"]
    a[n : 2 * n, n : 2 * n] += dynamics_derivatives["v_a"]
    a[2 * n :] = drive_jacobian[n : n + k, :size]
    b[n : 2 * n], b[2 * n :] = by_tau @ drive_jacobian[:n, size:], drive_jacobian[n : n + k, size:]
    gamma = machine.closure.gamma(q)
    states = {joint: machine.unit(joint) for joint in machine.active}
    states |= {f"{joint}_velocity": machine.unit(joint) + "/s" for joint in machine.active}
    c, d, y, units = _select_outputs(
        machine, linearized_drive, q, gamma, (q_a, v_a), (values, drive_jacobian), outputs
    )
    pressure_offsets = [
        linearized_drive.vapour_pressure * name.startswith("pressure_")
        for name in linearized_drive.state_units
    ]
    acceleration = dynamics.forward(q_a, v_a, tau, friction=True)
    return LinearModel(
        A=a,
        B=b,
        C=c,
        D=d,
        states=(*states, *linearized_drive.state_units),
        inputs=tuple(linearized_drive.input_units),
        outputs=tuple(units),
        units=states | linearized_drive.state_units | linearized_drive.input_units | units,
        x=np.concatenate([q_a, v_a, drive_states + pressure_offsets]),
        u=u,
        y=y,
        rate=np.concatenate([v_a, acceleration, values[n : n + k]]),
        machine=machine,
        configuration=q,
        gamma=gamma,
    )


def linear_models(
    machine: Machine | str | Path,
    vary: Mapping[str, ArrayLike],
    operating_point: Mapping[str, float] | None = None,
    *,
    drive: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[tuple[dict[str, float], LinearModel]]:
    """Linear models over configurations and parameters of a machine, at rest.

    Args:
        machine: See `linearize`.
        vary: Values by the name of an active joint or of a parameter, see
            `crane.description.parameters`; all combinations are computed.
        operating_point: Active coordinates [m], [rad] that are the same in all models.
        drive: See `linearize`.
        progress: Called with the finished share, 0 to 1.

    Returns:
        Values and model of each combination; the last name varies fastest.

    Raises:
        InputError: As `linearize`, or a name is unknown.
    """
    progress = progress_reporter(progress)
    if not isinstance(machine, Machine):
        machine = load(machine)
    values = {name: np.atleast_1d(np.asarray(x, dtype=np.float64)) for name, x in vary.items()}
    variants, found = MachineVariants(machine), []
    numbers = variants.values
    for name in values:
        if name not in machine.active and name not in numbers:
            raise InputError(
                unknown_parameter_text(variants.spec, [*numbers, *machine.active], name)
            )
    combinations = list(itertools.product(*(x.tolist() for x in values.values())))
    drift_warnings = []
    for i, row in enumerate(combinations):
        variation = dict(zip(values, row, strict=True))
        changes = {name: value for name, value in variation.items() if name not in machine.active}
        joints = {name: value for name, value in variation.items() if name in machine.active}
        variant = variants.machine(changes) if changes else machine
        with warnings.catch_warnings(record=True) as caught_warnings:
            warnings.simplefilter("always")
            found.append(
                (
                    variation,
                    linearize(variant, dict(operating_point or {}) | joints, drive=drive),
                )
            )
        drift_warnings += [str(warning.message) for warning in caught_warnings]
        progress((i + 1) / len(combinations))
    if drift_warnings:
        text = f"{len(drift_warnings)} of {len(combinations)} are {drift_warnings[0]}, the first"
        warnings.warn(text, CraneWarning, stacklevel=2)
    return found


def _select_outputs(
    machine: Machine,
    drive: LinearizedDrive,
    q: Array,
    gamma: Array,
    motion: tuple[Array, Array],
    drive_values: tuple[Array, Array],
    names: Sequence[str] | None,
) -> tuple[Array, Array, Array, dict[str, str]]:
    """C, D, y and units of outputs.

    Args:
        machine: The machine.
        drive: Its drive.
        q: (nq,) configuration.
        gamma: (nq, n) dq/dq_A.
        motion: q_A and v_A.
        drive_values: Values and derivatives of the drive, see `LinearizedDrive.evaluate`.
        names: Names of outputs, see `linearize`.

    Raises:
        InputError: An unknown name.
    """
    n, k, m = len(machine.active), len(drive.state_units), len(drive.input_units)
    size, eye = 2 * n + k, np.eye(2 * n + k + m)
    # row of C and D, value, and unit
    outputs = {
        joint: (gamma[column] @ eye[:n], q[column], machine.unit(joint))
        for column, joint in enumerate(machine.joints)
    }
    for i, joint in enumerate(machine.active):
        outputs[f"{joint}_velocity"] = (eye[n + i], motion[1][i], machine.unit(joint) + "/s")
    default_names = list(machine.active)
    if machine.tip is not None:
        kinematics = Kinematics(machine)
        rows = kinematics.jacobian(motion[0]) @ eye[:n]
        place = kinematics.position_at_configuration(q)
        tip = {f"tip_{x}": (*pair, "m") for x, *pair in zip("xyz", rows, place, strict=True)}
        outputs |= tip
        default_names += tip
    values, slopes = drive_values
    if drive.state_units:
        seen = zip(drive.output_units.items(), values[n + k :], slopes[n + k :], strict=True)
        outputs |= {name: (row, value, unit) for (name, unit), value, row in seen}
        default_names += [name for name in drive.state_units if name.startswith("pressure_")]
    else:
        inputs = zip(drive.input_units.items(), eye[size:], strict=True)
        outputs |= {name: (row, 0.0, unit) for (name, unit), row in inputs}
    names = default_names if names is None else list(names)
    for name in names:
        check_name(name, outputs, f"output '{name}' is unknown")
    matrix = np.array([outputs[name][0] for name in names]).reshape(len(names), -1)
    y = np.array([outputs[name][1] for name in names], dtype=np.float64)
    return matrix[:, :size], matrix[:, size:], y, {name: outputs[name][2] for name in names}


def _values_by_joint(
    machine: Machine, specified: Mapping[str, float] | ArrayLike | None, default: Array, label: str
) -> Array:
    """(n,) active coordinates or velocities, by joint or all of them."""
    if specified is None:
        return default.copy()
    if not isinstance(specified, Mapping):
        return as_samples(specified, len(default), label, machine.active).astype(np.float64)
    out = default.copy()
    for joint, value in specified.items():
        check_name(joint, machine.active, f"{label}: '{joint}' is no active joint")
        out[machine.active.index(joint)] = float(value)
    return out
