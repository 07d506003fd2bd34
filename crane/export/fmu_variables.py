"""Variables of an FMU: an instance of a machine, then what is computed from it."""

import re
from collections.abc import Iterator
from functools import cached_property, reduce
from operator import or_
from typing import NamedTuple

import numpy as np

from crane.codegen.symbolic import SymbolicExpression
from crane.codegen.vector_layout import Formula, Layout
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.control.valve_drive import ValveDrive
from crane.export.instance_program import InstanceProgram
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.simulation.integration.error_controlled_stepper import characteristic_energy

# kinds of variables: attributes of FMI
INPUT, TUNABLE, FIXED, STATE_START, GUESS, OUTPUT, LOCAL, TIME = "iufsgolt"
_KINDS = {
    "time": TIME, "inputs": INPUT, "v_a": OUTPUT, "contacts": LOCAL, "controller": LOCAL,
    "work": OUTPUT, "dissipated": OUTPUT, "tau": OUTPUT, "friction": OUTPUT, "kinetic": OUTPUT,
    "potential": OUTPUT, "friction_at_rest": OUTPUT, "external": OUTPUT, "a": OUTPUT,
    "channels": OUTPUT, "derivatives": LOCAL, "event": LOCAL, "tip_position": OUTPUT,
    "delays": TUNABLE, "payload": TUNABLE,
}  # fmt: skip
_TUNABLE_DYNAMICS = ("inertias", "joint_laws", "gravity", "rotor_inertias", "distances")
_STATE_ACCURACY = 1e-8  # share of a state of a circuit that its scale stands for
_SETTING_UNITS = {
    "area": "m2", "hose": "m3", "leakage": "m3/Pa/s", "relief": "Pa", "stroke": "m",
    "lower_limit": "m", "margin": "Pa", "neutral": "V", "vapour": "Pa", "tank": "Pa",
    "pressure": "Pa", "flow": "m3/s",
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
        for i, j in zip(self._indices("unladen"), self._tip_inertia, strict=True):
            own_names[i], units[i] = own_names[j], units[j]
        names = [*map(self._structured_name, own_names)]
        kinds = {i: kind for part, kind in _KINDS.items() for i in self._indices(part)}
        kinds |= dict.fromkeys(self._indices("q"), GUESS)
        kinds |= {i: STATE_START for i in self.states if i in self._indices("q")}
        kinds |= dict(self._parameters())
        own = [i for i in kinds if i < program.layout.size]
        settings = self._indices("settings")
        for i in settings:
            units[i] = units[i] or _setting_unit(names[i])
        for i in own:
            yield FmuVariable(i, names[i], units[i], kinds[i], float(self.start[i]))
        for i, state in enumerate(self.states):
            name, unit = f"der({names[state]})", _rate_unit(units[state])
            yield FmuVariable(at("derivatives") + i, name, unit, LOCAL, 0.0, state)
        for i, reference in enumerate(self._indices("event")):
            yield FmuVariable(reference, f"event_indicator[{i + 1}]", "", LOCAL)
        for axis, reference in zip("xyz", self._indices("tip_position"), strict=False):
            yield FmuVariable(reference, f"tip.position_{axis}", "m", OUTPUT)
        for reference in self._indices("payload"):
            yield FmuVariable(reference, "payload.mass", "kg", TUNABLE)

    def _indices(self, part: str) -> range:
        start = self.layout.start_index(part)
        return range(start, start + self.layout.parts[part])

    @property
    def _tip_inertia(self) -> range:
        """Indices of the inertia of the body of the tip with its payload."""
        structure, size = (
            self.program.chart.dynamics.formula_structure,
            self.layout.parts["unladen"],
        )
        start = self.layout.start_index("dynamics") + structure.constants_layout.start_index(
            "inertias"
        )
        start += size * ((structure.tip_body or 1) - 1)
        return range(start, start + size)

    def _parameters(self) -> Iterator[tuple[int, str]]:
        """Indices and kinds of the parameters that formulas read."""
        program, loads = self.program, self.program.loads
        dynamics = program.chart.dynamics.formula_structure.constants_layout
        start, tip = program.layout.start_index("dynamics"), self._tip_inertia
        for i in self._indices("geometry"):
            if i in loads and "_position_" in program.names[i]:
                yield i, FIXED
        for part in _TUNABLE_DYNAMICS:
            first = start + dynamics.start_index(part)
            yield from ((i, TUNABLE) for i in range(first, first + dynamics.parts[part])
                        if i in loads and i not in tip)  # fmt: skip
        yield from ((i, TUNABLE) for i in self._indices("unladen"))
        yield from ((i, TUNABLE) for i in self._indices("settings") if i in loads)

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
        machine, layout = self.program.machine, self.program.chart.state_layout
        closure, control = machine.closure, self.program.control
        units, energy = closure.units[closure.active], characteristic_energy(machine)
        sizes = np.ones(layout.parts["controller"])
        if isinstance(control, ValveDrive):
            sizes = np.array(control.scales) / _STATE_ACCURACY
            balances = [energy if unit == "J" else 1e-3 for unit in BALANCE_UNITS.values()]
            sizes[len(sizes) - len(balances) :] = balances
        contacts = np.full(layout.parts["contacts"], closure.characteristic_length)
        energies = np.full(layout.parts["work"] + 1, energy)
        rates = units / closure.characteristic_time
        return np.concatenate([units, rates, contacts, sizes, energies])

    @cached_property
    def dependencies(self) -> dict[int, list[int]]:
        """Value references of states and inputs that outputs and derivatives depend on."""
        at, q = self.layout.start_index, self._indices("q")
        active = {i for i in self.states if i in q}

        def closed(loads: set[tuple[int, int]]) -> set[int]:
            known = {at("inputs") + x for array, x in loads if array == 3}
            known |= {q.start + x for array, x in loads if array == 4}
            return known - {*q} | active if known & {*q} else known

        rates = [closed(x) for x in self._loads("rate")]
        found = {at("derivatives") + i: rates[x - q.start] for i, x in enumerate(self.states)}
        found |= {at("tau") + i: closed(x) for i, x in enumerate(self._loads("observe"))}
        found |= {i: active for i in (*q, *self._indices("tip_position"))}
        found |= {i: {i} for i in self.states}
        return {i: sorted(x) for i, x in found.items()}

    def _loads(self, name: str) -> list[set[tuple[int, int]]]:
        """Elements of references and state that each output of a formula of the steps reads."""
        functions = self.program.routines.step_functions
        every = [x for key, x in functions.items() if key in (name, f"{name}_rest")]
        size = {"rate": self.program.chart.state_layout.size,
                "observe": self.program.chart.output_layout.size}[name]  # fmt: skip
        loads: list[set[tuple[int, int]]] = [set() for _ in range(size)]
        for formula in every:
            assert isinstance(formula, Formula)
            for target, found in zip(loads, _formula_loads(formula, size), strict=True):
                target |= found
        return loads


def _formula_loads(formula: Formula, size: int) -> list[set[tuple[int, int]]]:
    """Elements of the arguments 3 and 4 that each of the first outputs depends on."""
    outputs = formula.outputs[:size]
    places: list[tuple[int, int]] = []
    masks: list[int] = []  # sets as bits, one for each element
    for kind, *operands in formula.operations:
        is_load = kind == "load"
        mask = reduce(or_, (masks[x] for x in operands if type(x) is int and not is_load), 0)
        if is_load and operands[0] in (3, 4):
            mask = 1 << len(places)
            places.append((operands[0], operands[1]))
        masks.append(mask)
    found = [masks[x.index] if isinstance(x, SymbolicExpression) else 0 for x in outputs]
    return [{place for i, place in enumerate(places) if mask >> i & 1} for mask in found]


def _setting_unit(name: str) -> str:
    ends = (x for x in _SETTING_UNITS if re.search(rf"[._]{x}(_[ab])?$", name))
    return _SETTING_UNITS.get(next(ends, ""), "")


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
    total: dict[str, int] = {}
    words = [
        (word, -1 if i else 1)
        for i, x in enumerate(unit.split("/"))
        for word in x.strip("()").split()
    ]
    for word, sign in words:
        match = re.fullmatch(r"([A-Za-z]+|1)(\d*)", word)
        if match is None or match[1] not in _DERIVED_UNITS:
            raise InputError(f"unit '{unit}' is no unit of an FMU")
        for name, power in _DERIVED_UNITS[match[1]].items():
            total[name] = total.get(name, 0) + sign * int(match[2] or 1) * power
    return {name: power for name, power in total.items() if power}


_DERIVED_UNITS: dict[str, dict[str, int]] = {
    "1": {}, **{x: {x: 1} for x in ("kg", "m", "s", "A", "K", "rad")},
    "N": {"kg": 1, "m": 1, "s": -2}, "J": {"kg": 1, "m": 2, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2}, "W": {"kg": 1, "m": 2, "s": -3},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
}  # fmt: skip
