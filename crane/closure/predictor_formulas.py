"""Predictor of the continuation of closed configurations as symbolic formulas."""

from collections.abc import Mapping, Sequence
from functools import cached_property

from crane.closure.coordinates import Indices
from crane.closure.kinematics_formulas import (
    FormulaConstants,
    TreeGeometry,
    coordinate_rates,
    largest_scaled_value,
    wrap_rotation_vector,
)
from crane.codegen import Program, Scalar, Tape
from crane.codegen.symbolic import add_vectors, solve_linear_system, sum_scalars


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

    @cached_property
    def _active_rotations(self) -> list[tuple[range, list[int]]]:
        """Columns of each rotation vector, and the active ones of them."""
        vectors = [range(body - 1, body + 2) for body in self._geometry.rotation_bodies]
        active = set(self._active_columns.tolist())
        return [(columns, [i for i in columns if i in active]) for columns in vectors]

    @property
    def wraps_rotations(self) -> bool:
        """Whether there are passive rotation vectors, whose length solutions limit to pi."""
        return any(not part for _, part in self._active_rotations)

    @cached_property
    def has_partly_active_rotations(self) -> bool:
        """Whether some but not all components of a rotation vector are active."""
        return any(part and len(part) < len(parts) for parts, part in self._active_rotations)

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
        gamma: dict[int, dict[int, Scalar]] = {}  # by column
        for k, column in enumerate(self._active_columns):
            gamma[int(column)] = {k: 1.0}
        for i, (row, k) in enumerate(self._gamma_entry_pairs):
            column = int(self._passive_columns[row])
            gamma.setdefault(column, {})[k] = tape.load(1, self._nq + i)
        change = self._active_motion(q, gamma, change)
        motion: list[Scalar] = [0.0] * self._nq
        for column, entries in gamma.items():
            for k, entry in entries.items():
                motion[column] = motion[column] + entry * change[k]
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
            for columns, active in self._active_rotations:
                part = slice(columns.start, columns.stop)
                if not active:
                    q[part] = wrap_rotation_vector(q[part])
            program.add_formula("wrap", 1, q)

    def _active_motion(
        self,
        q: Sequence[Scalar],
        gamma: Mapping[int, Mapping[int, Scalar]],
        change: Sequence[Scalar],
    ) -> list[Scalar]:
        """Motion (n,) of the active joints along which their coordinates change.

        It differs from the change of the coordinates for parts of rotation vectors in loops.

        Args:
            q: (nq,).
            gamma: Entries by column and active joint.
            change: (n,) change of the active coordinates.
        """
        rotations = {column for _, active in self._active_rotations for column in active}
        turning = [
            k
            for k, column in enumerate(self._active_columns.tolist())
            if column in rotations and sum(k in row for row in gamma.values()) > 1
        ]
        if not turning:
            return list(change)
        rates = []
        for k in range(self._n):
            column_of_gamma = [gamma.get(i, {}).get(k, 0.0) for i in range(self._nq)]
            rates.append(coordinate_rates(self._geometry, q, column_of_gamma))
        columns = self._active_columns.tolist()
        right = []
        for j in turning:
            others = [rates[k][columns[j]] * change[k] for k in range(self._n) if k not in turning]
            right.append([change[j] - sum_scalars(others)])
        found, _ = solve_linear_system(
            [[rates[k][columns[j]] for k in turning] for j in turning], right
        )
        out = list(change)
        for k, (value,) in zip(turning, found, strict=True):
            out[k] = value
        return out

    def inverse_characteristic_length(self, tape: Tape) -> Scalar:
        """One over the characteristic length, from the geometry constants as first argument."""
        constants = self._geometry.constants
        return FormulaConstants(tape, 0, constants)[len(constants) - 1]
