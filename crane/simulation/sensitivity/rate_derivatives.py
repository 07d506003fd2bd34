"""Forward and reverse derivatives of the state rate of a simulated machine.

The state of a motion is s = (q_A, v_A, o): active coordinates, their velocities, and the states o
of the controller or circuit on which the rates depend; c are all constants of the simulation, see
`SimulationConstants`. The rate r(s, c) = s' is differentiated operation by operation, along a
direction (ds, dc) or backwards for weighted sums, through the closed loops phi(q, c) = 0:

    J_P dq_P = -(J_A dq_A + dphi/dc dc).
"""

from collections.abc import Sequence

import numpy as np

from crane.codegen import Program, Scalar, SymbolicExpression
from crane.codegen.differentiation import directional_derivative, weighted_gradient
from crane.common.samples import Array
from crane.simulation.sensitivity.rate_formulas import (
    DifferentiatedFormulas,
    RateProgram,
    operation_index,
)
from crane.simulation.sensitivity.simulation_constants import SimulationConstants


class ForwardDerivatives(RateProgram):
    """Derivatives of the rate of a machine along directions; see `RateProgram`."""

    def directional_derivatives(
        self,
        constants: SimulationConstants,
        states: Array,
        directions: SimulationConstants,
        has_joints_at_rest: bool,
    ) -> tuple[Array, Array]:
        """Derivatives at states of one motion.

        Args:
            constants: Constants of the simulation, with stick-slip modes (see
                `Dynamics.set_stick_slip_modes`) and references (N, c) at the states.
            states: (N, .) integrated states.
            directions: p directions of the constants; each part has a leading axis.
            has_joints_at_rest: Whether a joint is at rest.

        Returns:
            dr/ds and dr/dc (N, m, m + p), and the same of outputs and margin (N, k + 1, m + p).
        """
        m, p, count = self.state_size, len(directions.geometry), len(states)
        inputs = np.zeros((m + p, m))
        inputs[:m] = np.eye(m)
        padded = [
            np.ascontiguousarray(np.vstack([np.zeros((m, part.shape[1])), part]))
            for part in (
                directions.geometry,
                directions.dynamics_constants,
                directions.settings,
                directions.frames,
            )
        ]
        references = np.zeros((count, m + p, self._reference_columns))
        references[:, m:] = np.swapaxes(directions.references, 0, 1)
        out = np.empty((count, m + p, self._program.formula_outputs("tangent").size))
        self._call(
            "along",
            has_joints_at_rest,
            count,
            m + p,
            constants.geometry,
            constants.dynamics_constants,
            constants.settings,
            constants.frames,
            np.ascontiguousarray(constants.references),
            np.ascontiguousarray(states),
            *padded,
            references,
            inputs,
            out,
        )
        out = np.swapaxes(out, 1, 2)
        return out[:, :m], out[:, m:]

    def _add_derivatives(
        self, program: Program, suffix: str, formulas: DifferentiatedFormulas
    ) -> None:
        """tangent(geometry, numbers, settings, frames, references, state, their changes, ds)."""
        n, variable, tape, dynamics = (
            self._mobility,
            self._variable_constants,
            formulas.tape,
            formulas.machine.dynamics_formulas,
        )
        # the margin of transitions depends on time by the references
        varying_references = variable.references + bool(self._chart.stick_slip.columns)
        is_variable = (
            variable.geometry,
            variable.dynamics_constants,
            variable.settings,
            variable.frames,
            varying_references,
        )
        seeds: dict[int, Scalar] = {}

        def seed(array: int, mask: Array) -> None:
            for i in np.flatnonzero(mask).tolist():
                seeds[tape.load(array, i).index] = tape.load(6 + array, i)

        seed(0, is_variable[0])
        changed = [tape.load_vector(11, part * n, n) for part in range(2)]
        gap_changes = directional_derivative([row.phi for row in dynamics.loops.rows], seeds)
        active_rows = {
            joint: [change]
            for joint, change in zip(dynamics.loops.active_joints, changed[0], strict=True)
        }
        moving, _ = dynamics.loops.solve_passive(active_rows, [[-1.0 * x] for x in gap_changes])
        seeds |= {operation_index(dynamics.q[i - 1]): change for i, (change,) in moving.items()}
        seeds |= dict(zip(map(operation_index, dynamics.v_a), changed[1], strict=True))
        state_changes, parts = (
            tape.load_vector(11, 2 * n, self._stiff_state_count),
            formulas.machine.state_parts,
        )
        seeds |= dict(
            zip(
                map(operation_index, parts.controller[: self._stiff_state_count]),
                state_changes,
                strict=True,
            )
        )
        for array, mask in enumerate(is_variable[1:], start=1):
            seed(array, mask)
        derivatives = directional_derivative(formulas.all_values, seeds)
        for k, (_, factor) in enumerate(formulas.outputs, start=len(formulas.rate)):
            derivatives[k] = factor * derivatives[k]
        program.add_formula("tangent" + suffix, 12, derivatives)
        sizes = [len(mask) for mask in is_variable[:4]]
        width, m, columns = len(derivatives), self.state_size, self._reference_columns
        names = (
            "geometry", "constants", "settings", "frames", "references", "states",
            "geometry_changes", "constant_changes", "setting_changes", "frame_changes",
            "reference_changes", "inputs", "out",
        )  # fmt: skip
        counts = ("count", "directions")
        with program.add_routine("along" + suffix, counts=counts, arrays=names) as r:
            with r.loop(r.count) as i, r.loop(r.directions) as j:
                at_both = i * r.directions + j
                r.call(
                    "tangent" + suffix, r.geometry, r.constants, r.settings, r.frames,
                    r.references.row_pointer(i, columns),
                    r.states.row_pointer(i, self._state_layout.size),
                    r.geometry_changes.row_pointer(j, sizes[0]),
                    r.constant_changes.row_pointer(j, sizes[1]),
                    r.setting_changes.row_pointer(j, sizes[2]),
                    r.frame_changes.row_pointer(j, sizes[3]),
                    r.reference_changes.row_pointer(at_both, columns), r.inputs.row_pointer(j, m),
                    r.out.row_pointer(at_both, width),
                )  # fmt: skip
            r.return_value(r.count)


class ReverseDerivatives(RateProgram):
    """Gradients of rate and outputs by all constants that change; see `RateProgram`."""

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
            states: (N, .) integrated states.
            weights: (N, K, m + k + 1) weights of rate, outputs and margin.
            has_joints_at_rest: Whether a joint is at rest.

        Returns:
            (N, K, l) derivatives by the constants that change, without references.
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
        tape, dynamics, variable = (
            formulas.tape,
            formulas.machine.dynamics_formulas,
            self._variable_constants,
        )
        is_variable = (
            variable.geometry,
            variable.dynamics_constants,
            variable.settings,
            variable.frames,
        )
        numbers = [
            tape.load(array, i)
            for array, mask in enumerate(is_variable)
            for i in np.flatnonzero(mask).tolist()
        ]
        weights = tape.load_vector(6, 0, len(formulas.all_values))
        for k, (_, factor) in enumerate(formulas.outputs, start=len(formulas.rate)):
            weights[k] = factor * weights[k]
        loops = dynamics.loops
        passive = [
            SymbolicExpression(tape, operation_index(dynamics.q[i - 1]))
            for i in loops.passive_joints
        ]
        found = weighted_gradient(formulas.all_values, weights, [*numbers, *passive])
        out: Sequence[Scalar] = found[: len(numbers)]
        if loops.rows:
            # q_P depends linearly on the gaps of the loops; their values cancel
            gaps = [tape.load(7, r) for r in range(len(loops.rows))]
            moving, _ = loops.solve_passive(
                {joint: [0.0] for joint in loops.active_joints}, [[-1.0 * x] for x in gaps]
            )
            z = weighted_gradient(
                [moving[i][0] for i in loops.passive_joints], found[len(numbers) :], gaps
            )
            by_loops = weighted_gradient([row.phi for row in loops.rows], z, numbers)
            out = [one + other for one, other in zip(out, by_loops, strict=True)]
        program.add_formula("cotangent" + suffix, 7, out)
        names = (
            "geometry", "constants", "settings", "frames", "references", "states", "weights",
            "out",
        )  # fmt: skip
        counts, width = ("count", "several"), len(out)
        with program.add_routine("against" + suffix, counts=counts, arrays=names) as r:
            with r.loop(r.count) as i, r.loop(r.several) as j:
                at_both = i * r.several + j
                r.call(
                    "cotangent" + suffix,
                    r.geometry,
                    r.constants,
                    r.settings,
                    r.frames,
                    r.references.row_pointer(i, self._reference_columns),
                    r.states.row_pointer(i, self._state_layout.size),
                    r.weights.row_pointer(at_both, len(weights)),
                    r.out.row_pointer(at_both, width),
                )
            r.return_value(r.count)
