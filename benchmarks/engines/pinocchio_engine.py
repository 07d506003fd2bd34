"""Pinocchio's forward dynamics with loops, in a Runge-Kutta loop in Python."""

import contextlib
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin
from dense_equations import SpringForces, exact_forward
from multibody import Array, Loop, Multibody
from problem import Problem

import crane
from engines.engine import Engine, TreeSimulator, UnsupportedError

SETTINGS = [(k, mu) for k in (1, 2, 3, 5, 10) for mu in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)]
MAX_DIFFERENCE = 1e-9  # of accelerations, relative: fewest iterations that reach it are used
CORRECTIONS = (0.0, 0.02, 0.2)  # frequency of the corrector times the step
OFFSET = 0.3  # between the two points of a revolute loop in space [m]
Solver = Callable[[Array, Array, Array], Array]


class PinocchioForward:
    """Forward dynamics with loops by an algorithm of Pinocchio.

    Args:
        system: The system.
        algorithm: "constraintDynamics" or "lcaba".
        points: Points of contact on the axis of each loop.
        iterations: Most proximal iterations.
        mu: Proximal parameter.
        correction: Frequency of the corrector of the loops, critically damped [rad/s].
    """

    def __init__(
        self,
        system: Multibody,
        algorithm: str,
        points: int,
        iterations: int,
        mu: float,
        correction: float = 0.0,
    ):
        self.model, self.data = system.model, system.model.createData()
        self.parameters = {"points": points, "iterations": iterations, "mu": mu}
        self._correction = correction
        self._models = pin.StdVec_RigidConstraintModel()
        self._datas = pin.StdVec_RigidConstraintData()
        for loop in system.loops:
            for offset in np.arange(1 if loop.axis is None else points) * OFFSET:
                self._models.append(self._constraint(loop, offset))
        for constraint in self._models:
            self._datas.append(constraint.createData())
        if algorithm == "lcaba":
            pin.computeJointMinimalOrdering(self.model, self.data, self._models)
        else:
            pin.initConstraintDynamics(self.model, self.data, self._models, self._datas)
        self._function = getattr(pin, algorithm)
        self._settings = pin.ProximalSettings(1e-12, mu, iterations)

    def _constraint(self, loop: Loop, offset: float) -> pin.RigidConstraintModel:
        axis = np.zeros(3) if loop.axis is None else loop.axis
        shift = pin.SE3(np.eye(3), offset * axis)
        ends = [(mount.body + 1, pin.SE3(mount.placement) * shift)
                for mount in (loop.predecessor, loop.successor)]  # fmt: skip
        (joint1, placement1), (joint2, placement2) = ends
        constraint = pin.RigidConstraintModel(
            pin.ContactType.CONTACT_3D, self.model, joint1, placement1, joint2, placement2,
            pin.LOCAL,
        )  # fmt: skip
        constraint.m_baumgarte_parameters.Kp = self._correction**2
        constraint.m_baumgarte_parameters.Kd = 2 * self._correction
        return constraint

    def __call__(self, q: Array, v: Array, tau: Array) -> Array:
        """Accelerations (n,) of all joints."""
        return self._function(
            self.model, self.data, q, v, tau, self._models, self._datas, self._settings
        )


def sample_states(system: Multibody, count: int) -> list[tuple[Array, Array, Array]]:
    """Closed states about the start, and random forces on all joints: (q, v, tau) each (n,)."""
    closure, random = system.machine.closure, np.random.default_rng(1)
    active = closure.active
    n = len(active)
    rate, phase = random.uniform(0.5, 1.5, n), random.uniform(0, 2 * np.pi, n)
    turn = 0.01 * np.arange(count)[:, None] * rate + phase
    reach = min(0.1, max(len(system.loops), 1) / system.model.nv)
    path = closure.units[active] * (np.sin(turn) - np.sin(phase))
    while True:
        with contextlib.suppress(crane.CraneError):
            configurations = closure.solve(system.q[active] + reach * path)
            break
        reach /= 2  # where the loops cannot be closed on all of it
    tau = np.zeros((count, system.model.nv))
    tau[:, active] = 10 * random.normal(size=(count, n))
    v_a = reach * closure.units[active] * rate * np.cos(turn)
    return [
        (q, closure.gamma(q) @ rate, force)
        for q, rate, force in zip(configurations, v_a, tau, strict=True)
    ]


def best_forward(
    system: Multibody,
    algorithm: str,
    samples: Sequence[tuple[Array, Array, Array]],
    expected: Sequence[Array],
) -> tuple[PinocchioForward, dict[str, float]]:
    """The algorithm with the fewest iterations that agrees, or else what differs least.

    Loops in a plane take one point; others two on the axis.
    """
    best: tuple[float, PinocchioForward, dict[str, float]] | None = None
    for points in (1, 2):
        for iterations, mu in SETTINGS:
            solver = PinocchioForward(system, algorithm, points, iterations, mu)
            difference = largest_difference(solver, samples, expected)
            if best is None or not difference >= best[0]:
                told = {"difference": difference, "iterations": iterations, "mu": mu,
                        "points": points}  # fmt: skip
                best = difference, solver, told
            if difference < MAX_DIFFERENCE:
                return solver, told
    assert best is not None
    return best[1:]


def largest_difference(
    solver: Solver,
    samples: Sequence[tuple[Array, Array, Array]],
    expected: Sequence[Array],
) -> float:
    """Largest relative difference of the accelerations of a solver."""
    return max(
        float(np.abs(solver(*sample) - a).max() / np.abs(a).max())
        for sample, a in zip(samples, expected, strict=True)
    )


class Pinocchio(Engine):
    """A Runge-Kutta loop of order 4 in Python; Pinocchio's corrector keeps the loops closed.

    LCABA has no corrector.

    Args:
        algorithm: "constraintDynamics" or "lcaba".
    """

    package, module = "pin", "pinocchio"
    advice = "examples/simulation-closed-kinematic-chains.py of Pinocchio"

    def __init__(self, algorithm: str):
        self.name, self._algorithm = f"pin.{algorithm}", algorithm

    def settings(self, problem: Problem) -> Sequence[tuple[float, float]]:
        """Step [s], frequency of the corrector times the step."""
        corrections = CORRECTIONS if self._algorithm == "constraintDynamics" else (0.0,)
        return [(step, share) for step in problem.steps for share in corrections]

    def build(self, problem: Problem, setting: tuple[float, float]) -> "PinocchioSimulator":
        """See `Engine.build`."""
        step, share = setting
        system = problem.system
        samples = sample_states(system, 3)
        exact = exact_forward(system)
        solver, told = best_forward(
            system, self._algorithm, samples, [exact(*sample) for sample in samples]
        )
        if told["difference"] > 1e-6:
            raise UnsupportedError(f"accelerations differ by {told['difference']:.0e}")
        solver = PinocchioForward(
            system, self._algorithm, correction=share / step, **solver.parameters
        )
        return PinocchioSimulator(problem, solver, step)


class PinocchioSimulator(TreeSimulator):
    """Runge-Kutta steps of one length."""

    def __init__(self, problem: Problem, solver: Solver, step: float):
        super().__init__(problem.system)
        self._solver, self._step = solver, step
        self._count = round(float(problem.times[1]) / step)
        self._outputs = len(problem.times) - 1
        self._forces = self.system.joint_force_parameters
        self._springs = SpringForces(self.system) if self.system.springs else None

    def single_call(self) -> Callable[[], Array]:
        """Accelerations of all joints of a closed configuration."""
        q, v = self.system.q, self.system.v
        return lambda: self._acceleration(q, v)

    def run(self) -> list[tuple[Array, Array]]:
        """See `Simulator.run`."""
        q, v, found = self.system.q.copy(), self.system.v.copy(), []
        for _ in range(self._outputs):
            for _ in range(self._count):
                q, v = self._advance(q, v)
            if not np.isfinite(q).all():
                break
            found.append((q, v))
        return found

    def _acceleration(self, q: Array, v: Array) -> Array:
        stiffness, rest, damping, force = self._forces
        tau = stiffness * (rest - q) - damping * v + force
        if self._springs is not None:
            tau += self._springs(q, v)
        return self._solver(q, v, tau).copy()

    def _advance(self, q: Array, v: Array) -> tuple[Array, Array]:
        h = self._step
        a1 = self._acceleration(q, v)
        v2 = v + h / 2 * a1
        a2 = self._acceleration(q + h / 2 * v, v2)
        v3 = v + h / 2 * a2
        a3 = self._acceleration(q + h / 2 * v2, v3)
        v4 = v + h * a3
        a4 = self._acceleration(q + h * v3, v4)
        q = q + h / 6 * (v + 2 * (v2 + v3) + v4)
        return q, v + h / 6 * (a1 + 2 * (a2 + a3) + a4)
