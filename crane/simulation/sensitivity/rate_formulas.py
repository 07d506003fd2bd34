"""State rate of a simulated machine as formulas of its state and of all its constants."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from crane.closure.kinematics_formulas import FormulaConstants, folding_pattern
from crane.codegen import FormulaTooLongError, Program, Scalar, SymbolicExpression, Tape
from crane.codegen.differentiation import directional_derivative
from crane.codegen.symbolic import (
    add_vectors,
    apply_function,
    dot,
    matvec,
    subtract_vectors,
    transpose,
)
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control.valve_drive import ValveDrive
from crane.description.sensors import FORCE_SUFFIX, INCLINATION_PREFIX, VELOCITY_SUFFIX
from crane.dynamics.external_forces import reference_counts
from crane.machine.machine import Machine
from crane.simulation.integration.charts import Chart
from crane.simulation.integration.machine_formulas import (
    AT_REST_SUFFIX,
    MachineFormulas,
    controller_formula_key,
    machine_program,
    reference_count,
    trace_machine,
)  # fmt: skip
from crane.simulation.sensitivity.simulation_constants import FRAME_SIZE, SimulationConstants


@dataclass(frozen=True)
class DifferentiatedFormulas:
    """Formulas that are differentiated, on one tape.

    Attributes:
        tape: The tape; its arguments are geometry, constants of the dynamics, settings, frames,
            references, state.
        machine: The machine at the state.
        rate: (m,) rate of the minimal state.
        outputs: Outputs, each with a factor of its derivative.
        transition_margin: See `StickSlipAccelerations.transition_margin`.
    """

    tape: Tape
    machine: MachineFormulas
    rate: list[Scalar]
    outputs: list[tuple[Scalar, Scalar]]
    transition_margin: Scalar

    @property
    def all_values(self) -> list[Scalar]:
        """Rate, outputs and transition margin, which are differentiated."""
        return [*self.rate, *(value for value, _ in self.outputs), self.transition_margin]


class RateProgram:
    """Base class of compiled derivatives of the state rate of a machine.

    A subclass implements `_add_derivatives`, which adds its formulas and routines, with and
    without joints at rest.

    Args:
        chart: The machine in the coordinates of the user.
        stiff_state_count: Number of the first ones, on which the rates depend.
        outputs: Names of the outputs, see `sensitivities`.
        variable_constants: Nonzero for constants that change.

    Attributes:
        state_size: Length of the minimal state.
        outputs: Names of the outputs.

    Raises:
        InputError: An output is unknown, or the formulas are too long.
    """

    def __init__(
        self,
        chart: Chart,
        stiff_state_count: int,
        outputs: Sequence[str],
        variable_constants: SimulationConstants,
    ):
        control = chart.control
        self._chart, self._control, self.outputs = chart, control, tuple(outputs)
        self._stiff_state_count, self._variable_constants = stiff_state_count, variable_constants
        machine = chart.machine
        self._mobility = len(machine.active)
        self._state_layout = chart.state_layout
        self.state_size = 2 * self._mobility + stiff_state_count
        self._reference_columns = reference_count(control) + sum(
            reference_counts(machine.external_forces)
        )
        self._frames = observed_frames(machine, outputs)
        # zeros among the settings are features that a circuit does not have
        constants = (
            machine.closure.compiled_closure.geometry.constants, chart.dynamics.constant_pattern,
            control.settings,
        )  # fmt: skip
        geometry, dynamics_constants, self._folded_settings = (
            np.where(is_variable != 0, np.nan, part)
            for is_variable, part in zip(variable_constants, constants, strict=False)
        )
        self._folded_constants = geometry, dynamics_constants
        key = (
            type(self).__name__,
            controller_formula_key(chart, True),
            chart.controller_state_count,
            stiff_state_count,
            *chart.formula_key,
            self.outputs,
            *self._frames,
            *map(folding_pattern, (*self._folded_constants, self._folded_settings)),
            *(np.asarray(part != 0).tobytes() for part in variable_constants[:5]),
        )
        try:
            self._program = machine_program(chart, key, self._build)
        except FormulaTooLongError:
            raise InputError(
                f"the formulas of '{machine.name}' are too long to differentiate: lock joints"
            ) from None

    def evaluate_rate(
        self, constants: SimulationConstants, state: Array, has_joints_at_rest: bool
    ) -> Array:
        """The rate (m,) of the minimal state.

        Args:
            constants: Constants of the simulation, with stick-slip modes (see
                `Dynamics.set_stick_slip_modes`) and one row of references.
            state: The integrated state.
            has_joints_at_rest: Whether a joint is at rest.
        """
        out = np.empty(self.state_size)
        self._program.call(
            "rate" + AT_REST_SUFFIX * has_joints_at_rest,
            *constants[:5],
            state,
            out,
        )
        return out

    def _add_routine(
        self, program: Program, name: str, formula: str, widths: Mapping[str, tuple[str, int]]
    ) -> None:
        """Add a routine that calls a formula several times for each of some states.

        Args:
            program: The program.
            name: Name of the routine.
            formula: Name of the formula; its first arguments are constants, references, state.
            widths: Length of the rows of each further array, and what has a row: the "repetition",
                or "both" that and the state.
        """
        constants = ("geometry", "constants", "settings", "frames")
        widths = {
            "references": ("state", self._reference_columns),
            "states": ("state", self._state_layout.size),
        } | dict(widths)
        with program.add_routine(
            name, counts=("count", "repetitions"), arrays=((*constants, *widths))
        ) as r:
            with r.loop(r.count) as i, r.loop(r.repetitions) as j:
                rows = {"state": i, "repetition": j, "both": i * r.repetitions + j}
                r.call(
                    formula,
                    *(getattr(r, x) for x in constants),
                    *(getattr(r, x).row_pointer(rows[y], n) for x, (y, n) in widths.items()),
                )
            r.return_value(r.count)

    def _add_derivatives(
        self, program: Program, suffix: str, formulas: DifferentiatedFormulas
    ) -> None:
        raise NotImplementedError

    def _build(self, program: Program) -> None:
        for added, rest in (("", False), (AT_REST_SUFFIX, True)):
            if rest and not self._chart.stick_slip.columns:
                continue
            rated = self._trace_formulas(rest)
            self._add_derivatives(program, added, rated)
            program.add_formula("rate" + added, 6, rated.rate)

    def _trace_formulas(self, with_joints_at_rest: bool) -> DifferentiatedFormulas:
        tape = Tape()
        references = tape.load_vector(4, 0, self._reference_columns)
        constants = FormulaConstants(tape, 2, self._folded_settings)
        machine = trace_machine(
            self._chart,
            tape,
            5,
            references,
            constants.vector(0, len(self._folded_settings)),
            self._folded_constants,
        )
        channels = (
            self._control.channel_values(machine.inputs)
            if isinstance(self._control, ValveDrive)
            else []
        )
        accelerations = machine.accelerations(with_joints_at_rest)
        rate = [
            *machine.dynamics_formulas.v_a,
            *accelerations.a_a,
            *machine.controller_rate[: self._stiff_state_count],
        ]
        observed = [self._trace_output(name, machine, tape, channels) for name in self.outputs]
        return DifferentiatedFormulas(
            tape, machine, rate, observed, accelerations.transition_margin
        )

    def _trace_output(
        self,
        name: str,
        machine: MachineFormulas,
        tape: Tape,
        channel_formulas: Sequence[Scalar],
    ) -> tuple[Scalar, Scalar]:
        """An output and a factor of its derivative; for names see `sensitivities`."""
        user_machine, control, dynamics = (
            self._chart.machine,
            self._control,
            machine.dynamics_formulas,
        )
        columns = {joint: i for i, joint in enumerate(user_machine.joints)}
        if name in columns:
            return dynamics.q[columns[name]], 1.0
        joint = name.removesuffix(VELOCITY_SUFFIX)
        if joint in columns:
            return dynamics.joint_velocities[columns[joint] + 1], 1.0
        joint = name.removesuffix(FORCE_SUFFIX)
        if joint in user_machine.active:
            return machine.tau[user_machine.active.index(joint)], 1.0
        if isinstance(control, ValveDrive):
            channels = [channel for channel, _ in control.channels]
            if name in channels:
                return channel_formulas[channels.index(name)], 1.0
        if name in ("kinetic", "potential"):
            return getattr(dynamics, name), 1.0
        links, link = [link for link, _ in self._frames], observed_frame(user_machine, name)
        if not name.startswith((INCLINATION_PREFIX, "tip_")) or link not in links:
            raise InputError(
                f"'{name}' is no output of '{user_machine.name}': take joints, forces, channels"
            )
        # the position of the tip, or the inclination of the x axis of a link and its rate
        place, kinematics = links.index(link), dynamics.kinematics
        frame_constants = tape.load_vector(3, FRAME_SIZE * place, FRAME_SIZE)
        body = self._frames[place][1]
        origin, rotation = kinematics.origin[body], kinematics.rotation[body]
        if not name.startswith(INCLINATION_PREFIX):
            position = add_vectors(origin, matvec(rotation, frame_constants[:3]))
            relative = subtract_vectors(position, kinematics.origin[0])
            return matvec(transpose(kinematics.rotation[0]), relative)["xyz".index(name[-1])], 1.0
        axis = matvec(rotation, frame_constants[3:6])
        height = dot(axis, matvec(kinematics.rotation[0], frame_constants[6:]))
        flat = apply_function("sqrt", 1.0 - height * height)
        if not name.endswith(VELOCITY_SUFFIX):
            return height, 1.0 / flat
        coordinates = map(operation_index, dynamics.q)
        rates = dict(zip(coordinates, dynamics.coordinate_derivatives, strict=True))
        return directional_derivative([height], rates)[0] / flat, 1.0


def observed_frame(machine: Machine, name: str) -> str:
    """The link of an output that is a position or inclination."""
    link = name.removeprefix(INCLINATION_PREFIX)
    return str(machine.tip) if link == name else link.removesuffix(VELOCITY_SUFFIX)


def observed_frames(machine: Machine, outputs: Sequence[str]) -> list[tuple[str, int]]:
    """Links whose position or inclination is an output, and their bodies.

    Raises:
        InputError: An output is unknown.
    """
    found: dict[str, int] = {}
    tips = {f"tip_{axis}" for axis in "xyz"} if machine.tip is not None else set()
    for name in outputs:
        if name in tips or name.startswith(INCLINATION_PREFIX):
            link = observed_frame(machine, name)
            found[link] = machine.coordinates.body_of_joint[
                int(machine.model.frames[machine.frame(link)].parentJoint)
            ]
    return list(found.items())


def operation_index(argument: Scalar) -> int:
    """Index of the operation that loads a value."""
    assert isinstance(argument, SymbolicExpression)
    return argument.index
