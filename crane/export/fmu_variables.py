"""Variables of an FMU: an instance of a machine, then what is computed from it."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from crane.codegen.vector_layout import Formula, Layout
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.common.unit_conversions import unit_dimension
from crane.control.valve_drive import ValveDrive
from crane.export.instance_program import InstanceProgram
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.simulation.integration.error_controlled_stepper import (
    MIN_SCALE,
    characteristic_energy,
    error_tolerances,
)
from crane.simulation.integration.machine_formulas import AT_REST_SUFFIX

# kinds of variables, and their attributes in FMI
INPUT, TUNABLE, FIXED, STATE_START, GUESS, OUTPUT, LOCAL, TIME = "iufsgolt"
_ATTRIBUTES = {
    TIME: {"causality": "independent", "variability": "continuous"},
    INPUT: {"causality": "input", "variability": "continuous"},
    TUNABLE: {"causality": "parameter", "variability": "tunable"},
    FIXED: {"causality": "parameter", "variability": "fixed"},
    STATE_START: {"causality": "output", "variability": "continuous", "initial": "exact"},
    GUESS: {"causality": "output", "variability": "continuous", "initial": "approx"},
    OUTPUT: {"causality": "output", "variability": "continuous", "initial": "calculated"},
    LOCAL: {"causality": "local", "variability": "continuous", "initial": "calculated"},
}
_KINDS = {
    "time": TIME, "inputs": INPUT, "v_a": OUTPUT, "contacts": LOCAL, "controller": LOCAL,
    "work": OUTPUT, "dissipated": OUTPUT, "tau": OUTPUT, "friction": OUTPUT, "kinetic": OUTPUT,
    "potential": OUTPUT, "friction_at_rest": OUTPUT, "external": OUTPUT, "a": OUTPUT,
    "channels": OUTPUT, "derivatives": LOCAL, "event": LOCAL, "tip_position": OUTPUT,
    "delays": TUNABLE, "payload": TUNABLE,
}  # fmt: skip
_TUNABLE_DYNAMICS = ("inertias", "joint_laws", "gravity", "rotor_inertias", "distances")
_STATE_ACCURACY = 1e-8  # share of a state of a circuit that its scale stands for
_BASE_UNITS = {
    "[length]": {"m": 1}, "[mass]": {"kg": 1}, "[time]": {"s": 1}, "[angle]": {"rad": 1},
    "[voltage]": {"kg": 1, "m": 2, "s": -3, "A": -1},
}  # fmt: skip


class FmuVariable(NamedTuple):
    """A variable of an FMU.

    Attributes:
        reference: Its value reference: its index.
        name: Structured name, such as `X_lift.stroke`.
        unit: SI unit; "" without one.
        kind: See the constants of this module.
        start: Its start value.
        state: Value reference of the state that it is the derivative of; -1 for others.
    """

    reference: int
    name: str
    unit: str
    kind: str
    start: float = 0.0
    state: int = -1

    @property
    def attributes(self) -> dict[str, str]:
        """Causality, variability, and where it has one, initial value."""
        return _ATTRIBUTES[self.kind]

    @property
    def has_start(self) -> bool:
        """Whether it may be set."""
        return self.kind in (INPUT, TUNABLE, FIXED, STATE_START, GUESS)


class FmuVariables:
    """All variables of the FMU of a machine.

    Args:
        program: The machine.

    Attributes:
        layout: Layout of all values: the instance, then derivatives of the continuous states,
            event indicators, position of the tip, mass of the payload.
        states: (s,) indices of the continuous states: active coordinates and what follows q.
        start: (values,) start values.
    """

    def __init__(self, program: InstanceProgram):
        self.program, machine, layout = program, program.machine, program.layout
        q, columns = layout.start_index("q"), machine.closure.active
        state_size = program.chart.state_layout.size
        self.states = [*(q + columns).tolist(), *range(q + machine.model.nv, q + state_size)]
        tip = 0 if program.tip_frame is None else 3
        events = sum(program.routines.event_parts.values())
        parts = {"derivatives": len(self.states), "event": events, "tip_position": tip}
        payload = min(1, layout.parts["unladen"])
        self.layout = Layout(**layout.parts, **parts, payload=payload)
        extra = self.layout.size - layout.size
        self.start = np.concatenate([program.defaults, np.zeros(extra)])

    @cached_property
    def variables(self) -> list[FmuVariable]:
        """The variables by value reference; names are unique."""
        taken: set[str] = set()
        found = []
        for variable in sorted(self._variables()):
            name = variable.name
            while name in taken:
                name += "_"
            taken.add(name)
            found.append(variable._replace(name=name))
        return found

    def _variables(self) -> Iterator[FmuVariable]:
        program, at = self.program, self.layout.start_index
        own_names, units = [*program.names], [*program.units]
        for i, j in zip(self.layout.indices("unladen"), self._tip_inertia, strict=True):
            own_names[i], units[i] = own_names[j], units[j]
        names = [*map(self._structured_name, own_names)]
        kinds = {i: kind for part, kind in _KINDS.items() for i in self.layout.indices(part)}
        kinds |= {i: STATE_START if i in self.states else GUESS for i in self.layout.indices("q")}
        kinds |= dict(self._parameters())
        for i in (i for i in kinds if i < program.layout.size):
            yield FmuVariable(i, names[i], units[i], kinds[i], float(self.start[i]))
        for i, state in enumerate(self.states):
            name, unit = f"der({names[state]})", _rate_unit(units[state])
            yield FmuVariable(at("derivatives") + i, name, unit, LOCAL, 0.0, state)
        for i, reference in enumerate(self.layout.indices("event")):
            yield FmuVariable(reference, f"event_indicator[{i + 1}]", "", LOCAL)
        for axis, reference in zip("xyz", self.layout.indices("tip_position"), strict=False):
            yield FmuVariable(reference, f"tip.position_{axis}", "m", OUTPUT)
        for reference in self.layout.indices("payload"):
            yield FmuVariable(reference, "payload.mass", "kg", TUNABLE)

    @property
    def _tip_inertia(self) -> range:
        """Indices of the inertia of the body of the tip with its payload."""
        start = self.layout.start_index("dynamics")
        found = self.program.chart.dynamics.formula_structure.tip_inertia
        return range(start + found.start, start + found.stop)

    def _parameters(self) -> Iterator[tuple[int, str]]:
        """Indices and kinds of the parameters that formulas read."""
        program, loads = self.program, self.program.loads
        dynamics = program.chart.dynamics.formula_structure.constants_layout
        start, tip = program.layout.start_index("dynamics"), self._tip_inertia
        for i in self.layout.indices("geometry"):
            if i in loads and "_position_" in program.names[i]:
                yield i, FIXED
        for part in _TUNABLE_DYNAMICS:
            first = start + dynamics.start_index(part)
            yield from ((i, TUNABLE) for i in range(first, first + dynamics.parts[part])
                        if i in loads and i not in tip)  # fmt: skip
        yield from ((i, TUNABLE) for i in self.layout.indices("unladen"))
        yield from ((i, TUNABLE) for i in self.layout.indices("settings") if i in loads)

    def _structured_name(self, name: str) -> str:
        """q_X_lift as X_lift.stroke, pressure_X_lift_a as X_lift.pressure_a."""
        machine = self.program.machine
        owners = [*machine.joints, *(force.name for force in machine.external_forces)]
        found = (re.search(rf"(?:^|_){re.escape(x)}(?:_|$)", name) for x in owners)
        match = max(filter(None, found), key=lambda x: len(x[0].strip("_")), default=None)
        if match is None:
            return _identifier(name)
        owner = match[0].strip("_") if match[0].strip("_") in owners else match[0]
        rest = "_".join(filter(None, (name[: match.start()], name[match.end() :]))) or "value"
        is_length = owner in machine.joints and machine.unit(owner) == "m"
        words = {
            "q": "stroke" if is_length else "angle", "v": "rate",
            "tau": "force" if is_length else "torque", "rest": "friction_at_rest",
        }  # fmt: skip
        return f"{_identifier(owner)}.{_identifier(words.get(rest, rest))}"

    @cached_property
    def nominals(self) -> Array:
        """(s,) sizes of the continuous states, by which an integrator weighs their errors."""
        chart, control = self.program.chart, self.program.control
        sizes = error_tolerances(chart, 1.0 / MIN_SCALE)[:-1]
        if isinstance(control, ValveDrive):
            energy = characteristic_energy(self.program.machine)
            balances = [energy if unit == "J" else 1e-3 for unit in BALANCE_UNITS.values()]
            scales = np.array(control.scales) / _STATE_ACCURACY
            scales[len(scales) - len(balances) :] = balances
            sizes[chart.state_layout["controller"]] = scales
        return sizes[np.array(self.states) - self.layout.start_index("q")]

    @cached_property
    def dependencies(self) -> dict[int, list[int]]:
        """Value references of states and inputs that outputs and derivatives depend on."""
        at, q = self.layout.start_index, self.layout.indices("q")
        active = {i for i in self.states if i in q}

        def closed(loads: set[tuple[int, int]]) -> set[int]:
            known = {at("inputs") + x for array, x in loads if array == 3}
            known |= {q.start + x for array, x in loads if array == 4}
            return known - {*q} | active if known & {*q} else known

        rates = [closed(x) for x in self._loads("rate")]
        found = {at("derivatives") + i: rates[x - q.start] for i, x in enumerate(self.states)}
        outputs = zip(range(self.program.output_count), self._loads("observe"), strict=False)
        found |= {at("tau") + i: closed(x) for i, x in outputs}
        found |= {i: active for i in (*q, *self.layout.indices("tip_position"))}
        found |= {i: {i} for i in self.states}
        return {i: sorted(x) for i, x in found.items()}

    def _loads(self, name: str) -> Iterator[set[tuple[int, int]]]:
        """Elements that each output of a formula of the steps reads, by argument."""
        functions = self.program.routines.step_functions
        found = (functions.get(x) for x in (name, name + AT_REST_SUFFIX))
        formulas = [x for x in found if isinstance(x, Formula)]
        for outputs in zip(*(x.outputs for x in formulas), strict=True):
            pairs = zip(formulas, outputs, strict=True)
            yield set().union(*(replace(x, outputs=[output]).loads for x, output in pairs))


def _rate_unit(unit: str) -> str:
    """The unit of a derivative: m/s2 of m/s, 1/s of "", m of m s."""
    if unit.endswith(" s"):
        return unit.removesuffix(" s")
    return f"{unit[:-2]}/s2" if unit.endswith("/s") else f"{unit or 1}/s"


def _identifier(name: str) -> str:
    """A part of a structured name, in quotes where it is no identifier."""
    if re.fullmatch(r"[A-Za-z_]\w*", name, flags=re.ASCII):
        return name
    text = re.sub(r"[^ -~]", "_", name).replace("\\", "_").replace("'", "_").replace('"', "_")
    return f"'{text}'"


def base_unit(unit: str) -> dict[str, int]:
    """Exponents of SI base units (and rad) of a unit such as `N m s/rad` or `N/(m s)`.

    Raises:
        InputError: It is unknown.
    """
    dimension = unit_dimension(unit)
    if dimension is None:
        raise InputError(f"unit '{unit}' is no unit of an FMU")
    total = Counter[str]()
    for name, exponent in dimension.items():
        for base, power in _BASE_UNITS[name].items():
            total[base] += int(exponent) * power
    return {base: power for base, power in total.items() if power}
