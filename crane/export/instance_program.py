"""A machine as one program for any target: an array with all that changes, and its routines.

The array is an instance of the machine. It has parameters, inputs, state and outputs, see
`InstanceProgram.layout`, so that an instance is copied, saved and restored by copying numbers, and
any number of them may be used at once. The routines return a status, 1 for success.
"""

import warnings
from collections.abc import Sequence
from functools import cached_property
from types import MappingProxyType

import numpy as np

from crane.codegen import (
    FormulaTooLongError,
    Layout,
    Program,
    Routine,
)
from crane.codegen.linked_functions import LinkedFunction, link_functions
from crane.common.errors import CraneWarning, InputError
from crane.common.samples import Array
from crane.control.force_inputs import ForceInputs
from crane.control.valve_commands import ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.description.external_forces import Wrench
from crane.dynamics.compiled_dynamics import DERIVATIVES_OF, build_quantity
from crane.dynamics.dynamics import Dynamics
from crane.export.instance_routines import INNER_ROUTINES, InstanceRoutines
from crane.export.parameter_names import parameter_names
from crane.machine.machine import Machine
from crane.motion.frame_kinematics import CompiledFrame
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    DormandPrinceStepper,
    ErrorControlledStepper,
)
from crane.simulation.integration.machine_code_stepper import RungeKuttaStepper
from crane.simulation.integration.rosenbrock import RosenbrockStepper
from crane.simulation.simulation_setup import machine_under_control

TIP_WRENCH_NAME = "tip"
SINGLE_PRECISION_TOLERANCE = 1e-4  # of a step
# over those of double precision: residuals of rounding, of closed loops; last step of Newton
_SINGLE_PRECISION_BOUNDS = np.array([1e9, 1e8, 1e6])
MAX_STEPS, MAX_EVENTS = 10_000, 200  # of one call of `advance`, by default
DYNAMICS_ROUTINES = MappingProxyType(
    {
        "inverse_dynamics": "inverse",
        "inverse_dynamics_with_friction": "inverse with friction",
        "forward_dynamics": "forward",
        "forward_dynamics_with_friction": "forward with friction",
        "mass_matrix": "mass matrix",
        "bias": "bias",
        "gravity": "gravity",
        "energy": "energy",
        "regressor": "regressor",
        "inverse_dynamics_derivatives": DERIVATIVES_OF + "inverse",
        "forward_dynamics_derivatives": DERIVATIVES_OF + "forward",
    }
)


class InstanceProgram:
    """A machine with its drives as one program.

    The inputs are the forces of the drives [N], [N m], or the signals at the valves [V] of a
    machine with a circuit; then force [N] and moment [N m] at the tip, in the axes of the world.

    Args:
        machine: The machine.
        quantities: Routines of `DYNAMICS_ROUTINES` to include; all by default.
        variants: The machine with other parameters. What differs between them stays an element of
            the instance, where numbers such as 0 are else part of the formulas.

    Attributes:
        machine: The machine, with the wrench at its tip.
        control: What turns the inputs into forces.
        chart: The machine with `control`.
        stepper: The method of `advance`.
        layout: Parts of an instance, see `part_texts`.
        names: Name of each element of an instance.
        units: Unit of each.
        defaults: An instance at home, not initialized.
        variant_defaults: The same of each of `variants`.
        entries: Routines by name; each takes an instance, and further arrays.
        functions: All linked functions, each after what it calls.

    Raises:
        InputError: The formulas are too long, a load is a function in Python, or a variant has
            other formulas.
    """

    def __init__(
        self,
        machine: Machine,
        quantities: Sequence[str] = tuple(DYNAMICS_ROUTINES),
        variants: Sequence[Machine] = (),
    ):
        self.chart = _controlled_chart(machine)
        self.machine, self.control = machine, control = self.chart.machine, self.chart.control
        dynamics, others = self.chart.dynamics, [_controlled_chart(x) for x in variants]
        for other in others:
            if other.dynamics.formula_structure != dynamics.formula_structure:
                raise InputError(f"a variant of '{machine.name}' has bodies of another kind")
            changes = other.dynamics.formula_constants != dynamics.formula_constants
            dynamics.constant_pattern[changes] = np.nan
        is_valve_drive = isinstance(control, ValveDrive)
        self._stepper_class = RosenbrockStepper if is_valve_drive else DormandPrinceStepper
        self.stepper = self._make_stepper(self.chart)
        self._quantities = {name: DYNAMICS_ROUTINES[name] for name in quantities}
        self._nq, self._n = machine.model.nv, len(machine.active)
        self._k = len(self.chart.stick_slip.columns)
        self._closure = machine.closure.compiled_closure
        self.layout = self._make_layout()
        self.names, self.units = parameter_names(self)
        self.defaults = self._default_instance(self.chart)
        self.variant_defaults = []
        for other in others:  # of the same formulas
            other.dynamics.constant_pattern[:] = dynamics.constant_pattern
            self.variant_defaults.append(self._default_instance(other))

    def _make_stepper(self, chart: Chart) -> ErrorControlledStepper:
        try:
            return self._stepper_class(chart)
        except FormulaTooLongError as error:
            raise InputError(
                f"'{self.machine.name}' has {error.operation_count:,} operations in a step, which "
                "is too long to export: leave bodies out"
            ) from None

    def _make_layout(self) -> Layout:
        stepper, inputs = self.stepper, self.stepper.reference_columns
        return Layout(
            time=1, step=1, inputs_start=inputs, inputs=inputs,
            **self.chart.state_layout.parts, **self.chart.output_layout.parts,
            cursor=self._closure.new_cursor().state.size, lengths=7, bounds=6,
            tolerances=stepper.tolerance.size, max_events=1,
            geometry=self._closure.geometry.constants.size,
            dynamics=self.chart.dynamics.formula_constants.size,
            settings=self.control.settings.size,
        )  # fmt: skip

    def _default_instance(self, chart: Chart) -> Array:
        values = np.zeros(self.layout.size)
        at, dynamics, machine = self.layout.view(values), chart.dynamics, chart.machine
        closure, stepper = machine.closure.compiled_closure, self._make_stepper(chart)
        chart.stick_slip.slip_signs[:] = 0.0
        chart.stick_slip.apply_to(dynamics)
        at.step[:], at.max_events[:] = 1e-3, MAX_EVENTS
        at.q[:] = machine.home
        at.cursor[:] = closure.new_cursor().state
        at.lengths[5] = MAX_STEPS
        at.bounds[:], at.tolerances[:] = stepper.bounds, stepper.tolerance
        at.geometry[:] = closure.geometry.constants
        at.dynamics[:], at.settings[:] = dynamics.formula_constants, chart.control.settings
        if isinstance(chart.control, ValveDrive):
            neutral = [x.neutral for x in chart.control.circuit.hydraulics.spools.values()]
            at.inputs[: len(neutral)] = at.inputs_start[: len(neutral)] = neutral
        return values

    @cached_property
    def single_precision_defaults(self) -> Array:
        """`defaults` with tolerances that single precision reaches."""
        values = self.defaults.copy()
        at = self.layout.view(values)
        at.bounds[:3] *= _SINGLE_PRECISION_BOUNDS
        at.tolerances[:] = self._stepper_class(self.chart, SINGLE_PRECISION_TOLERANCE).tolerance
        return values

    @cached_property
    def _tip(self) -> CompiledFrame | None:
        tip = self.machine.tip
        return None if tip is None else CompiledFrame(self.machine, self.machine.frame(tip))

    @cached_property
    def _programs(self) -> dict[str, Program]:
        """Programs of the parts of the machine."""
        dynamics, programs = self.chart.dynamics, {"loops": self._closure.new_program()}
        for name, quantity in self._quantities.items():
            program = Program()
            try:
                build_quantity(
                    program, quantity, self._closure, dynamics.constant_pattern, self._n,
                    dynamics.formula_structure,
                )  # fmt: skip
            except FormulaTooLongError as error:
                warnings.warn(
                    f"'{name}' is left out, it has {error.operation_count:,} operations",
                    CraneWarning,
                    stacklevel=2,
                )
                continue
            programs[name] = program
        programs["steps"] = self.stepper.new_program()
        if self._tip is not None:
            programs["tip"] = self._tip.new_program()
        if isinstance(self.control, ForceInputs):
            programs["fixed"] = RungeKuttaStepper(self.chart).new_program()
        return programs

    @cached_property
    def _linked(self) -> tuple[dict[str, LinkedFunction], list[LinkedFunction]]:
        programs = {name: dict(program.functions) for name, program in self._programs.items()}
        own = Program()
        for prefix, parts in programs.items():
            own.functions |= {f"{prefix}_{name}": x for name, x in parts.items()}
        known = {*own.functions, *INNER_ROUTINES}
        offset = None if self._tip is None else self._tip.frame_offset
        InstanceRoutines(
            self.chart, self.stepper, self.layout, self._programs,
            [name for name in self._quantities if name in self._programs], offset,
        ).add_to(own)  # fmt: skip
        programs["machine"] = own.functions
        entries = [
            name
            for name, function in own.functions.items()
            if name not in known and isinstance(function, Routine)
        ]
        close = "project" if self._closure.has_partly_active_rotations else "close"
        bindings = {"close": ("loops", close), "follow": ("loops", "follow")}
        functions = link_functions(programs, [("machine", x) for x in entries], bindings)
        by_name = {x.name: x for x in functions}
        return {x: by_name[f"machine_{x}"] for x in entries}, functions

    @property
    def entries(self) -> dict[str, LinkedFunction]:
        """Routines by name; each takes an instance, and further arrays."""
        return self._linked[0]

    @property
    def functions(self) -> list[LinkedFunction]:
        """All linked functions, each after what it calls."""
        return self._linked[1]


def _controlled_chart(machine: Machine) -> Chart:
    """A machine with a wrench at its tip and its drives.

    Raises:
        InputError: It cannot be exported.
    """
    loads = [] if machine.tip is None else [Wrench(machine.tip, name=TIP_WRENCH_NAME)]
    machine = machine.with_external_forces(*loads)
    control: ForceInputs | ValveDrive
    if machine.hydraulics is None:
        control = ForceInputs(machine)
    else:
        control = ValveDrive(machine, ValveSignals(machine, [0.0], {}))
    machine = machine_under_control(machine, control)
    if not machine.closure.is_compiled:
        raise InputError(f"the loops of '{machine.name}' have no formulas to export")
    if isinstance(control, ValveDrive) and control.delays.any():
        raise InputError(
            f"valves of '{machine.name}' have a dead time, which is not exported: set delay "
            "to 0, or delay the signals before"
        )
    if not machine.has_traceable_forces:
        raise InputError(
            f"a load of '{machine.name}' is a function in Python, which no other target has: "
            "give a crane.Wrench"
        )
    states = control.circuit.state_count if isinstance(control, ValveDrive) else 0
    return Chart.from_dynamics(Dynamics(machine), control, states)
