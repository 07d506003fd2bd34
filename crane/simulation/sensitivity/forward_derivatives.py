"""How the rate of a simulated machine changes with its state and with all its numbers.

The state of a motion is s = (q_A, v_A, o): active coordinates, their velocities, the states o of
the controller or circuit that act back; c are all numbers of the simulation, see
`SimulationConstants`. The rate r(s, c) = s' is differentiated operation by operation along a
direction (ds, dc), through the closed loops phi(q, c) = 0:

    J_P dq_P = -(J_A dq_A + dphi/dc dc).
"""

import numpy as np

from crane.codegen import Program, Scalar
from crane.codegen.differentiation import directional_derivative
from crane.common.samples import Array
from crane.simulation.sensitivity.rate_formulas import (
    DifferentiatedFormulas,
    RateProgram,
    operation_index,
)
from crane.simulation.sensitivity.simulation_constants import SimulationConstants


class ForwardDerivatives(RateProgram):
    """Derivatives of a machine's rate along directions; see `Rate`."""

    def directional_derivatives(
        self,
        constants: SimulationConstants,
        states: Array,
        directions: SimulationConstants,
        has_joints_at_rest: bool,
    ) -> tuple[Array, Array]:
        """Derivatives at states of one motion.

        Args:
            constants: The simulation's numbers, with what sticks (see
                `Dynamics.set_stick_slip_modes`) and references (N, c) of the states.
            states: (N, .) as they are integrated.
            directions: p directions of the numbers, each part with a leading axis.
            has_joints_at_rest: Whether some joint is at rest.

        Returns:
            d r/d s and d r/d c (N, m, m + p); the same of the outputs and the margin (N, k + 1,
            m + p).
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
        width = self._program.formula_outputs("tangent").size
        out = np.empty((count, m + p, width))
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
        n, moved, tape, sweep = (
            self._mobility,
            self._variable_constants,
            formulas.tape,
            formulas.machine.dynamics_formulas,
        )
        # what tells when joints start or stop changes with time by the references
        varying_references = moved.references + bool(self._chart.stick_slip.columns)
        is_variable = (
            moved.geometry,
            moved.dynamics_constants,
            moved.settings,
            moved.frames,
            varying_references,
        )
        seeds: dict[int, Scalar] = {}

        def seed(array: int, mask: Array) -> None:
            for i in np.flatnonzero(mask).tolist():
                seeds[tape.load(array, i).index] = tape.load(6 + array, i)

        seed(0, is_variable[0])
        changed = [tape.load_vector(11, part * n, n) for part in range(2)]
        gap_changes = directional_derivative([row.phi for row in sweep.loops.rows], seeds)
        joints = sweep.loops.active_joints
        active_rows = {joint: [change] for joint, change in zip(joints, changed[0], strict=True)}
        moving, _ = sweep.loops.solve_passive(active_rows, [[-1.0 * x] for x in gap_changes])
        seeds |= {operation_index(sweep.q[i - 1]): change for i, (change,) in moving.items()}
        seeds |= dict(zip(map(operation_index, sweep.v_a), changed[1], strict=True))
        state_changes, parts = (
            tape.load_vector(11, 2 * n, self._stiff_state_count),
            formulas.machine.state_parts,
        )
        seeds |= dict(
            zip(
                map(operation_index, parts.own[: self._stiff_state_count]),
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
            "geometry", "numbers", "settings", "frames", "references", "states", "geometries",
            "numbered", "settled", "framed", "referred", "inputs", "out",
        )  # fmt: skip
        counts = ("count", "directions")
        with program.add_routine("along" + suffix, counts=counts, arrays=names) as r:
            with r.loop(r.count) as i, r.loop(r.directions) as j:
                at_both = i * r.directions + j
                r.call(
                    "tangent" + suffix,
                    r.geometry,
                    r.numbers,
                    r.settings,
                    r.frames,
                    r.references.row_pointer(i, columns),
                    r.states.row_pointer(i, self._state_layout.size),
                    r.geometries.row_pointer(j, sizes[0]),
                    r.numbered.row_pointer(j, sizes[1]),
                    r.settled.row_pointer(j, sizes[2]),
                    r.framed.row_pointer(j, sizes[3]),
                    r.referred.row_pointer(at_both, columns),
                    r.inputs.row_pointer(j, m),
                    r.out.row_pointer(at_both, width),
                )
            r.return_value(r.count)
