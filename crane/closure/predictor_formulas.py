"""Predictor of the continuation of closed configurations as symbolic formulas."""

from collections.abc import Sequence

from crane.closure.coordinates import Indices
from crane.closure.kinematics_formulas import (
    FormulaConstants,
    TreeGeometry,
    Vector,
    adjust_motion,
    coordinate_rates,
    largest_scaled_value,
    wrap_rotation_vector,
)
from crane.codegen import Program, Scalar, Tape
from crane.codegen.symbolic import add_vectors, matvec, transpose


class PredictorFormulas:
    """The next configuration along gamma.

    Args:
        geometry: Geometry of the machine.
        active: Columns of the active joints.
        passive: Columns of the other joints.
        gamma_entries: Rows (passive joints) and columns of the nonzero entries of gamma.
    """

    def __init__(
        self,
        geometry: TreeGeometry,
        active: Indices,
        passive: Indices,
        gamma_entries: Sequence[tuple[int, int]],
    ):
        self._geometry, self._gamma_entry_pairs = geometry, gamma_entries
        self._active_columns, self._passive_columns = active, passive
        self._nq, self._n = len(geometry.parents) - 1, len(active)

    @property
    def wraps_rotations(self) -> bool:
        """Whether there are passive rotation vectors, whose length solutions limit to pi."""
        return bool(self._passive_rotations)

    @property
    def _passive_rotations(self) -> list[slice]:
        """Columns of each passive rotation vector."""
        active = set(self._active_columns.tolist())
        first = (body - 1 for body in self._geometry.rotation_bodies)
        return [slice(i, i + 3) for i in first if active.isdisjoint(range(i, i + 3))]

    def gamma_rows(self, entries: Sequence[Scalar]) -> list[Vector]:
        """Gamma (nq, n) from its nonzero entries."""
        rows: list[Vector] = [[0.0] * self._n for _ in range(self._nq)]
        for k, column in enumerate(self._active_columns):
            rows[column][k] = 1.0
        for (row, k), entry in zip(self._gamma_entry_pairs, entries, strict=True):
            rows[self._passive_columns[row]][k] = entry
        return rows

    def add_to(self, program: Program) -> None:
        """Add `predict`, `distance` and, with passive rotation vectors, `wrap`.

        predict(constants, cursor, target) -> q, largest scaled step of a passive joint;
        distance(constants, q, q') -> largest scaled difference of a passive joint;
        wrap(q) -> q with passive rotation vectors of length pi or less.
        """
        is_translation = [
            not self._geometry.is_revolute[column + 1] for column in self._passive_columns
        ]
        tape = Tape()
        q, n = tape.load_vector(1, 0, self._nq), self._n
        target = tape.load_vector(2, 0, n)
        change = [target[k] - q[column] for k, column in enumerate(self._active_columns)]
        gamma = self.gamma_rows(tape.load_vector(1, self._nq, len(self._gamma_entry_pairs)))
        motion = matvec(gamma, change)
        turning = self._turning_joints(gamma)
        if turning:
            columns = transpose(gamma)
            steps = {self._active_columns[k] + 1: change[k] for k in turning}
            motion = adjust_motion(self._geometry, q, motion, [columns[k] for k in turning], steps)
        moves = [motion[column] for column in self._passive_columns]
        q = add_vectors(q, coordinate_rates(self._geometry, q, motion))
        for column, value in zip(self._active_columns, target, strict=True):
            q[column] = value
        move = largest_scaled_value(
            moves, is_translation, self.inverse_characteristic_length(tape)
        )
        program.add_formula("predict", 3, {"q": q, "move": [move]})
        tape = Tape()
        one, two = tape.load_vector(1, 0, self._nq), tape.load_vector(2, 0, self._nq)
        differences = [one[i] - two[i] for i in self._passive_columns]
        program.add_formula(
            "distance",
            3,
            [
                largest_scaled_value(
                    differences, is_translation, self.inverse_characteristic_length(tape)
                )
            ],
        )
        if self.wraps_rotations:
            q = Tape().load_vector(0, 0, self._nq)
            for part in self._passive_rotations:
                q[part] = wrap_rotation_vector(q[part])
            program.add_formula("wrap", 1, q)

    def _turning_joints(self, gamma: Sequence[Vector]) -> list[int]:
        """Indices of active joints in rotation vectors that move other joints as well."""
        turned = {i for body in self._geometry.rotation_bodies for i in range(body - 1, body + 2)}
        moved = [sum(entry != 0.0 for entry in column) for column in zip(*gamma, strict=True)]
        columns = enumerate(self._active_columns.tolist())
        return [k for k, column in columns if column in turned and moved[k] > 1]

    def inverse_characteristic_length(self, tape: Tape) -> Scalar:
        """One over the characteristic length, from the geometry constants as first argument."""
        constants = self._geometry.constants
        return FormulaConstants(tape, 0, constants)[len(constants) - 1]
