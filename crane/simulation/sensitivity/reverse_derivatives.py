"""What all numbers of a simulated machine do to a weighted sum of its rate and its outputs.

The transpose of `ForwardDerivatives`: with weights mu of the rate r(s, c), w of the outputs y(s,
c) and the closed loops phi(q, c) = 0, the gradient of mu . r + w . y by all numbers c at a state
is, by one pass against the order of the formulas in which coordinates q and numbers are
independent,

    g = dr/dc^T mu + dy/dc^T w - dphi/dc^T z,    J_P^T z = dr/dq_P^T mu + dy/dq_P^T w.
"""

from collections.abc import Sequence

import numpy as np

from crane.codegen import Program, Scalar, SymbolicExpression
from crane.codegen.differentiation import weighted_gradient
from crane.common.samples import Array
from crane.simulation.sensitivity.rate_formulas import (
    DifferentiatedFormulas,
    RateProgram,
    operation_index,
)
from crane.simulation.sensitivity.simulation_constants import SimulationConstants


class ReverseDerivatives(RateProgram):
    """Gradients of a machine's rate and outputs by all numbers that move; see `Rate`."""

    def gradients(
        self,
        constants: SimulationConstants,
        states: Array,
        weights: Array,
        has_joints_at_rest: bool,
    ) -> Array:
        """Gradients at states of one motion.

        Args:
            constants: See `ForwardDerivatives.directional_derivatives`.
            states: (N, .) as they are integrated.
            weights: (N, K, m + k + 1) of rate, outputs and margin.
            has_joints_at_rest: Whether some joint is at rest.

        Returns:
            (N, K, l) by the numbers that move: of geometry, numbers, settings, frames.
        """
        count, sum_count, _ = weights.shape
        out = np.empty((count, sum_count, self._program.formula_outputs("cotangent").size))
        self._call(
            "against",
            has_joints_at_rest,
            count,
            sum_count,
            constants.geometry,
            constants.dynamics_constants,
            constants.settings,
            constants.frames,
            np.ascontiguousarray(constants.references),
            np.ascontiguousarray(states),
            np.ascontiguousarray(weights),
            out,
        )
        return out

    def _add_derivatives(
        self, program: Program, suffix: str, formulas: DifferentiatedFormulas
    ) -> None:
        """cotangent(geometry, numbers, settings, frames, references, state, weights)."""
        tape, sweep, moved = (
            formulas.tape,
            formulas.machine.dynamics_formulas,
            self._variable_constants,
        )
        is_variable = moved.geometry, moved.dynamics_constants, moved.settings, moved.frames
        numbers = [
            tape.load(array, i)
            for array, mask in enumerate(is_variable)
            for i in np.flatnonzero(mask).tolist()
        ]
        weights = tape.load_vector(6, 0, len(formulas.all_values))
        for k, (_, factor) in enumerate(formulas.outputs, start=len(formulas.rate)):
            weights[k] = factor * weights[k]
        loops = sweep.loops
        passive = [
            SymbolicExpression(tape, operation_index(sweep.q[i - 1])) for i in loops.passive_joints
        ]
        found = weighted_gradient(formulas.all_values, weights, [*numbers, *passive])
        out: Sequence[Scalar] = found[: len(numbers)]
        if loops.rows:
            # q_P moves linearly with how far loops are opened, by numbers that cancel out
            gaps = [tape.load(7, r) for r in range(len(loops.rows))]
            active_rows: dict[int, list[Scalar]] = {joint: [0.0] for joint in loops.active_joints}
            moving, _ = loops.solve_passive(active_rows, [[-1.0 * x] for x in gaps])
            passive_directions = [moving[i][0] for i in loops.passive_joints]
            z = weighted_gradient(passive_directions, found[len(numbers) :], gaps)
            by_loops = weighted_gradient([row.phi for row in loops.rows], z, numbers)
            out = [one + other for one, other in zip(out, by_loops, strict=True)]
        program.add_formula("cotangent" + suffix, 7, out)
        names = (
            "geometry", "numbers", "settings", "frames", "references", "states", "weights", "out",
        )  # fmt: skip
        counts, width = ("count", "several"), len(out)
        with program.add_routine("against" + suffix, counts=counts, arrays=names) as r:
            with r.loop(r.count) as i, r.loop(r.several) as j:
                at_both = i * r.several + j
                r.call(
                    "cotangent" + suffix,
                    r.geometry,
                    r.numbers,
                    r.settings,
                    r.frames,
                    r.references.row_pointer(i, self._reference_columns),
                    r.states.row_pointer(i, self._state_layout.size),
                    r.weights.row_pointer(at_both, len(weights)),
                    r.out.row_pointer(at_both, width),
                )
            r.return_value(r.count)
