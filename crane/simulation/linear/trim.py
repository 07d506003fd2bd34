"""Trim: forces, or pressures and valve signals, that keep a machine in steady motion."""

import itertools
import warnings

import numpy as np

from crane.common.errors import CraneWarning, SimulationError
from crane.common.samples import Array
from crane.dynamics.dynamics import Dynamics
from crane.recordings.recording import FORCE_UNITS
from crane.simulation.linear.linear_drive import LinearizedDrive

_RESIDUAL_TOLERANCE = 1e-9  # residual [coordinate units per characteristic time^2]
_FREE_JOINT_TOLERANCE = 1e-6  # the same for free joints in equilibrium
_MAX_ITERATIONS = 50  # of Newton's method
_MIN_STEP_SHARE = 1e-3  # least share of a damped step
_PRESSURE_SCALE, _LENGTH_SCALE = 1e5, 1e-3  # [Pa], [m]
_VOLUME_SCALE, _TIME_SCALE = 1e-6, 0.1  # [m3], [s]


def find_trim(
    dynamics: Dynamics, drive: LinearizedDrive, q_a: Array, v_a: Array, external_forces: Array
) -> tuple[Array, Array]:
    """States and inputs of the drive at which velocities and states are constant.

    Args:
        dynamics: Dynamics of the machine.
        drive: The drive.
        q_a: (n,) active coordinates.
        v_a: (n,) active velocities.
        external_forces: (n,) external forces along the active joints.

    Raises:
        SimulationError: There are none.
    """
    machine = dynamics.machine
    forces = (
        dynamics.inverse(q_a, v_a, np.zeros(len(q_a)))
        + dynamics.friction(q_a, v_a)
        - external_forces
    )
    if machine.free:  # they keep their velocities while the drives exert their forces
        closure, drive_forces = machine.closure, np.where(machine.is_driven, forces, 0.0)
        units = closure.units[closure.active] / closure.characteristic_time**2
        a_a = dynamics.forward(q_a, v_a, drive_forces + external_forces, friction=True)
        if np.abs(a_a / units).max() > _FREE_JOINT_TOLERANCE:
            worst = int(np.argmax(np.abs(forces - drive_forces)))
            joint = machine.active[worst]
            raise SimulationError(
                f"free joint '{joint}' does not stay there, {forces[worst]:.3g} "
                f"{FORCE_UNITS[machine.unit(joint)]} would have to hold it: linearize where it "
                "hangs still"
            )
    if not drive.state_units:
        return drive.initial_states, forces[machine.is_driven]
    for shared in (True, False) if not v_a.any() else (True,):
        trim = _trim_valves(_TrimEquations(dynamics, drive, q_a, v_a, external_forces, shared))
        if trim is not None:
            return trim
    raise SimulationError(
        "the machine cannot be trimmed there: no pressures and signals keep these velocities"
    )


class _TrimEquations:
    """Equations of the trim of a machine with valves, for its states and signals z.

    The valves of joints at rest are closed: the pressure of the loaded chamber holds the machine,
    leakage is neglected, and series springs carry the forces of their cylinders. All other states
    have to be constant, those of cylinders with underlapped valves too.

    Args:
        dynamics: Dynamics of the machine.
        drive: The circuit.
        q_a: (n,) active coordinates.
        v_a: (n,) active velocities.
        external_forces: See `find_trim`.
        include_shared: Whether the states of pumps and lines also have to be constant.

    Attributes:
        start: (k + m,) initial guess with closed valves.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        drive: LinearizedDrive,
        q_a: Array,
        v_a: Array,
        external_forces: Array,
        include_shared: bool = True,
    ):
        self._dynamics, self.drive, self.q_a, self.v_a = dynamics, drive, q_a, v_a
        self._external_forces = external_forces
        closure = dynamics.machine.closure
        n, k = len(q_a), len(drive.state_units)
        pressure = np.array([unit == "Pa" for unit in drive.state_units.values()])
        spring = np.array([name.startswith("spring_") for name in drive.state_units])
        volume = np.array([unit == "m3" for unit in drive.state_units.values()])
        scales = np.select(
            [pressure, spring, volume], [_PRESSURE_SCALE, _LENGTH_SCALE, _VOLUME_SCALE], 1.0
        )
        moving = drive.moving_mask(v_a, include_shared)
        loaded = drive.load_bearing_mask(dynamics.inverse(q_a, v_a, np.zeros(n)) - external_forces)
        self._free_indices = np.flatnonzero(
            np.concatenate([loaded | spring | moving[:k], moving[k:]])
        )
        self._equation_rows = np.concatenate(
            [np.arange(n), n + np.flatnonzero(spring | moving[:k])]
        )
        self._variable_scales = np.concatenate([scales, np.ones(len(drive.initial_inputs))])
        # a bar within a tenth of a second counts as much as such accelerations
        accelerations = closure.units[closure.active] / closure.characteristic_time**2
        self._equation_scales = np.concatenate([accelerations, scales / _TIME_SCALE])[
            self._equation_rows
        ]
        self.start = np.concatenate([drive.initial_states, drive.initial_inputs])

    def residual(self, z: Array) -> tuple[Array, Array]:
        """Accelerations and rates in their units, and their derivatives by z."""
        drive, n, k = self.drive, len(self.q_a), len(self.drive.state_units)
        values, drive_jacobian = drive.evaluate(self.q_a, self.v_a, z[:k], z[k:])
        state = self.q_a, self.v_a, values[:n] + self._external_forces
        a_a = self._dynamics.forward(*state, friction=True)
        found = self._dynamics.derivatives("forward", *state, friction=True, by=["tau_a"])
        variable_derivatives = drive_jacobian[:, 2 * n :]
        rows = np.vstack(
            [found["tau_a"] @ variable_derivatives[:n], variable_derivatives[n : n + k]]
        )
        left = np.concatenate([a_a, values[n : n + k]])
        return left[self._equation_rows] / self._equation_scales, rows[
            self._equation_rows
        ] / self._equation_scales[:, None]

    def solve_newton(self, z: Array, damped: bool = False) -> Array | None:
        """The solution z by Newton's method; None if it does not converge.

        Args:
            z: Initial guess.
            damped: Whether steps are halved until the residual decreases. The flow of a throttle,
                root(x), has its zero at half of a Newton step, which else oscillates.
        """
        z, free = z.copy(), self._free_indices
        for _ in range(_MAX_ITERATIONS):
            residual, jacobian = self.residual(z)
            if np.abs(residual).max() < _RESIDUAL_TOLERANCE:
                return z
            step = np.linalg.lstsq(
                (jacobian * self._variable_scales)[:, free], residual, rcond=1e-10
            )[0]
            if not np.isfinite(step).all():
                return None
            direction = np.zeros(len(z))
            direction[free] = step * self._variable_scales[free]
            share, size = 1.0, np.linalg.norm(residual)
            while (
                damped
                and share > _MIN_STEP_SHARE
                and not np.linalg.norm(self.residual(z - share * direction)[0]) < size
            ):
                share *= 0.5
            z -= share * direction
        return None

    def search_from_opening(self, share: float) -> Array:
        """The best z from valves that are open by a share of their stroke, and stay open."""
        from scipy.optimize import least_squares

        z, directions, lower, upper = self.drive.opened_valves(self.v_a, share)

        def residual(x: Array) -> Array:
            return self.residual(z + directions @ x)[0]

        def derivatives(x: Array) -> Array:
            return self.residual(z + directions @ x)[1] @ directions

        scales = 1.0 / (np.abs(directions) / self._variable_scales[:, None]).max(axis=0)
        solution = least_squares(
            residual, np.zeros(len(lower)), derivatives, (lower, upper), x_scale=scales
        )
        return z + directions @ solution.x


def _trim_valves(trim: _TrimEquations) -> tuple[Array, Array] | None:
    drive, k = trim.drive, len(trim.drive.state_units)
    starts = (
        (trim.search_from_opening(share) for share in (0.2, 0.5, 0.8)) if trim.v_a.any() else ()
    )
    trimmed_values = next(
        (
            z
            for start in itertools.chain(starts, [trim.start])
            for damped in (False, True)
            if (z := trim.solve_newton(start, damped)) is not None
        ),
        None,
    )
    if trimmed_values is None:
        return None
    states, inputs = trimmed_values[:k], trimmed_values[k:]
    values, _ = drive.evaluate(trim.q_a, trim.v_a, states, inputs)
    rates = np.abs(values[len(trim.q_a) : len(trim.q_a) + k])
    worst = int(np.argmax(np.where(rates > 1e-3 * drive.scales, rates / drive.scales, 0.0)))
    if rates[worst] > _PRESSURE_SCALE * _RESIDUAL_TOLERANCE:
        name, unit = list(drive.state_units.items())[worst]
        warnings.warn(
            f"linearized where it does not stay: {name} changes by {rates[worst]:.3g} {unit}/s "
            "with closed valves, through leakage or relief valves",
            CraneWarning,
            stacklevel=4,
        )
    return states, inputs
