"""Equations of motion and their derivatives as machine code of one machine."""

from collections.abc import Callable

import numpy as np

from crane.closure.compiled_closure import CompiledClosure, ContinuedFunction
from crane.closure.gamma_derivatives import GammaDerivatives
from crane.closure.kinematics_formulas import FormulaConstants, folding_pattern
from crane.codegen import Program, Scalar, SymbolicExpression, Tape, max_abs
from crane.codegen.differentiation import directional_derivative
from crane.common.samples import Array
from crane.common.threads import ThreadLocal
from crane.dynamics.dynamics_derivatives import DynamicsDerivatives
from crane.dynamics.dynamics_formulas import DynamicsFormulas, StickSlipAccelerations
from crane.dynamics.formula_structure import FormulaStructure
from crane.dynamics.spatial_inertia import Matrix
from crane.machine.machine import Machine


def _state_rates(
    formulas: DynamicsFormulas, accelerations: StickSlipAccelerations
) -> list[Scalar]:
    return [
        *formulas.coordinate_derivatives,
        *accelerations.a_a,
        formulas.dissipated_power,
        accelerations.transition_margin,
    ]


def _observation(
    formulas: DynamicsFormulas, accelerations: StickSlipAccelerations
) -> list[Scalar]:
    return [
        *accelerations.active_friction,
        formulas.kinetic,
        formulas.potential,
        *accelerations.friction_at_rest,
    ]


WITH_FRICTION = " with friction"
STICK_SLIP_QUANTITIES = (
    "rates",
    "observation",
    "resting",
)  # what depends on `set_modes`, `set_grip`
# Quantities of `DynamicsFormulas` with a second argument x (n,): a_A for inverse and regressor,
# tau_A for the others.
QUANTITIES: dict[str, Callable[[DynamicsFormulas, list[Scalar]], list[Scalar]]] = {
    "inverse": lambda sweep, x: sweep.inverse_dynamics(x, friction=False),
    "inverse" + WITH_FRICTION: lambda sweep, x: sweep.inverse_dynamics(x, friction=True),
    "forward": lambda sweep, x: sweep.forward_dynamics(x, friction=False),
    "forward" + WITH_FRICTION: lambda sweep, x: sweep.forward_dynamics(x, friction=True),
    "mass matrix": lambda sweep, x: [entry for row in sweep.mass_matrix for entry in row],
    "bias": lambda sweep, x: [
        b - f for b, f in zip(sweep.inertial_bias, sweep.passive_force, strict=True)
    ],
    "gravity": lambda sweep, x: sweep.gravity_force,
    "friction": lambda sweep, x: sweep.friction_force,
    "passive": lambda sweep, x: sweep.passive_force,
    "energy": lambda sweep, x: [sweep.kinetic, sweep.potential],
    "rates": lambda sweep, x: _state_rates(
        sweep, sweep.accelerations_with_stick_slip(x, with_joints_at_rest=True)
    ),
    "observation": lambda sweep, x: _observation(
        sweep, sweep.accelerations_with_stick_slip(x, with_joints_at_rest=True)
    ),
    "resting": lambda sweep, x: sweep.stick_slip_equations(x),
    "statics": lambda sweep, x: sweep.static_quantities,
    "regressor": lambda sweep, x: [entry for row in sweep.regressor(x) for entry in row],
}
_AnalyticDerivatives = Callable[[DynamicsDerivatives, list[Scalar]], tuple[Matrix, Matrix, Matrix]]
_ANALYTIC_DERIVATIVES: dict[str, _AnalyticDerivatives] = {
    "inverse": lambda found, x: (*found.inverse_dynamics_derivatives(x), found.mass_matrix),
    "forward": lambda found, x: found.forward_dynamics_derivatives(x),
}
# before a quantity: its derivatives by q_A, v_A and the second argument
DERIVATIVES_OF = "derivatives of "
MATRIX_QUANTITIES = "mass matrix", "regressor"  # with a row per active joint


class CompiledQuantity:
    """One quantity as machine code.

    Args:
        quantity: A key of `QUANTITIES`, with or without the prefix `DERIVATIVES_OF`.
        machine: The machine.
        formula_constants: See `dynamics_constants`; read at every evaluation.
        constant_pattern: Constants that are folded into the formulas.
        formula_structure: What else the formulas depend on.

    Attributes:
        size: Length of the result of one sample.
        solves_mass_matrix: Whether the result is not finite where the mass matrix is singular.
        sample_function: Its `value` is this thread's function of q_A, v_A and x (n,), as far as
            the quantity depends on them.

    Raises:
        FormulaTooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        quantity: str,
        machine: Machine,
        formula_constants: Array,
        constant_pattern: Array,
        formula_structure: FormulaStructure,
    ):
        fast = self._compiled_closure = machine.closure.compiled_closure
        constants = self._constants = fast.geometry.constants, formula_constants
        nq, n = machine.model.nv, len(machine.active)
        program = self._program = fast.cached_program(
            ("quantity", quantity, folding_pattern(constant_pattern), formula_structure),
            lambda program: build_quantity(
                program, quantity, fast, constant_pattern, n, formula_structure
            ),
        )
        self.size = program.formula_outputs("formula").size
        self.solves_mass_matrix = _solves_mass_matrix(quantity)
        shape = (n, self.size // n) if quantity in MATRIX_QUANTITIES else (self.size,)

        def create_function() -> ContinuedFunction:
            cursor, q = fast.new_cursor(), np.zeros(nq)
            inputs, out = np.zeros((3, n)), np.zeros(shape)
            arrays = *constants, inputs[0], inputs[1:], cursor.state, q, out, fast.tolerances
            return ContinuedFunction(
                cursor,
                program.sample_function(
                    "each", 1, fast.follow_address, *arrays, inputs=inputs, output=out
                ),
            )

        self.sample_function = ThreadLocal(create_function)

    def evaluate_closed(self, q: Array, inputs: Array) -> Array:
        """The quantity at closed configurations.

        Args:
            q: (nq,) or (N, nq).
            inputs: [v_A, x], (2 n,) or (N, 2 n).

        Returns:
            (size,) or (N, size).
        """
        out = np.empty((*q.shape[:-1], self.size))
        arrays = *self._constants, *map(np.ascontiguousarray, (q, inputs)), out
        if q.ndim == 1:
            self._program.call("formula", *arrays)
        else:
            self._program.call("closed_each", len(q), *arrays)
        return out

    def evaluate_targets(self, targets: Array, inputs: Array, out: Array) -> int:
        """The quantity at q_A (N, n) with inputs (N, 2 n) until a sample needs a closer look.

        It is too far from the last one, or its mass matrix is singular.

        Returns:
            Number of evaluated samples.
        """
        fast, state = self._compiled_closure, self.sample_function.value.cursor.state
        q = np.empty_like(state)  # longer than needed
        arrays = *self._constants, targets, inputs, state, q, out, fast.tolerances
        return self._program.call("each", len(targets), fast.follow_address, *arrays)


def build_quantity(
    program: Program,
    quantity: str,
    compiled_closure: CompiledClosure,
    constant_pattern: Array,
    n: int,
    formula_structure: FormulaStructure,
) -> None:
    """Add the formula and the routines of a quantity, see `CompiledQuantity`."""
    tape = Tape()
    q, kinematics, loops = compiled_closure.trace_kinematics(tape, 0, 2)
    constants = FormulaConstants(tape, 1, constant_pattern)
    v_a, x = tape.load_vector(3, 0, n), tape.load_vector(3, n, n)
    modes, base_quantity = quantity in STICK_SLIP_QUANTITIES, quantity.removeprefix(DERIVATIVES_OF)
    geometry = compiled_closure.geometry
    is_holonomic = (
        not geometry.series_of_body and formula_structure.motion_parents == geometry.parents
    )
    frictionless_quantity = base_quantity.removesuffix(WITH_FRICTION)
    if (
        base_quantity != quantity
        and frictionless_quantity in _ANALYTIC_DERIVATIVES
        and is_holonomic
    ):
        gamma_derivatives = GammaDerivatives(kinematics, loops, compiled_closure.clusters, v_a)
        formulas = DynamicsFormulas(
            kinematics, loops, constants, q, v_a, formula_structure, drift=gamma_derivatives.drift
        )
        matrices = _ANALYTIC_DERIVATIVES[frictionless_quantity](
            DynamicsDerivatives(
                formulas, gamma_derivatives, base_quantity != frictionless_quantity
            ),
            x,
        )
        outputs = [entry for matrix in matrices for row in matrix for entry in row]
    else:
        formulas = DynamicsFormulas(kinematics, loops, constants, q, v_a, formula_structure, modes)
        if modes:
            formulas = formulas.with_circuit_friction(formulas.circuit_friction)
        outputs = QUANTITIES[base_quantity](formulas, x)
        if base_quantity != quantity:
            outputs = _state_derivatives(formulas, outputs, x)
    program.add_formula("formula", 4, outputs)
    tape = Tape()
    program.add_formula("check", 1, [max_abs(tape.load_vector(0, 0, len(outputs)))])
    _add_evaluation_routines(program, len(q), n, _solves_mass_matrix(quantity))


class CompiledParameterDerivatives:
    """Derivatives of one quantity by parameters of the machine, as machine code.

    With parameters p and the loops phi(q, p) = 0, at given q_A, v_A and second argument,

        d y / d p = dy/dp + dy/dq dq/dp,    J_P dq_P/dp = -dphi/dp.

    Args:
        quantity: A key of `QUANTITIES`.
        machine: The machine.
        formula_constants: See `dynamics_constants`.
        constant_pattern: Constants that are folded into the formulas.
        formula_structure: What else the formulas depend on.
        geometry_derivatives: (k, .) derivatives of the geometry constants by each parameter.
        constant_derivatives: (k, .) derivatives of `formula_constants` by each parameter.

    Raises:
        FormulaTooLongError: It would take too long to compile.
    """

    def __init__(
        self,
        quantity: str,
        machine: Machine,
        formula_constants: Array,
        constant_pattern: Array,
        formula_structure: FormulaStructure,
        geometry_derivatives: Array,
        constant_derivatives: Array,
    ):
        fast = machine.closure.compiled_closure
        self._directions = geometry_derivatives, constant_derivatives
        self._constants = fast.geometry.constants, formula_constants
        geometry_changes = np.any(geometry_derivatives != 0, axis=0)
        constants_change = np.any(constant_derivatives != 0, axis=0)
        folded_constants = (
            np.where(geometry_changes, np.nan, fast.geometry.constants),
            np.where(constants_change, np.nan, constant_pattern),
        )
        key = (
            "named",
            quantity,
            *map(folding_pattern, folded_constants),
            geometry_changes.tobytes(),
            constants_change.tobytes(),
            formula_structure,
        )
        n = len(machine.active)

        def build(program: Program) -> None:
            tape = Tape()
            q, kinematics, loops = fast.trace_kinematics(tape, 0, 2, folded_constants[0])
            constants = FormulaConstants(tape, 1, folded_constants[1])
            v_a = tape.load_vector(3, 0, n)
            values = QUANTITIES[quantity](
                DynamicsFormulas(kinematics, loops, constants, q, v_a, formula_structure),
                tape.load_vector(3, n, n),
            )
            seeds: dict[int, Scalar] = {}
            for i in np.flatnonzero(geometry_changes).tolist():
                seeds[tape.load(0, i).index] = tape.load(4, i)
            opened = directional_derivative([row.phi for row in loops.rows], seeds)
            changes = loops.coordinate_changes(opened)
            seeds |= {_tape_index(q[i - 1]): change for i, change in changes.items()}
            for i in np.flatnonzero(constants_change).tolist():
                seeds[tape.load(1, i).index] = tape.load(5, i)
            program.add_formula("formula", 6, directional_derivative(values, seeds))

        self._program = fast.cached_program(key, build)

    def evaluate_closed(self, q: Array, inputs: Array) -> Array:
        """(size, k) at one closed configuration (nq,), inputs [v_A, x] (2 n,)."""
        out = np.empty((len(self._directions[0]), self._program.formula_outputs("formula").size))
        for row, *directions in zip(out, *self._directions, strict=True):
            self._program.call("formula", *self._constants, q, inputs, *directions, row)
        return out.T


def _state_derivatives(
    formulas: DynamicsFormulas, values: list[Scalar], x: list[Scalar]
) -> list[Scalar]:
    """Derivatives (3, k, n) of values (k,) by q_A, v_A and x."""
    n = len(x)
    columns_of_gamma = zip(*(row for _, row in sorted(formulas.gamma.items())), strict=True)
    seeds = [
        dict(zip(map(_tape_index, formulas.q), formulas.coordinate_rates(motion), strict=True))
        for motion in ([0.0, *column] for column in columns_of_gamma)
    ]
    for entry in (*formulas.v_a, *x):
        seeds.append({_tape_index(entry): 1.0})
    columns = [directional_derivative(values, seed) for seed in seeds]
    return [
        columns[n * part + k][i] for part in range(3) for i in range(len(values)) for k in range(n)
    ]


def _tape_index(loaded: Scalar) -> int:
    assert isinstance(loaded, SymbolicExpression)
    return loaded.index


def _solves_mass_matrix(quantity: str) -> bool:
    return quantity.removeprefix(DERIVATIVES_OF).removesuffix(WITH_FRICTION) == "forward"


def _add_evaluation_routines(
    program: Program, nq: int, n: int, stops_where_infinite: bool
) -> None:
    """Add the routines that evaluate a quantity.

    "each" closes the loops and evaluates sample by sample; "closed_each" evaluates at closed
    configurations. Like `follow` of `CompiledClosure`, "each" stops at the first sample that is
    too far from the previous one, or whose result is not finite.
    """
    arrays = ("geometry", "constants", "targets", "inputs", "cursor", "q", "out", "tolerances")
    outputs = program.formula_outputs("formula").size
    with program.add_loop("each", functions=("follow",), arrays=arrays) as (r, i):
        checked = r.local_array("checked", program.formula_outputs("check"))
        got = r.call(
            "follow", 1, r.geometry, r.targets.row_pointer(i, n), r.cursor, r.q, r.tolerances
        )
        with r.if_then(got < 1):
            r.return_value(i)
        out = r.out.row_pointer(i, outputs)
        r.call("formula", r.geometry, r.constants, r.q, r.inputs.row_pointer(i, 2 * n), out)
        if stops_where_infinite:
            r.call("check", out, checked)
            with r.if_then(~(checked["all"] < np.inf)):
                r.return_value(i)
    row_lengths = {
        "geometry": None, "constants": None, "configurations": nq, "inputs": 2 * n, "out": outputs,
    }  # fmt: skip
    program.add_formula_loop("closed_each", "formula", row_lengths)
