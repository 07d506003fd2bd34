"""A machine as one program for any target: an array with all that changes, and its routines.

The array is an instance of the machine. It has parameters, inputs, state and outputs, see
`InstanceProgram.layout`, so that an instance is copied, saved and restored by copying numbers, and
any number of them may be used at once. The routines return a status, 1 for success.
"""

import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cached_property
from types import MappingProxyType

import numpy as np

from crane.codegen import FormulaTooLongError, Layout, Program, Scalar, SymbolicExpression
from crane.codegen.differentiation import directional_derivative
from crane.codegen.vector_layout import Formula
from crane.common.errors import CraneWarning, InputError
from crane.common.samples import Array
from crane.control.control_law import ControlLaw, Controller
from crane.control.force_inputs import ForceInputs
from crane.control.valve_commands import ValveCommand, ValveSignals
from crane.control.valve_drive import ValveDrive
from crane.description.external_forces import TIP_WRENCH_NAME, Wrench
from crane.dynamics.compiled_dynamics import DERIVATIVES_OF, build_quantity
from crane.dynamics.dynamics import Dynamics
from crane.dynamics.formula_structure import BODY_SIZE, FormulaStructure
from crane.dynamics.joint_forces import LAW_PARAMETER_NAMES, PARAMETER_COUNT
from crane.export.dead_times import dead_time_row
from crane.export.instance_routines import InstanceRoutines
from crane.export.kinematics_program import KinematicsProgram, compiled_loops
from crane.export.parameter_names import instance_elements, named_elements
from crane.machine.machine import Machine
from crane.motion.frame_kinematics import CompiledFrame
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.error_controlled_stepper import (
    DormandPrinceStepper,
    ErrorControlledStepper,
)
from crane.simulation.integration.machine_code_stepper import RungeKuttaStepper
from crane.simulation.integration.rosenbrock import RosenbrockStepper
from crane.simulation.simulation_setup import machine_under_control, resolve_controller

SINGLE_PRECISION_TOLERANCE = 1e-4  # of a step
_SHARPNESS = 1e3  # of friction that is 0 in the machine file, one over its smoothing velocity
MAX_STEPS, MAX_EVENTS = 10_000, 200  # of one call of `advance`, by default
_DELAYED_STEP = 1e-3  # shortest steps of which a dead time remembers all [s]
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


def _exported_control(
    machine: Machine, controller: Controller | ValveCommand | None
) -> ControlLaw:
    """The law of an instance: a given one, or one whose references are forces or signals.

    Raises:
        InputError: It is computed in Python.
    """
    if controller is None:
        if machine.hydraulics is None:
            return ForceInputs(machine)
        return ValveDrive(machine, ValveSignals(machine, [0.0], {}))
    control = resolve_controller(controller, machine)
    name = type(controller).__name__
    drive = control if isinstance(control, ValveDrive) else None
    if not isinstance(control, ControlLaw) or (drive and drive.command.period):
        raise InputError(
            f"{name} is computed in Python, which no other target has: give a crane.control."
            "ControlLaw, or a ValveCommand without a period"
        )
    if drive and drive.period:
        raise InputError(
            f"{name} with valves that have a dead time is computed in Python, which no other "
            "target has: set their delay to 0"
        )
    if drive and drive.command.has_measured_pressures:
        raise InputError(
            f"{name} has measured pressures, which are no inputs of a program: leave them out"
        )
    return control


class InstanceProgram(KinematicsProgram):
    """A machine with its drives as one program.

    The inputs are the forces of the drives [N], [N m], or the signals at the valves [V] of a
    machine with a circuit, or the references of a controller; then force [N] and moment [N m] at
    the tip, in the axes of the world.

    Args:
        machine: The machine.
        quantities: Routines of `DYNAMICS_ROUTINES` to include; all by default.
        variants: The machine with other parameters. What differs between them stays an element of
            the instance, where numbers such as 0 are else part of the formulas.
        controller: Control law or valve command, as for `simulate`. Its references at time 0 are
            the defaults of the inputs; its settings are parameters, and its states states.
        has_derivatives: Whether to include directional derivatives of rates and outputs, where
            they are not too long.

    Attributes:
        machine: The machine, with the wrench at its tip.
        control: What turns the inputs into forces.
        chart: The machine with `control`.
        stepper: The method of `advance`.
        quantities: Its quantities by routine.
        layout: Parts of an instance.
        names: Name of each element of an instance.
        units: Unit of each.
        defaults: An instance at home, not initialized.
        variant_defaults: The same of each of `variants`.
        entries: Routines by name; each takes an instance, and further arrays.
        functions: All linked functions, each after what it calls.

    Raises:
        InputError: The formulas are too long, a load or the controller is a function in Python, or
            a variant has other formulas.
    """

    def __init__(
        self,
        machine: Machine,
        quantities: Sequence[str] = tuple(DYNAMICS_ROUTINES),
        variants: Sequence[Machine] = (),
        controller: Controller | ValveCommand | None = None,
        has_derivatives: bool = False,
    ):
        self._has_derivatives = has_derivatives
        self.chart = _controlled_chart(machine, controller)
        self.machine, self.control = machine, control = self.chart.machine, self.chart.control
        dynamics = self.chart.dynamics
        others = [_controlled_chart(x, controller) for x in variants]
        for other in others:
            if other.dynamics.formula_structure != dynamics.formula_structure:
                raise InputError(f"a variant of '{machine.name}' has bodies of another kind")
            changes = other.dynamics.formula_constants != dynamics.formula_constants
            dynamics.constant_pattern[changes] = np.nan
        is_valve_drive = isinstance(control, ValveDrive)
        self._stepper_class = RosenbrockStepper if is_valve_drive else DormandPrinceStepper
        self.stepper = self._make_stepper(self.chart)
        self.quantities = {name: DYNAMICS_ROUTINES[name] for name in quantities}
        self._closure = machine.closure.compiled_closure
        self.layout = self._make_layout()
        self.output_count = self.chart.output_layout.size
        self.names, self.units = named_elements(self.layout, instance_elements(self))
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
        stepper, inputs, control = self.stepper, self.stepper.reference_columns, self.control
        spools, rows = 0, 0
        if isinstance(control, ValveDrive) and control.delays.any():
            spools, rows = len(control.delays), int(control.delays.max() / _DELAYED_STEP) + 4
        return Layout(
            time=1, step=1, inputs_start=inputs, inputs=inputs,
            **self.chart.state_layout.parts, **self.chart.output_layout.parts,
            cursor=self._closure.new_cursor().state.size, lengths=7, bounds=6,
            tolerances=stepper.tolerance.size, max_events=1,
            geometry=self._closure.geometry.constants.size,
            dynamics=self.chart.dynamics.formula_constants.size,
            settings=control.settings.size, delays=spools, history=rows * dead_time_row(spools),
            unladen=BODY_SIZE if self.chart.dynamics.formula_structure.tip_inertia else 0,
        )  # fmt: skip

    def _default_instance(self, chart: Chart) -> Array:
        values = np.zeros(self.layout.size)
        at, dynamics, machine = self.layout.view(values), chart.dynamics, chart.machine
        closure, stepper = machine.closure.compiled_closure, self._make_stepper(chart)
        structure = dynamics.formula_structure
        chart.stick_slip.slip_signs[:] = 0.0
        chart.stick_slip.apply_to(dynamics)
        at.step[:], at.max_events[:] = 1e-3, MAX_EVENTS
        at.q[:] = machine.home
        at.cursor[:] = closure.new_cursor().state
        at.lengths[5] = MAX_STEPS
        at.bounds[:], at.tolerances[:] = stepper.bounds, stepper.tolerance
        at.geometry[:] = closure.geometry.constants
        at.dynamics[:], at.settings[:] = dynamics.formula_constants, chart.control.settings
        smoothed = sorted({*machine.closure.active.tolist()} - {*structure.stick_slip_columns})
        sharpness = _law_indices(structure, smoothed, "sharpness")
        at.dynamics[sharpness] = np.minimum(at.dynamics[sharpness], _SHARPNESS)
        at.unladen[:] = at.dynamics[structure.tip_inertia]
        references = chart.control.references(np.zeros(1))[0]
        at.inputs[: len(references)] = at.inputs_start[: len(references)] = references
        if at.delays.size:
            at.delays[:] = chart.control.delays
            calls = at.history.reshape(-1, dead_time_row(at.delays.size))
            calls[:, 0], calls[:, 1:] = np.arange(1 - len(calls), 1), np.tile(references, 2)
        return values

    @property
    def single_precision_defaults(self) -> Array:
        """`defaults` with tolerances that single precision reaches."""
        values = super().single_precision_defaults
        stepper = self._stepper_class(self.chart, SINGLE_PRECISION_TOLERANCE)
        self.layout.view(values).tolerances[:] = stepper.tolerance
        return values

    @cached_property
    def tip_frame(self) -> CompiledFrame | None:
        """The tip; None without one."""
        tip = self.machine.tip
        return None if tip is None else CompiledFrame(self.machine, self.machine.frame(tip))

    @cached_property
    def programs(self) -> dict[str, Program]:
        """Programs of the parts of the machine, by the prefix of their functions."""
        dynamics, programs = self.chart.dynamics, {"loops": self._closure.new_program()}
        for name, quantity in self.quantities.items():
            program = Program()
            try:
                build_quantity(
                    program, quantity, self._closure, dynamics.constant_pattern,
                    len(self.machine.active),
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
        excluded = self.has_dead_times or self.machine.coordinates.rotation_columns
        if self._has_derivatives and not excluded:
            with suppress(FormulaTooLongError):
                programs["tangent"] = self._trace_derivatives(programs["steps"])
        if self.tip_frame is not None:
            programs["tip"] = self.tip_frame.new_program()
        if not isinstance(self.control, ValveDrive):
            programs["fixed"] = RungeKuttaStepper(self.chart).new_program()
        return programs

    def _trace_derivatives(self, steps: Program) -> Program:
        """rate(geometry, numbers, settings, refs, state, direction): of rate and outputs.

        The direction has the state, then the references.
        """
        program, layout = Program(), self.chart.state_layout
        for name in [x for x in steps.functions if x.startswith("rate")]:
            formulas = (steps.functions[x] for x in (name, name.replace("rate", "observe")))
            sizes = layout.size, self.chart.output_layout.size
            pairs = zip(formulas, sizes, strict=True)
            outputs = [x for f, size in pairs if isinstance(f, Formula) for x in f.outputs[:size]]
            tape = next(x.tape for x in outputs if isinstance(x, SymbolicExpression))
            places = [(4, i) for i in range(layout.size)]
            places += [(3, i) for i in range(self.stepper.reference_columns)]
            seeds: dict[int, Scalar] = {
                tape.load(*place).index: tape.load(5, i) for i, place in enumerate(places)
            }
            program.add_formula(name, 6, directional_derivative(outputs, seeds))
        return program

    @cached_property
    def routines(self) -> InstanceRoutines:
        """The writer of its routines."""
        return InstanceRoutines(self)

    @property
    def has_dead_times(self) -> bool:
        """Whether valves have dead times."""
        return self.layout.parts["delays"] > 0


def _controlled_chart(machine: Machine, controller: Controller | ValveCommand | None) -> Chart:
    """A machine with a wrench at its tip and its drives.

    Raises:
        InputError: It cannot be exported.
    """
    loads = [] if machine.tip is None else [Wrench(machine.tip, name=TIP_WRENCH_NAME)]
    machine = machine.with_external_forces(*loads)
    control = _exported_control(machine, controller)
    machine = machine_under_control(machine, control)
    compiled_loops(machine)
    if not machine.has_traceable_forces:
        raise InputError(
            f"a load of '{machine.name}' is a function in Python, which no other target has: "
            "give a crane.Wrench"
        )
    states = len(control.start(machine.home[machine.closure.active]))
    dynamics, active = Dynamics(machine), machine.closure.active.tolist()
    parameters = _parameter_indices(dynamics.formula_structure, active)
    dynamics.constant_pattern[parameters] = np.nan
    return Chart.from_dynamics(dynamics, control, states)


def _law_indices(structure: FormulaStructure, columns: Iterable[int], field: str) -> list[int]:
    """Indices in `dynamics_constants` of a value of the force laws of joints."""
    start = structure.constants_layout.start_index("joint_laws") + LAW_PARAMETER_NAMES.index(field)
    return [start + PARAMETER_COUNT * column for column in columns]


def _parameter_indices(structure: FormulaStructure, active: Iterable[int]) -> list[int]:
    """Indices in `dynamics_constants` of what stays a parameter where it is 0, 1 or -1."""
    joints = range(len(structure.motion_parents) - 1)
    return [
        *structure.constants_layout.indices("gravity"),
        *structure.tip_inertia,
        *_law_indices(structure, active, "coulomb"),
        *_law_indices(structure, joints, "coulomb_offset"),
        *_law_indices(structure, joints, "viscous"),
    ]
