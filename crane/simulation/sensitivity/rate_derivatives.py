"""Forward and reverse derivatives of the state rate of a simulated machine.

The state of a motion is s = (q_A, v_A, o): active coordinates, their velocities, and the states o
of the controller or circuit on which the rates depend; c are all constants of the simulation, see
`SimulationConstants`. The rate r(s, c) = s' is differentiated operation by operation, along a
direction (ds, dc) or backwards for weighted sums, through the closed loops phi(q, c) = 0:

    J_P dq_P = -(J_A dq_A + dphi/dc dc).

Changes dq are small motions of the joints: of ball joints and floating bases along and about the
axes of the body, so that they do not jump where rotation vectors do, with the rates
dq_A' = dv_A - [v, dq]_A of `motion_commutator`.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from crane.codegen import Program, Scalar, SymbolicExpression
from crane.codegen.differentiation import directional_derivative, weighted_gradient
from crane.codegen.symbolic import add_vectors, cross, subtract_vectors
from crane.common.samples import Array
from crane.dynamics.dynamics_formulas import DynamicsFormulas
from crane.simulation.integration.machine_formulas import AT_REST_SUFFIX
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
        padded = [np.vstack([np.zeros((m, part.shape[1])), part]) for part in directions[:4]]
        references = np.zeros((count, m + p, self._reference_columns))
        references[:, m:] = np.swapaxes(directions.references, 0, 1)
        out = np.empty((count, m + p, self._program.formula_outputs("tangent").size))
        arrays = (*constants[:5], states, *padded, references, np.eye(m + p, m))
        self._program.call(
            "along" + AT_REST_SUFFIX * has_joints_at_rest,
            count,
            m + p,
            *map(np.ascontiguousarray, arrays),
            out,
        )
        out = np.swapaxes(out, 1, 2)
        return out[:, :m], out[:, m:]

    def _add_derivatives(
        self, program: Program, suffix: str, formulas: DifferentiatedFormulas
    ) -> None:
        """tangent(geometry, numbers, settings, frames, references, state, their changes, ds)."""
        n, variable, tape = self._mobility, self._variable_constants, formulas.tape
        dynamics, loops = (
            formulas.machine.dynamics_formulas,
            formulas.machine.dynamics_formulas.loops,
        )
        # the margin of transitions depends on time by the references
        is_variable = [*variable[:4], variable.references + bool(self._chart.stick_slip.columns)]
        seeds: dict[int, Scalar] = {}

        def seed(array: int) -> None:
            for i in np.flatnonzero(is_variable[array]).tolist():
                seeds[tape.load(array, i).index] = tape.load(6 + array, i)

        seed(0)
        changed = [tape.load_vector(11, part * n, n) for part in range(2)]
        gap_changes = directional_derivative([row.phi for row in loops.rows], seeds)
        active_rows = {
            x: [change] for x, change in zip(loops.active_joints, changed[0], strict=True)
        }
        moving, _ = loops.solve_passive(active_rows, [[-1.0 * x] for x in gap_changes])
        steps = loops.coordinate_steps({i: change for i, (change,) in moving.items()})
        seeds |= {operation_index(dynamics.q[i - 1]): change for i, change in steps.items()}
        controller = formulas.machine.state_parts.controller[: self._stiff_state_count]
        changed.append(tape.load_vector(11, 2 * n, self._stiff_state_count))
        for values, changes in zip((dynamics.v_a, controller), changed[1:], strict=True):
            seeds |= dict(zip(map(operation_index, values), changes, strict=True))
        for array in range(1, 5):
            seed(array)
        derivatives = directional_derivative(formulas.all_values, seeds)
        turned = motion_commutator(dynamics, {i: row[0] for i, row in moving.items()})
        derivatives[: self._mobility] = subtract_vectors(derivatives[: self._mobility], turned)
        for k, (_, factor) in enumerate(formulas.outputs, start=len(formulas.rate)):
            derivatives[k] = factor * derivatives[k]
        program.add_formula("tangent" + suffix, 12, derivatives)
        names = ("geometry_changes", "constant_changes", "setting_changes", "frame_changes")
        sizes = (("repetition", len(part)) for part in is_variable)
        widths = dict(zip(names, sizes, strict=False)) | {
            "reference_changes": ("both", self._reference_columns),
            "inputs": ("repetition", self.state_size),
            "out": ("both", len(derivatives)),
        }
        self._add_routine(program, "along" + suffix, "tangent" + suffix, widths)


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
        self._program.call(
            "against" + AT_REST_SUFFIX * has_joints_at_rest,
            count,
            sum_count,
            *map(np.ascontiguousarray, (*constants[:5], states, weights)),
            out,
        )
        return out

    def _add_derivatives(
        self, program: Program, suffix: str, formulas: DifferentiatedFormulas
    ) -> None:
        """cotangent(geometry, numbers, settings, frames, references, state, weights)."""
        tape, dynamics = formulas.tape, formulas.machine.dynamics_formulas
        numbers = [
            tape.load(array, i)
            for array, mask in enumerate(self._variable_constants[:4])
            for i in np.flatnonzero(mask).tolist()
        ]
        weights = tape.load_vector(6, 0, len(formulas.all_values))
        for k, (_, factor) in enumerate(formulas.outputs, start=len(formulas.rate)):
            weights[k] = factor * weights[k]
        loops = dynamics.loops
        held_parts = dynamics.kinematics.geometry.partly_active_joints(loops.active_joints)
        moved_joints = [*loops.passive_joints, *held_parts]
        passive = [
            SymbolicExpression(tape, operation_index(dynamics.q[i - 1])) for i in moved_joints
        ]
        found = weighted_gradient(formulas.all_values, weights, [*numbers, *passive])
        out: Sequence[Scalar] = found[: len(numbers)]
        if loops.rows:
            # q_P depends linearly on the gaps of the loops; their values cancel
            gaps = [tape.load(7, r) for r in range(len(loops.rows))]
            held: dict[int, list[Scalar]] = {joint: [0.0] for joint in loops.active_joints}
            motion, _ = loops.solve_passive(held, [[-1.0 * gap] for gap in gaps])
            changes = {i: row[0] for i, row in motion.items()}
            steps, turned = loops.coordinate_steps(changes), motion_commutator(dynamics, changes)
            values = [*(steps[i] for i in moved_joints), *turned]
            shares = [-1.0 * w for w in weights[: self._mobility]]
            z = weighted_gradient(values, [*found[len(numbers) :], *shares], gaps)
            by_loops = weighted_gradient([row.phi for row in loops.rows], z, numbers)
            out = [one + other for one, other in zip(out, by_loops, strict=True)]
        program.add_formula("cotangent" + suffix, 7, out)
        widths = {"weights": ("both", len(weights)), "out": ("both", len(out))}
        self._add_routine(program, "against" + suffix, "cotangent" + suffix, widths)


def motion_commutator(dynamics: DynamicsFormulas, motion: Mapping[int, Scalar]) -> list[Scalar]:
    """Commutator [v, x]_A (n,) of the velocities v and a small motion x of all joints.

    The rate of a small motion x along joint velocities v that change by dv is x' = dv - [v, x]:
    [v, x] = w x t for the angular parts w, t of a ball joint, and for the linear parts u, l of a
    floating base w x l + u x t (Lie bracket of SE(3)); 0 of all other joints.

    Args:
        dynamics: Formulas with v.
        motion: x by joint.
    """
    v, geometry = dynamics.joint_velocities, dynamics.kinematics.geometry
    x: list[Scalar] = [0.0, *(motion[i] for i in range(1, len(v)))]
    out: list[Scalar] = [0.0] * len(v)
    for i in geometry.rotation_bodies:
        out[i : i + 3] = cross(v[i : i + 3], x[i : i + 3])
    for i in geometry.floating_bases:
        linear, angular = slice(i, i + 3), slice(i + 3, i + 6)
        out[linear] = add_vectors(cross(v[angular], x[linear]), cross(v[linear], x[angular]))
    return [out[joint] for joint in dynamics.loops.active_joints]
