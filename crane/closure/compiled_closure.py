"""Machine code that closes the loops of one machine by Newton's method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple
from weakref import WeakValueDictionary

import numpy as np

from crane.closure.closure_routines import add_closure_routines
from crane.closure.constraint_structure import ConstraintStructure
from crane.closure.continuation_diagnosis import ClosedConfiguration
from crane.closure.coordinates import Indices
from crane.closure.kinematics_formulas import (
    FormulaConstants,
    PositionKinematics,
    folding_pattern,
    largest_scaled_value,
    tree_geometry,
)
from crane.closure.loop_equations import Cluster, LoopEquations, find_clusters
from crane.closure.loop_formulas import LoopFormulas
from crane.closure.predictor_formulas import PredictorFormulas
from crane.codegen import Layout, LayoutView, Program, Scalar, Tape, max_abs, maximum
from crane.codegen.llvm.sample_function import SampleFunction
from crane.codegen.symbolic import minimum
from crane.common.samples import Array

# Scaled values: rad and characteristic length, as in `NewtonContinuation`.
_LARGE_GAMMA = 1e3  # above this entry of gamma, `NewtonContinuation` checks singularity
_MIN_DETERMINANT = 1e-9  # share of that at home below which gamma is left to it as well
_NEARLY_CLOSED_TOLERANCE = 1e-6  # residual of a guess that counts as closed


@dataclass(frozen=True, eq=False)
class ContinuationCursor:
    """Start of the next continuation step; every thread and every compiled quantity has one.

    Attributes:
        state: (nq + entries,) configuration and entries of gamma that the next step starts from.
        gamma_entries: Rows (passive joints) and columns of these entries; the others are zero.
    """

    state: Array
    gamma_entries: tuple[Indices, Indices]

    def start_from(self, configuration: ClosedConfiguration) -> None:
        """Start the next step from a closed configuration."""
        self.state[: len(configuration.q)] = configuration.q
        self.state[len(configuration.q) :] = configuration.passive_gamma[self.gamma_entries]


class ContinuedFunction(NamedTuple):
    """A function of one sample that closes the loops from a cursor; every thread has its own.

    Attributes:
        cursor: The cursor.
        evaluate_sample: The function, see `Program.sample_function`.
    """

    cursor: ContinuationCursor
    evaluate_sample: SampleFunction


# Kept while a machine uses it. Two threads may both create an entry; either is valid.
_SHARED_CODE: WeakValueDictionary[tuple, Program] = WeakValueDictionary()


class CompiledClosure:
    """Machine code of the loops of one machine.

    Machines with equal formulas share it; their constants may differ.

    Args:
        equations: All loop equations.
        structure: Independent equations.
        active: Columns of the active joints.
        passive: Columns of the other joints.
        home: The home configuration, whose branch is followed.
        rounding_scale: See `NewtonContinuation.rounding_scale`.
        signs: See the attribute; those at home if not given.

    Attributes:
        geometry: Geometry that the formulas were traced from.
        programs: Further programs of this machine, by what they depend on.
        tolerances: (3,) scaled residual that counts as rounding; that counts as closed if it no
            longer decreases; scaled step whose square is rounding.
        signs: Signs of the block determinants on the branch, over their order of magnitude.
        has_partly_active_rotations: Whether only some coordinates of a rotation are active.
        follow_address: Address of the function `follow_targets`, for other machine code.
        close_address: Address of the function `close`; of `project` with partly active rotations,
            for the states of a simulation.
    """

    def __init__(
        self,
        equations: LoopEquations,
        structure: ConstraintStructure,
        active: Indices,
        passive: Indices,
        home: ClosedConfiguration,
        rounding_scale: float,
        signs: Array | None = None,
    ):
        self.geometry = tree_geometry(equations)
        self._equations, self._structure = equations, structure
        self._active_columns, self._passive_columns = active, passive
        self._nq, self._n = equations.model.nv, len(active)
        self._gamma_entries = self._find_gamma_entries()
        rows, columns = self._gamma_entries
        self._gamma_entry_pairs = list(zip(rows.tolist(), columns.tolist(), strict=True))
        self._predictor = PredictorFormulas(
            self.geometry, active, passive, self._gamma_entry_pairs
        )
        joints = [int(column) + 1 for column in active]
        self.has_partly_active_rotations = bool(self.geometry.partly_active_joints(joints))
        signs = self.signs = self._determinant_signs(home) if signs is None else signs
        key = self._cache_key(signs)
        program = _SHARED_CODE.get(key)
        if program is None:
            program = Program.from_cache(("loops", key), lambda new: self._build(new, signs))
            _SHARED_CODE[key] = program
        self._formula_key, self._closure_program = key, program
        self.programs = program.dependent_programs
        self.follow_address = program.function_address("follow")
        self.close_address = program.function_address(
            "project" if self.has_partly_active_rotations else "close"
        )
        self._home = home
        self.tolerances = np.array([1e-15 * rounding_scale, 1e-13 * rounding_scale, 1e-9])

    def _find_gamma_entries(self) -> tuple[Indices, Indices]:
        """Rows and columns of the nonzero entries of gamma: joints of the same cluster."""
        rows, columns = [], []
        for cluster in self.clusters:
            joints = np.array(cluster.joints) - 1
            passive = np.flatnonzero(np.isin(self._passive_columns, joints))
            active = np.flatnonzero(np.isin(self._active_columns, joints))
            rows.append(np.repeat(passive, len(active)))
            columns.append(np.tile(active, len(passive)))
        return np.concatenate(rows), np.concatenate(columns)

    @cached_property
    def clusters(self) -> list[Cluster]:
        """Clusters of the joints, each after the one that carries it."""
        return find_clusters(self._equations)

    def _cache_key(self, signs: Array) -> tuple:
        """Everything that the formulas depend on."""
        geometry, equations, structure = self.geometry, self._equations, self._structure
        arrays = (
            geometry.body_rotations,
            equations.axis_of_frame1,
            equations.axis_of_frame2,
            equations.is_translation,
            equations.loop_of_row,
            equations.sign,
            equations.coupling_factors,
            equations.coupling_offsets,
            equations.coupling_powers,
            structure.independent_rows,
            structure.redundant_rows,
            self._active_columns,
            self._passive_columns,
            signs,
        )
        return (
            geometry.parents,
            geometry.is_revolute,
            geometry.floating_bases,
            geometry.rotation_bodies,
            geometry.frame_bodies,
            folding_pattern(geometry.constants),
            tuple(loop.type for loop in equations.loops),
            structure.redundancy.tolerance,
            tuple((tuple(rows), tuple(columns)) for rows, columns in structure.blocks),
            *(np.asarray(array).tobytes() for array in arrays),
        )

    def _build(self, program: Program, signs: Array) -> None:
        self._add_newton_formula(program, signs, "newton", holds_coordinates=True)
        if self.has_partly_active_rotations:
            self._add_newton_formula(program, signs, "newton_motion", holds_coordinates=False)
        self._predictor.add_to(program)
        self._add_gamma(program)
        add_closure_routines(
            program,
            self._nq,
            self._n,
            self.has_partly_active_rotations,
            self._predictor.wraps_rotations,
        )

    def new_program(self) -> Program:
        """The functions of the loops, not compiled, for other targets."""
        program = Program()
        self._build(program, self.signs)
        return program

    def cached_program(self, key: tuple, build: Callable[[Program], None]) -> Program:
        """A further program of this machine, kept in `programs`; see `Program.from_cache`.

        Args:
            key: What it depends on besides the loops.
            build: Adds formulas and routines.

        Raises:
            FormulaTooLongError: It would take too long to compile.
        """
        if key not in self.programs:
            self.programs[key] = Program.from_cache((self._formula_key, key), build)
        return self.programs[key]

    def formula_outputs(self, formula: str) -> Layout:
        """Layout of the outputs of a formula of the closure program."""
        return self._closure_program.formula_outputs(formula)

    def new_cursor(self) -> "ContinuationCursor":
        """A new cursor at home."""
        cursor = ContinuationCursor(
            np.empty(self._nq + len(self._gamma_entries[0])), self._gamma_entries
        )
        cursor.start_from(self._home)
        return cursor

    def new_solver(self) -> "ContinuedFunction":
        """The function of one target (n,) that returns q (nq,), with a new cursor."""
        cursor, target, q = self.new_cursor(), np.zeros((1, self._n)), np.zeros(self._nq)
        arrays = self.geometry.constants, target, cursor.state, q, self.tolerances
        return ContinuedFunction(
            cursor,
            self._closure_program.sample_function("follow", 1, *arrays, inputs=target, output=q),
        )

    def start_cursor_at(self, cursor: "ContinuationCursor", q: Array) -> bool:
        """Move a cursor to a configuration (nq,) that is closed to 1e-6 or better.

        Returns:
            Whether it is closed and on the branch of home.
        """
        q = np.ascontiguousarray(q)
        found = self._newton_step(q)
        if not (found.residual[0] <= _NEARLY_CLOSED_TOLERANCE and found.regular[0] > 0):
            return False
        cursor.state[: self._nq] = q
        cursor.state[self._nq :] = found.gamma
        return True

    def least_determinant(self, q: Array) -> float:
        """The least block determinant at a configuration (nq,), positive on the branch of home."""
        return float(self._newton_step(np.ascontiguousarray(q)).determinant[0])

    def _newton_step(self, q: Array) -> LayoutView:
        """Outputs of the formula "newton" at a configuration (nq,)."""
        layout = self.formula_outputs("newton")
        result = np.empty(layout.size)
        self._closure_program.call("newton", self.geometry.constants, q, result)
        return layout.view(result)

    def follow_targets(self, cursor: "ContinuationCursor", targets: Array, out: Array) -> int:
        """Close the loops at targets (N, n) into out (N, nq) until one needs several steps.

        Returns:
            Number of closed samples.
        """
        targets = np.ascontiguousarray(targets)
        return self._closure_program.call(
            "follow",
            len(targets),
            self.geometry.constants,
            targets,
            cursor.state,
            out,
            self.tolerances,
        )

    @cached_property
    def gamma_function(self) -> SampleFunction:
        """The function of one closed configuration (nq,) that returns gamma (nv, n)."""
        q, gamma = np.zeros((1, self._nq)), np.zeros((self._nq, self._n))
        return self._closure_program.sample_function(
            "gamma_each", 1, self.geometry.constants, q, gamma, inputs=q, output=gamma
        )

    def close_in_place(self, q: Array) -> int:
        """Close the loops of configurations (N, nq) in place until one does not converge.

        Each is its own initial guess.

        Returns:
            Number of closed configurations.
        """
        return self._closure_program.call(
            "close_each", len(q), self.geometry.constants, q, self.tolerances
        )

    def evaluate_gamma(self, q: Array, out: Array) -> int:
        """Evaluate gamma at closed q (N, nq) into out (N, nv, n) until one is singular.

        Returns:
            Number of evaluated configurations.
        """
        q = np.ascontiguousarray(q)
        return self._closure_program.call("gamma_each", len(q), self.geometry.constants, q, out)

    def trace_kinematics(
        self,
        tape: Tape,
        geometry_argument: int,
        q_argument: int,
        folded_constants: Array | None = None,
    ) -> tuple[list[Scalar], PositionKinematics, LoopFormulas]:
        """Trace coordinates, position kinematics and loops from two arguments of a formula.

        Args:
            tape: Tape to trace on.
            geometry_argument: Index of the argument with the geometry constants.
            q_argument: Index of the argument with the coordinates.
            folded_constants: Geometry constants, NaN where they must stay arguments.
        """
        coordinates = tape.load_vector(q_argument, 0, self._nq)
        numbers = self.geometry.constants if folded_constants is None else folded_constants
        kinematics = PositionKinematics(
            self.geometry, FormulaConstants(tape, geometry_argument, numbers), coordinates
        )
        return (
            coordinates,
            kinematics,
            LoopFormulas(
                self._equations,
                self._structure,
                self._active_columns,
                self._passive_columns,
                kinematics,
            ),
        )

    def _add_newton_formula(
        self, program: Program, signs: Array, name: str, holds_coordinates: bool
    ) -> None:
        """Add `newton`: one Newton step with residual, gamma and singularity checks.

        "regular" is positive on the branch of home away from singular configurations, with
        redundant equations closed; "largest_gamma" is the largest entry of gamma (rows of passive
        joints); "determinant" is the least determinant of a block, about 1 at home, with its sign
        on the branch of home.
        """
        q, kinematics, loops = self.trace_kinematics(Tape(), 0, 1)
        steps = loops.newton_step(holds_coordinates)
        is_translation = [not kinematics.geometry.is_revolute[joint] for joint in steps]
        corrected = [x + steps.get(i, 0.0) for i, x in enumerate(q, start=1)]
        rows = [loops.gamma[loops.passive_joints[row]][k] for row, k in self._gamma_entry_pairs]
        largest_gamma = self._largest_gamma_entry(rows, kinematics.inverse_characteristic_length)
        worst = maximum(
            largest_gamma - _LARGE_GAMMA,
            loops.largest_residual(redundant=True) - self._structure.redundancy.tolerance,
        )
        shares = [
            float(sign) * self._scale_determinant(block, determinant, kinematics)
            for block, (sign, determinant) in enumerate(
                zip(signs, loops.gamma_and_determinants[1], strict=True)
            )
        ]
        least_determinant = minimum(*shares) if shares else 1.0
        worst = maximum(worst, _MIN_DETERMINANT - least_determinant)
        for alignment in loops.alignments:
            worst = maximum(worst, -1.0 * alignment)
        program.add_formula(
            name,
            2,
            {
                "residual": [loops.largest_residual()],
                "step": [
                    largest_scaled_value(
                        list(steps.values()),
                        is_translation,
                        kinematics.inverse_characteristic_length,
                    )
                ],
                "regular": [-1.0 * worst],
                "largest_gamma": [largest_gamma],
                "determinant": [least_determinant],
                "q": corrected,
                "gamma": rows,
            },
        )

    def _scale_determinant(
        self, block: int, determinant: Scalar, kinematics: PositionKinematics
    ) -> Scalar:
        """Determinant of a block in characteristic lengths."""
        rows, columns = self._structure.blocks[block]
        turns = [self.geometry.is_revolute[i + 1] for i in self._passive_columns[columns]]
        is_length = self._equations.is_translation[self._structure.independent_rows[rows]]
        power = int(is_length.sum()) - turns.count(False)
        inverse_length = kinematics.inverse_characteristic_length
        for _ in range(abs(power)):
            if power > 0:
                determinant = determinant * inverse_length
            else:
                determinant = determinant / inverse_length
        return determinant

    def _largest_gamma_entry(self, rows: Sequence[Scalar], inverse_length: Scalar) -> Scalar:
        turns = self.geometry.is_revolute
        powers: dict[int, list[Scalar]] = {0: [], 1: [], -1: []}  # power of a length in an entry
        for (row, k), entry in zip(self._gamma_entry_pairs, rows, strict=True):
            one, two = turns[self._passive_columns[row] + 1], turns[self._active_columns[k] + 1]
            powers[int(two) - int(one)].append(entry)
        worst = max_abs(powers[0])
        if powers[1]:
            worst = maximum(worst, inverse_length * max_abs(powers[1]))
        if powers[-1]:
            worst = maximum(worst, max_abs(powers[-1]) / inverse_length)
        return worst

    def _add_gamma(self, program: Program) -> None:
        """Add "gamma": gamma of all joints from the result of "newton"."""
        start = program.formula_outputs("newton").start_index("gamma")
        entries = Tape().load_vector(0, start, len(self._gamma_entry_pairs))
        rows = self._predictor.gamma_rows(entries)
        program.add_formula("gamma", 1, [entry for row in rows for entry in row])

    def _determinant_signs(self, home: ClosedConfiguration) -> Array:
        """Signs of the block determinants on the branch of home, over their order of magnitude."""
        blocks = (
            home.jacobian[np.ix_(rows, self._passive_columns[columns])]
            for rows, columns in self._structure.blocks
        )
        signs_and_logarithms = [np.linalg.slogdet(block) for block in blocks]
        return np.array([sign * 2.0 ** -round(x / np.log(2)) for sign, x in signs_and_logarithms])

    def inverse_characteristic_length(self, tape: Tape) -> Scalar:
        """One over the characteristic length, from the geometry constants as first argument."""
        return self._predictor.inverse_characteristic_length(tape)
