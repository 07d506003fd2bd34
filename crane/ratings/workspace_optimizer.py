"""Largest values of what depends on the posture, sought from many postures."""

from collections.abc import Sequence

import numpy as np

from crane.common.samples import Array
from crane.motion.kinematics import Kinematics
from crane.motion.workspaces import Workspace
from crane.motion.workspaces.workspace_extremes import (
    Objective,
    ObjectiveConstraint,
    maximize_on_branch,
)

_START_COUNT = 3  # postures that an optimum is sought from
_MIN_START_DISTANCE = 0.05  # share of their strokes by which these differ
_CONSTRAINT_WEIGHT = 10.0  # of what a start misses of a demand, against the goal
_MIN_IMPROVEMENT = 1e-9  # share of the machine's size by which a later optimum has to be better


class WorkspaceOptimizer:
    """Optima over a workspace's postures.

    The best of its postures, as far as they meet what is demanded, are improved by `farthest`.

    Args:
        workspace: The workspace.
    """

    def __init__(self, workspace: Workspace):
        self.workspace, self.machine = workspace, workspace.machine
        self.strokes = [workspace.machine.active.index(joint) for joint in workspace.strokes]
        self.characteristic_length = workspace.machine.closure.characteristic_length
        self.q = np.concatenate(
            [patch.configurations[patch.is_closed] for patch in workspace.patches]
        )
        self._stroke_lengths = np.where(
            workspace.upper > workspace.lower, workspace.upper - workspace.lower, 1.0
        )

    def maximize(
        self,
        objective: Objective,
        objective_values: Array,
        constraints: Sequence[ObjectiveConstraint] = (),
        constraint_violation: Array | None = None,
    ) -> tuple[float, Array] | None:
        """The largest value of a goal.

        Args:
            objective: See `farthest`.
            objective_values: (N,) its value at all of `configurations`.
            constraints: What else has to hold; lengths in shares of the machine's size.
            constraint_violation: (N,) by how much all of `configurations` miss it, 0 where it
                holds.

        Returns:
            The value and its posture (nq,); None where no start leads to what is demanded.
        """
        score = (
            objective_values
            if constraint_violation is None
            else objective_values
            - _CONSTRAINT_WEIGHT * self.characteristic_length * constraint_violation
        )
        best_optimum: tuple[float, Array] | None = None
        limits = (self.workspace.lower, self.workspace.upper)
        for configurations in self._select_starts(score):
            value, configuration = maximize_on_branch(
                self.machine, configurations, self.strokes, limits, objective, constraints
            )
            margin = _MIN_IMPROVEMENT * self.characteristic_length
            if np.isfinite(value) and (best_optimum is None or value > best_optimum[0] + margin):
                best_optimum = value, configuration
        return best_optimum

    def _select_starts(self, score: Array) -> list[Array]:
        """The best postures that are not beside each other."""
        columns = self.machine.closure.active[self.strokes]
        out: list[Array] = []
        for k in np.argsort(-score, kind="stable"):
            q = self.q[k]
            distances = [
                np.abs((q - x)[columns] / self._stroke_lengths[self.strokes]).max() for x in out
            ]
            if not distances or min(distances) > _MIN_START_DISTANCE:
                out.append(q)
            if len(out) == _START_COUNT:
                break
        return out


class FrameSectionCoordinates:
    """Coordinates (u, w) of a frame in a workspace's section, with their slopes.

    Args:
        workspace: The workspace.
        frame: A link.
    """

    def __init__(self, workspace: Workspace, frame: str):
        self._section, self._kinematics = workspace.section, Kinematics(workspace.machine, frame)

    def coordinates(self, q: Array) -> Array:
        """(N, 2) at postures (N, nq)."""
        return self._section.coordinates(self._kinematics.positions_at_configurations(q))

    def coordinate_objective(
        self, axis: int, sign: float = 1.0, offset: float = 0.0, scale: float = 1.0
    ) -> Objective:
        """The goal sign (coordinate - less) / size, of the first or second coordinate."""

        def evaluate(q: Array) -> tuple[float, Array]:
            position = self._kinematics.position_at_configuration(q)[None]
            section_jacobian = self._section.section_jacobian(
                position, self._kinematics.tree_jacobian(q)[None]
            )
            coordinate = float(self._section.coordinates(position)[0, axis])
            return sign * (coordinate - offset) / scale, sign * section_jacobian[0, axis] / scale

        return evaluate


def objective_difference(first: Objective, second: Objective) -> Objective:
    """The first goal less the second."""

    def evaluate(q: Array) -> tuple[float, Array]:
        (a, first_gradient), (b, second_gradient) = first(q), second(q)
        return a - b, first_gradient - second_gradient

    return evaluate
