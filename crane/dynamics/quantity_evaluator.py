"""Evaluation of the quantities of a machine's dynamics, compiled or by Pinocchio."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from crane.closure.change_points import interpolate_limit
from crane.closure.kinematics_formulas import tree_geometry
from crane.codegen import FormulaTooLongError, run_with_fallback
from crane.common.errors import (
    CraneError,
    InputError,
    MechanismError,
    SingularConfigurationError,
    SingularMassMatrixError,
    suggest_names,
)
from crane.common.one_line_repr import OneLineRepr
from crane.common.samples import Array, apply_per_sample, as_samples, stack_length
from crane.description.machine_parameters import unknown_parameter_text
from crane.dynamics.compiled_dynamics import (
    MATRIX_QUANTITIES,
    WITH_FRICTION,
    CompiledParameterDerivatives,
    CompiledQuantity,
)
from crane.dynamics.formula_structure import FormulaStructure, dynamics_constants
from crane.dynamics.joint_forces import JointForces
from crane.dynamics.pinocchio_dynamics import PinocchioDynamics
from crane.formats.machine_loading import MachineVariants
from crane.machine.machine import Machine
from crane.machine.machine_checks import has_mass
from crane.machine.massless_motions import MIN_INERTIA_SHARE, is_definite

UNIT_OF_ZERO_PARAMETER = 0.1  # magnitude assumed for a parameter that is 0
_RELATIVE_STEP = 1e-3  # step as a fraction of the parameter
_LINEARITY_TOLERANCE = 1e-11  # second over first difference of linear constants
# f'(0) h from f(h) - f(0), ... f(5 h) - f(0), of order 5
_FORWARD_DIFFERENCE_WEIGHTS = np.array([5.0, -5.0, 10 / 3, -5 / 4, 1 / 5], dtype=np.float64)


class ConstantDerivatives:
    """Derivatives of constants by named parameters, in which most constants are linear.

    Constants are elementary functions of a parameter: itself, its inverse, sine and cosine of an
    angle. The derivative of a linear one is a finite difference, exact to rounding; of others the
    one-sided difference of order 5, exact to about 1e-11.

    Args:
        machine: The machine, as loaded.
    """

    def __init__(self, machine: Machine):
        self._variants = MachineVariants(machine)
        self._values = self._variants.values

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return tuple(self._values)

    def parameter_value(self, name: str) -> float:
        """Value of a parameter.

        Raises:
            InputError: Unknown name.
        """
        if name not in self._values:
            raise InputError(unknown_parameter_text(self._variants.spec, self._values, name))
        return self._values[name]

    def jacobian(self, names: Sequence[str], constants: Callable[[Machine], Array]) -> Array:
        """Derivatives (k, m) of constants (m,) by k parameters.

        Raises:
            InputError: Unknown name, or a parameter that no neighbouring machine can be built for.
        """
        nominal = self.nominal_constants(constants)
        return np.array([self.derivative(name, constants, nominal) for name in names])

    def nominal_constants(self, constants: Callable[[Machine], Array]) -> Array:
        """Constants (m,) of the machine itself."""
        return constants(self._variants.perturbed_machine({}))

    def derivative(
        self, name: str, constants: Callable[[Machine], Array], nominal: Array
    ) -> Array:
        """Derivatives (m,) by one parameter, given the nominal constants; see `jacobian`."""
        value = self.parameter_value(name)
        unit = value if value else UNIT_OF_ZERO_PARAMETER

        def constants_at(steps: int) -> Array:
            try:
                found = constants(
                    self._variants.perturbed_machine({name: value + steps * _RELATIVE_STEP * unit})
                )
            except CraneError as error:
                raise InputError(f"'{name}' cannot be varied about {value:g}: {error}") from error
            if len(found) != len(nominal):
                raise InputError(
                    f"'{name}' cannot be varied about {value:g}, where the machine has other "
                    "equations: give it another value"
                )
            return found

        one_step = constants_at(1)
        if (one_step == nominal).all():
            return np.zeros_like(nominal)
        two_steps = constants_at(2)
        first = two_steps - nominal
        if (
            np.abs(two_steps - 2.0 * one_step + nominal)
            <= _LINEARITY_TOLERANCE * np.abs(first) + 4e-16 * np.abs(nominal)
        ).all():
            return first / (2.0 * _RELATIVE_STEP * unit)
        rows = [
            one_step,
            two_steps,
            *map(constants_at, range(3, len(_FORWARD_DIFFERENCE_WEIGHTS) + 1)),
        ]
        return np.asarray(
            _FORWARD_DIFFERENCE_WEIGHTS @ (np.array(rows) - nominal) / (_RELATIVE_STEP * unit)
        )


BACKENDS = ("compiled", "pinocchio")
QUANTITY_ARGUMENTS = {  # arguments of the quantities of `derivatives`
    "inverse": ("q_a", "v_a", "a_a"),
    "forward": ("q_a", "v_a", "tau_a"),
    "mass_matrix": ("q_a",),
    "bias": ("q_a", "v_a"),
    "gravity": ("q_a",),
    "friction": ("q_a", "v_a"),
    "passive": ("q_a", "v_a"),
    "energy": ("q_a", "v_a"),
    "regressor": ("q_a", "v_a", "a_a"),
    "statics": ("q_a",),
}


class QuantityEvaluator(OneLineRepr):
    """Evaluates quantities of `crane.dynamics.compiled_dynamics.QUANTITIES`; base of `Dynamics`.

    Args:
        machine: See `Dynamics`.
        formulation: See `Dynamics`.
        backend: See `Dynamics`.

    Attributes:
        forces: Forces along the joints.
        formula_structure: What the formulas depend on besides constants.
        backend: "compiled" or "pinocchio".
        tree_dynamics: The quantities by Pinocchio.
        formula_constants: Constants of the formulas, see `dynamics_constants`.
        constant_pattern: Constants to fold into formulas, NaN for those that change.
    """

    def __init__(self, machine: Machine, formulation: str = "exact", backend: str = "compiled"):
        if backend not in BACKENDS:
            raise InputError(f"backend '{backend}' is unknown, {suggest_names(BACKENDS, backend)}")
        if not isinstance(machine, Machine):
            raise InputError(f"{machine!r} is not a machine, load it with crane.load")
        if not has_mass(machine.model):
            raise MechanismError(
                f"no link of '{machine.name}' that moves has a mass, give each an <inertial>: "
                "without masses there is kinematics, and no dynamics"
            )
        self.machine, self.formulation = machine, formulation
        self._mobility = len(machine.active)
        self.forces = JointForces(machine)
        self.formula_structure = FormulaStructure.from_machine(machine, formulation, self.forces)
        self.backend = backend if machine.closure.is_compiled else "pinocchio"
        self.tree_dynamics = PinocchioDynamics(
            machine, self.forces, self.formula_structure.motion_parents
        )
        self._compiled_quantities: dict[str, CompiledQuantity | None] = {}
        self._parameter_derivatives: dict[
            tuple[str, tuple[str, ...]], CompiledParameterDerivatives
        ] = {}
        layout = self.formula_structure.constants_layout
        self.formula_constants = np.zeros(layout.size)
        if self.backend == "compiled":
            geometry = machine.closure.compiled_closure.geometry
            self.formula_constants[:] = dynamics_constants(
                machine, geometry, self.forces, machine.least_inertias
            )
        # constants to fold into formulas; NaN for those that change with the motion
        self.constant_pattern = self.formula_constants.copy()
        self._mode_indices = self.formula_structure.stick_slip_mode_indices
        self._circuit_friction_indices = layout["circuit_friction"]
        self.constant_pattern[self._mode_indices] = np.nan
        self.constant_pattern[self._circuit_friction_indices] = np.nan

    def backend_of(self, quantity: str = "forward") -> str:
        """The backend that computes a quantity of `compiled_dynamics.QUANTITIES`."""
        return "pinocchio" if self._compiled_quantity(quantity) is None else "compiled"

    def evaluate_closed(self, quantity: str, q: Array, v_a: Array, x: Array) -> Array:
        """A quantity at configurations that are closed already, without checks.

        Args:
            quantity: A key of `crane.dynamics.compiled_dynamics.QUANTITIES`.
            q: (nq,) or (N, nq) closed configurations.
            v_a: (n,) or (N, n) [m/s], [rad/s].
            x: The same shape, a_A or tau_A, depending on the quantity.

        Returns:
            The results, each flattened.
        """
        formula = self._compiled_quantity(quantity)
        if formula is None:
            return apply_per_sample(
                lambda *one: self.tree_dynamics.evaluate(quantity, *one), q, v_a, x
            )
        return formula.evaluate_closed(q, np.concatenate([v_a, x], axis=-1))

    def singular_mass_error(
        self, q: Array, sample: str = "", margin: float = 1.0
    ) -> SingularMassMatrixError | None:
        """See `PinocchioDynamics.singular_mass_error`."""
        return self.tree_dynamics.singular_mass_error(q, sample, margin)

    def check_free_block(self, q_a: ArrayLike, free_block: Array) -> None:
        """Raise the error of a singular mass matrix of the free joints (..., k, k)."""
        machine = self.machine
        least = machine.least_inertias[machine.closure.active][~machine.is_driven]
        rounding = MIN_INERTIA_SHARE * np.diagonal(free_block, axis1=-2, axis2=-1)
        if not is_definite(free_block, least + rounding):
            self.check_mass_matrices(self.machine.closure.solve(np.atleast_2d(q_a)))

    def check_mass_matrices(self, q: Array) -> None:
        """Raise at the first of closed configurations (N, nq) whose mass matrix is singular."""
        for i, one in enumerate(q):
            error = self.singular_mass_error(one, f" (sample {i})" if len(q) > 1 else "")
            if error is not None:
                raise error

    def _evaluate_beside_change_point(
        self, formula: CompiledQuantity, q: Array, row: Array, sample: str
    ) -> Array:
        """A quantity at a closed configuration (nq,), in a change point as its limit."""
        neighbours = self.machine.closure.neighbours(q)
        if not neighbours:
            return formula.evaluate_closed(q, row)
        limit = interpolate_limit(
            np.array([formula.evaluate_closed(one, row) for one in neighbours])
        )
        if limit is None:
            active = self.machine.closure.active
            place = self.machine.coordinates.format_values(active, q[active])
            raise SingularConfigurationError(
                f"forces have no bounds in the change point at {place}{sample}: stay away from it"
            )
        return limit

    def set_stick_slip_modes(
        self, slip_sign: Array, is_held: Array, inverse_velocity: Array, is_moving: bool
    ) -> None:
        """Set the stick-slip modes; see `JointForces.set_stick_slip_modes`.

        They only affect the quantities of the integration, `STICK_SLIP_QUANTITIES`.
        """
        self.forces.set_stick_slip_modes(slip_sign, is_held, inverse_velocity, is_moving)
        modes = np.array([slip_sign, is_held, inverse_velocity]).T.ravel()
        self.formula_constants[self._mode_indices[:-1]] = modes
        self.formula_constants[self._mode_indices[-1]] = is_moving

    def set_circuit_friction(self, circuit_friction: Array) -> None:
        """Set the circuit friction; see `JointForces.set_circuit_friction`.

        It only affects the quantities of the integration, `STICK_SLIP_QUANTITIES`.
        """
        self.forces.set_circuit_friction(circuit_friction)
        self.formula_constants[self._circuit_friction_indices] = circuit_friction

    def result_shape(self, quantity: str) -> tuple[int, ...]:
        """Shape of one sample of a quantity of `derivatives`."""
        n, model = self._mobility, self.machine.model
        shapes = {
            "mass_matrix": (n, n),
            "energy": (2,),
            "statics": (4 + 4 * n + (0 if self.machine.tip is None else 3 + 3 * n),),
            "regressor": (n, 10 * (model.njoints - 1) + np.count_nonzero(model.armature)),
        }
        return shapes.get(quantity, (n,))

    def constants_of(self, variant: Machine) -> Array:
        """Constants of the formulas of a variant: geometry, then `dynamics_constants`."""
        variant = replace(variant, tip=self.machine.tip)
        geometry = tree_geometry(variant.closure.equations)
        if geometry.parents != self.machine.closure.compiled_closure.geometry.parents:
            raise InputError("the tree is not the same")
        least = self.machine.least_inertias  # thresholds are not differentiated
        constants = dynamics_constants(variant, geometry, JointForces(variant), least)
        return np.concatenate([geometry.constants, constants])

    def _compiled_quantity(self, quantity: str) -> CompiledQuantity | None:
        """Machine code of a quantity, or None on the Pinocchio backend."""
        if quantity not in self._compiled_quantities:
            parts = self.formula_constants, self.constant_pattern, self.formula_structure
            is_compiled = self.backend == "compiled"
            try:
                made = CompiledQuantity(quantity, self.machine, *parts) if is_compiled else None
            except FormulaTooLongError:
                made = None
            # if two threads compile it at the same time, both use the first
            self._compiled_quantities.setdefault(quantity, made)
        return self._compiled_quantities[quantity]

    def _required_formula(self, quantity: str) -> CompiledQuantity:
        formula = self._compiled_quantity(quantity)
        if formula is None:
            raise InputError(
                f"'{self.machine.name}' has no formulas to differentiate, "
                + (
                    "take the compiled backend"
                    if self.machine.closure.is_compiled and self.backend != "compiled"
                    else "it is too large: lock joints"
                )
            )
        return formula

    def _parameter_derivatives_at(
        self, quantity: str, names: Sequence[str], q: Array, inputs: Array
    ) -> Array:
        """Derivatives (N, size, k) by parameters at closed configurations (N, nq)."""
        self._required_formula(quantity)
        key = quantity, tuple(names)
        if key not in self._parameter_derivatives:
            constants = ConstantDerivatives(self.machine).jacobian(names, self.constants_of)
            geometry, numbers = np.split(
                constants, [len(self.machine.closure.compiled_closure.geometry.constants)], axis=1
            )
            geometry[:, -1] = 0.0  # the characteristic length only scales residuals
            self._parameter_derivatives[key] = CompiledParameterDerivatives(
                quantity,
                self.machine,
                self.formula_constants,
                self.constant_pattern,
                self.formula_structure,
                geometry,
                numbers,
            )
        code = self._parameter_derivatives[key]
        return np.array([code.evaluate_closed(*row) for row in zip(q, inputs, strict=True)])

    def _evaluate(self, quantity: str, *arguments: ArrayLike) -> Array:
        """A quantity of samples or stacks; single samples apply to every row of a stack."""
        formula = self._compiled_quantities.get(quantity)
        if (
            formula is not None
            and (out := formula.sample_function.value.evaluate_sample(*arguments)) is not None
        ):
            return out
        name = quantity.removesuffix(WITH_FRICTION).replace(" ", "_")
        given = dict(zip(QUANTITY_ARGUMENTS[name], arguments, strict=True))
        targets, rows, length = self._stack_arguments(given)
        out = self._evaluate_stack(quantity, targets, rows, np.ndim(arguments[0]) == 2)
        if quantity in MATRIX_QUANTITIES:
            out = out.reshape(len(targets), self._mobility, -1)
        return out[0] if length is None else out

    def _stack_arguments(
        self, arguments: Mapping[str, ArrayLike]
    ) -> tuple[Array, Array, int | None]:
        """q_A (N, n), the other arguments (N, 2 n), and N, None for a single sample.

        Args:
            arguments: Samples or stacks by name, q_A first.
        """
        n, names = self._mobility, self.machine.active
        q_a, *others = (as_samples(x, n, name, names) for name, x in arguments.items())
        length = stack_length((q_a, *others))
        count = 1 if length is None else length
        if count == 0:
            raise InputError("the stack is empty, give at least one sample")
        rows = np.zeros((count, 2 * n))
        for i, array in enumerate(others):
            rows[:, i * n : (i + 1) * n] = array
        return np.ascontiguousarray(np.broadcast_to(q_a, (count, n))), rows, length

    def _evaluate_stack(self, quantity: str, targets: Array, rows: Array, is_stack: bool) -> Array:
        closure, n = self.machine.closure, self._mobility
        formula = self._compiled_quantity(quantity)
        if formula is None:
            return self.evaluate_closed(quantity, closure.solve(targets), rows[:, :n], rows[:, n:])
        out = np.empty((len(targets), formula.size))

        def reach(i: int) -> None:
            sample = f" (sample {i})" if is_stack else ""
            q = closure.continue_from_home(
                formula.sample_function.value.cursor, targets[i], sample
            )
            out[i] = self._evaluate_beside_change_point(formula, q, rows[i], sample)
            error = None if np.isfinite(out[i]).all() else self.singular_mass_error(q, sample)
            if error is not None and formula.solves_mass_matrix:
                raise error

        run_with_fallback(
            len(targets),
            lambda i: formula.evaluate_targets(targets[i:], rows[i:], out[i:]),
            reach,
        )
        return out
