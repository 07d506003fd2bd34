"""Position, Jacobian and bias of a frame as machine code."""

import numpy as np

from crane.closure.kinematics_formulas import FormulaConstants, PositionKinematics, folding_pattern
from crane.closure.loop_formulas import LoopFormulas, VelocityKinematics
from crane.codegen import Program, Scalar, Tape
from crane.codegen.symbolic import add_vectors, cross, dot, matvec, scale_vector, subtract_vectors
from crane.common.samples import Array
from crane.machine.machine import Machine

_BLOCK_SAMPLES = 1000  # samples of a stack at once


class CompiledPoint:
    """Position of a frame, compiled.

    Args:
        machine: The machine.
        frame: Index of the frame in the Pinocchio model.

    Raises:
        FormulaTooLongError: The formulas are too long to be compiled.
    """

    def __init__(self, machine: Machine, frame: int):
        compiled_closure = self._compiled_closure = machine.closure.compiled_closure
        model_frame = machine.model.frames[frame]
        self._body = machine.coordinates.body_of_joint[model_frame.parentJoint]
        self._frame_offset = (
            compiled_closure.geometry.body_rotations[self._body].T
            @ model_frame.placement.translation
        )
        self._nq, self._n = machine.model.nv, len(machine.active)
        key = (type(self), self._body, folding_pattern(self._frame_offset))
        if key not in compiled_closure.programs:
            cache_name = ("frame", type(self).__name__, *key[1:])
            compiled_closure.programs[key] = compiled_closure.cached_program(
                cache_name, self._build_program
            )
        self._program = compiled_closure.programs[key]

    def evaluate(self, q: Array, v_a: Array | None = None) -> Array:
        """Rows of `_output_expressions` for configurations (N, nq) and velocities (N, n)."""
        v_a = np.zeros((len(q), self._n)) if v_a is None else v_a
        out = np.empty((len(q), self._program.formula_outputs("formula").size))
        constants = self._compiled_closure.geometry.constants, self._frame_offset
        for i in range(
            0, len(q), _BLOCK_SAMPLES
        ):  # copies of this size stay in the processor's cache
            blocks = (np.ascontiguousarray(x[i : i + _BLOCK_SAMPLES]) for x in (q, v_a, out))
            self._program.call("rows", min(_BLOCK_SAMPLES, len(q) - i), *constants, *blocks)
        return out

    def _output_expressions(self, tape: Tape) -> list[Scalar]:
        """Expressions of an output row: x (3)."""
        bodies, _, point = self._trace_point(tape)
        return self._rotate_to_world(bodies, subtract_vectors(point, bodies.origin[0]))

    def _trace_point(self, tape: Tape) -> tuple[PositionKinematics, LoopFormulas, list[Scalar]]:
        """Bodies, loops, and the position of the frame in the reference body."""
        _, bodies, loops = self._compiled_closure.trace_kinematics(tape, 0, 2)
        frame_offset = FormulaConstants(tape, 1, self._frame_offset).vector(0)
        point = add_vectors(
            bodies.origin[self._body], matvec(bodies.rotation[self._body], frame_offset)
        )
        return bodies, loops, point

    def _rotate_to_world(self, bodies: PositionKinematics, vector: list[Scalar]) -> list[Scalar]:
        """Components in the world frame of a vector of the reference body."""
        return matvec([list(axis) for axis in zip(*bodies.rotation[0], strict=True)], vector)

    def _build_program(self, program: Program) -> None:
        nq, n = self._nq, self._n
        size = program.add_formula("formula", 4, self._output_expressions(Tape())).size
        arrays = ("geometry", "place", "q", "v", "out")
        with program.add_routine("rows", counts=("count",), arrays=arrays) as r:
            with r.loop(r.count) as i:
                rows = r.q.row_pointer(i, nq), r.v.row_pointer(i, n), r.out.row_pointer(i, size)
                r.call("formula", r.geometry, r.place, *rows)
            r.return_value(r.count)


class CompiledFrame(CompiledPoint):
    """Position, reduced Jacobian and bias of a frame, compiled."""

    def _output_expressions(self, tape: Tape) -> list[Scalar]:
        """Expressions of an output row: x (3), J gamma (3 n), bias (3)."""
        n, body = self._n, self._body
        bodies, loops, point = self._trace_point(tape)
        v_a, parents = tape.load_vector(3, 0, n), bodies.geometry.parents
        joint_rates: list[Scalar] = [0.0]
        joint_rates += [dot(loops.gamma[i], v_a) for i in range(1, len(parents))]
        motion = VelocityKinematics(bodies, loops, joint_rates, [0.0] * 3, parents)
        columns: list[list[Scalar]] = [[0.0] * 3 for _ in range(n)]
        (v, w), (a, e) = motion.velocities[body], motion.bias_accelerations[body]
        i = body
        while i > 0:  # motion of the point by each joint that carries it
            linear, angular = bodies.joint_axes[i]
            point_velocity = add_vectors(linear, cross(angular, point))
            columns = [
                add_vectors(column, scale_vector(factor, point_velocity))
                for column, factor in zip(columns, loops.gamma[i], strict=True)
            ]
            a = add_vectors(a, scale_vector(motion.drift[i], linear))
            e = add_vectors(e, scale_vector(motion.drift[i], angular))
            i = parents[i]
        acceleration = add_vectors(a, cross(e, point), cross(w, add_vectors(v, cross(w, point))))
        jacobian = [self._rotate_to_world(bodies, column) for column in columns]
        outputs = self._rotate_to_world(bodies, subtract_vectors(point, bodies.origin[0]))
        outputs += [column[row] for row in range(3) for column in jacobian]
        return [*outputs, *self._rotate_to_world(bodies, acceleration)]
