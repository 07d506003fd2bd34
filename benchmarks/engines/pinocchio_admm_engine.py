"""Pinocchio's ADMM solver of constraints, in the same Runge-Kutta loop as its other algorithms."""

import numpy as np
import pinocchio as pin
from dense_equations import exact_forward
from multibody import Array, Multibody
from problem import Problem

from engines.engine import UnsupportedError
from engines.pinocchio_engine import (
    OFFSET,
    Pinocchio,
    PinocchioSimulator,
    largest_difference,
    sample_states,
)

TOLERANCE = 1e-10  # of feasibility and complementarity
MU = 1e-10  # regularization of the Delassus operator
MAX_ITERATIONS = 1000


class PinocchioAdmm(Pinocchio):
    """Accelerations with the multipliers of `ADMMConstraintSolver`, without a corrector."""

    advice = "ADMMConstraintSolver, ConstraintCholeskyDecomposition; simulation-contacts example"
    budget = 2.0

    def __init__(self) -> None:
        super().__init__("ADMM")

    def build(self, problem: Problem, setting: tuple[float, float]) -> PinocchioSimulator:
        """See `Engine.build`."""
        system = problem.system
        samples, exact = sample_states(system, 3), exact_forward(system)
        expected = [exact(*sample) for sample in samples]
        differences = []
        for points in (1, 2):
            solver = AdmmForward(system, points)
            differences.append(largest_difference(solver, samples, expected))
            if differences[-1] < 1e-6:
                return PinocchioSimulator(problem, solver, setting[0])
        raise UnsupportedError(f"accelerations differ by {min(differences):.0e}")


class AdmmForward:
    """Forward dynamics: a = M^-1 (tau - h + J' lambda), with G lambda + J a_free + drift = 0.

    Args:
        system: The system.
        points: Anchors on the axis of each loop.
    """

    def __init__(self, system: Multibody, points: int):
        self.model, self.data = system.model, system.model.createData()
        self._ends = []
        for loop in system.loops:
            axis = np.zeros(3) if loop.axis is None else loop.axis
            for offset in np.arange(1 if loop.axis is None else points) * OFFSET:
                shift = pin.SE3(np.eye(3), offset * axis)
                ends = [(mount.body + 1, pin.SE3(mount.placement) * shift)
                        for mount in (loop.predecessor, loop.successor)]  # fmt: skip
                self._ends.append(ends)
        self._models = pin.StdVec_ConstraintModel()
        self._datas = pin.StdVec_ConstraintData()
        for (joint1, placement1), (joint2, placement2) in self._ends:
            anchor = pin.PointAnchorConstraintModel(
                self.model, joint1, placement1, joint2, placement2
            )
            self._models.append(pin.ConstraintModel(anchor))
        for model in self._models:
            self._datas.append(model.createData())
        self._cholesky = pin.ConstraintCholeskyDecomposition(
            self.model, self.data, self._models, self._datas
        )
        self._solver = pin.ADMMConstraintSolver(3 * len(self._ends))
        self._result = pin.ADMMSolverResult()
        self._settings = pin.ADMMSolverSettings()
        self._settings.max_iterations = MAX_ITERATIONS
        self._settings.absolute_feasibility_tol = TOLERANCE
        self._settings.absolute_complementarity_tol = TOLERANCE
        self._settings.relative_feasibility_tol = 0.01 * TOLERANCE
        self._settings.relative_complementarity_tol = 0.01 * TOLERANCE

    def __call__(self, q: Array, v: Array, tau: Array) -> Array:
        """Accelerations (n,) of all joints, of a closed configuration."""
        model, data = self.model, self.data
        free = pin.aba(model, data, q, v, tau).copy()
        pin.forwardKinematics(model, data, q, v, free)
        gaps = np.concatenate([self._gap(*ends) for ends in self._ends])
        pin.crba(model, data, q, pin.Convention.WORLD)
        pin.computeJointJacobians(model, data, q)
        for one, other in zip(self._models, self._datas, strict=True):
            one.calc(model, data, other)
        self._cholesky.compute(model, data, self._models, self._datas, MU)
        self._solver.solve(
            self._cholesky.getDelassusOperatorCholeskyExpression(), gaps, self._models,
            self._datas, self._settings, self._result,
        )  # fmt: skip
        jacobian = pin.getConstraintsJacobian(model, data, self._models, self._datas)
        forces = jacobian.T @ self._result.retrieveConstraintImpulses()
        return pin.aba(model, data, q, v, tau + forces)

    def _gap(self, one: tuple[int, pin.SE3], two: tuple[int, pin.SE3]) -> Array:
        """Acceleration (3,) of the second anchor relative to the first, in its frame."""
        accelerations = [
            pin.getFrameClassicalAcceleration(
                self.model, self.data, joint, placement, pin.LOCAL_WORLD_ALIGNED
            ).linear
            for joint, placement in (one, two)
        ]
        turn = self.data.oMi[one[0]].rotation @ one[1].rotation
        return turn.T @ (accelerations[1] - accelerations[0])
