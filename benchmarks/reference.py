"""Reference solutions, by two independent ways of which both have to agree."""

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from dense_equations import KinematicRows, SpringForces, exact_forward
from engines.crane_engine import CraneSimulator
from multibody import Array
from problem import Problem
from scipy.integrate import quad, solve_ivp

TOLERANCE = 1e-13


def independent_positions(problem: Problem) -> tuple[Array, float]:
    """Centres of mass (k, n, 3) by scipy's DOP853, without crane's equations; and their error [m].

    The error is that against the conserved energy, of the closed form of a motion that does not
    turn back; NaN of others.

    On the dense equations with multipliers or, where branches cross and these are singular, in the
    one coordinate of a closed form.
    """
    curve = CLOSED_FORMS.get(problem.name.rstrip("0123456789"))
    motion = DenseMotion(problem) if curve is None else CurveMotion(problem, curve)
    state, found, error = motion.start, [], np.nan
    for begin, end in zip(problem.times[:-1], problem.times[1:], strict=True):
        run = solve_ivp(motion.rate, (begin, end), state, "DOP853", rtol=TOLERANCE, atol=TOLERANCE)
        if not run.success:
            raise RuntimeError(f"{problem.name}: {run.message}")
        if isinstance(motion, CurveMotion) and run.y[1].min() > 0:
            gap = abs(motion.time_by_energy(state, run.y[:, -1]) - (end - begin))
            error = np.nanmax(
                [error, gap * run.y[1].max() * np.ptp(problem.system.start.position)]
            )
        state = motion.corrected(run.y[:, -1])
        found.append(problem.system.state(*motion.tree(state)).position)
    return np.array(found), error


class DenseMotion:
    """Motion of all tree coordinates under the dense equations with multipliers."""

    def __init__(self, problem: Problem):
        self._system, self._n = problem.system, problem.system.model.nv
        self._forward, self._rows = exact_forward(self._system), KinematicRows(self._system)
        self._forces = SpringForces(self._system)
        self.start = np.concatenate([self._system.q, self._system.v])

    def tree(self, state: Array) -> tuple[Array, Array]:
        """Coordinates and velocities of the tree."""
        return state[: self._n], state[self._n :]

    def rate(self, _: float, state: Array) -> Array:
        """Derivative of the state by time."""
        q, v = self.tree(state)
        tau = self._system.joint_forces(q, v) + self._forces(q, v)
        return np.concatenate([v, self._forward(q, v, tau)])

    def corrected(self, state: Array) -> Array:
        """The state on the loops."""
        return np.concatenate(self._rows.project(*self.tree(state)))


Curve = Callable[[float, list[str]], tuple[Array, Array, Array]]


def n_four_bar_curve(angle: float, joints: list[str]) -> tuple[Array, Array, Array]:
    """q, dq/da, d2q/da2: rods at angle a, the bars between them level."""
    slope = np.array([1.0 if name.startswith("r") else -1.0 for name in joints])
    return slope * angle, slope, np.zeros(len(joints))


def slider_crank_curve(angle: float, joints: list[str]) -> tuple[Array, Array, Array]:
    """q, dq/da, d2q/da2: an isosceles triangle of crank and rod, of 1 m each."""
    sine, cosine = np.sin(angle), np.cos(angle)
    return (
        np.array([angle, -2.0 * angle, 2.0 * cosine]),
        np.array([1.0, -2.0, -2.0 * sine]),
        np.array([0.0, 0.0, -2.0 * cosine]),
    )


CLOSED_FORMS: dict[str, Curve] = {
    "n_four_bar_": n_four_bar_curve,
    "slider_crank": slider_crank_curve,
}


class CurveMotion:
    """Motion along a curve q(a): q'^T (M (q' a'' + q'' a'^2) + h) = q'^T tau."""

    def __init__(self, problem: Problem, curve: Curve):
        self._system, self._curve = problem.system, curve
        self._model = problem.system.model
        self._data = self._model.createData()
        self._joints = [body.name for body in problem.system.bodies]
        angle = problem.system.q[0]
        q, slope, _ = curve(angle, self._joints)
        if np.abs(q - problem.system.q).max() > 1e-12:
            raise ValueError(f"{problem.name} does not start on its closed form")
        self.start = np.array([angle, problem.system.v[0] / slope[0]])

    def tree(self, state: Array) -> tuple[Array, Array]:
        """Coordinates and velocities of the tree."""
        q, slope, _ = self._curve(state[0], self._joints)
        return q, slope * state[1]

    def rate(self, _: float, state: Array) -> Array:
        """Derivative of the state by time."""
        model, data = self._model, self._data
        q, slope, curvature = self._curve(state[0], self._joints)
        v = slope * state[1]
        force = pin.rnea(model, data, q, v, curvature * state[1] ** 2).copy()
        right = slope @ (self._system.joint_forces(q, v) - force)
        inertia = slope @ pin.rnea(model, data, q, 0 * v, slope)
        inertia -= slope @ pin.rnea(model, data, q, 0 * v, 0 * v)
        return np.array([state[1], right / inertia])

    def corrected(self, state: Array) -> Array:
        """The state itself: it has no error of the loops."""
        return state

    def time_by_energy(self, start: Array, end: Array) -> float:
        """Time from one state to a later one by a quadrature of the conserved energy [s].

        dt = da / sqrt(2 (E - V) / M), for motions that do not turn back.
        """
        model, data = self._model, self._data

        def inertia_and_potential(angle: float) -> tuple[float, float]:
            q, slope, _ = self._curve(angle, self._joints)
            kinetic = pin.computeKineticEnergy(model, data, q, slope)
            return 2.0 * kinetic, pin.computePotentialEnergy(model, data, q)

        inertia, potential = inertia_and_potential(self.start[0])
        energy = 0.5 * inertia * self.start[1] ** 2 + potential

        def slowness(angle: float) -> float:
            inertia, potential = inertia_and_potential(angle)
            return float(np.sqrt(inertia / (2.0 * (energy - potential))))

        return quad(slowness, start[0], end[0], epsabs=1e-13, epsrel=1e-13, limit=500)[0]


def crane_positions(problem: Problem, tolerance: float = TOLERANCE) -> Array:
    """Centres of mass (k, n, 3) by crane's DOP853."""
    simulator = CraneSimulator(problem, "DOP853", tolerance)
    return np.array([state.position for state in simulator.states(simulator.run())])


def write_reference(problem: Problem) -> float:
    """Compute a reference both ways and write the independent one; their difference [m]."""
    (own, error), ours = independent_positions(problem), crane_positions(problem)
    difference = float(np.linalg.norm(own - ours, axis=-1).max())
    is_curve = problem.name.rstrip("0123456789") in CLOSED_FORMS
    kind = "a closed form" if is_curve else "dense equations with multipliers"
    head = (
        f"{problem.title}: centres of mass x, y, z of all bodies [m] at the ends of "
        f"{len(own)} equal parts of {problem.duration:g} s\n"
        f"by scipy's DOP853 on {kind}, tolerance "
        f"{TOLERANCE:g}; crane's DOP853 differs by {difference:.1e} m"
        + (f", a quadrature of the energy by {error:.1e} m" if np.isfinite(error) else "")
    )
    problem.reference_path.parent.mkdir(exist_ok=True)
    np.savetxt(
        problem.reference_path, own.reshape(len(own), -1), delimiter=",", header=head,
        fmt="%.16g",
    )  # fmt: skip
    return float(np.nanmin([difference, error]))
