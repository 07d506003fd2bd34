"""The kinematics of a machine as one program for any target: loops and gamma."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property

import numpy as np

from crane.closure.compiled_closure import CompiledClosure
from crane.codegen import ArrayPointer, Layout, Program, Routine, RoutineValue
from crane.codegen.linked_functions import LinkedFunction, link_functions
from crane.codegen.routine_statements import Operand
from crane.common.errors import InputError
from crane.common.samples import Array
from crane.export.parameter_names import geometry_elements, named_elements
from crane.machine.machine import Machine

# Statuses of the routines, besides the number of what was done.
DONE, NOT_CLOSED, BEYOND_CHART, HALTED, TOO_MANY_EVENTS, TOO_MANY_CALLS = 1, -1, -2, -3, -4, -5
# over those of double precision: residuals of rounding, of closed loops; last step of Newton
SINGLE_PRECISION_BOUNDS = np.array([1e9, 1e8, 1e6])


class KinematicsProgram:
    """The closed loops of a machine as one program, see `crane.export.InstanceProgram`.

    Args:
        machine: The machine; it may be without mass.

    Attributes:
        machine: The machine.
        layout: Parts of an instance.
        names: Name of each element of an instance.
        units: Unit of each.
        defaults: An instance at home.
        single_precision_defaults: `defaults` with tolerances that single precision reaches.

    Raises:
        InputError: The formulas are too long.
    """

    output_count = 0  # elements of an instance that are outputs
    defaults: Array

    def __init__(self, machine: Machine):
        self.machine, self._closure = machine, compiled_loops(machine)
        cursor, geometry = self._closure.new_cursor().state, self._closure.geometry.constants
        bounds = self._closure.tolerances
        self.layout = Layout(
            inputs=0, cursor=cursor.size, bounds=bounds.size, geometry=geometry.size
        )
        self.names, self.units = named_elements(self.layout, geometry_elements(machine))
        self.defaults = np.concatenate([cursor, bounds, geometry])

    @property
    def single_precision_defaults(self) -> Array:
        """`defaults` with tolerances that single precision reaches."""
        values = self.defaults.copy()
        self.layout.view(values).bounds[:3] *= SINGLE_PRECISION_BOUNDS
        return values

    @cached_property
    def programs(self) -> Mapping[str, Program]:
        """Programs that the routines call, by the prefix of their functions."""
        return {"loops": self._closure.new_program()}

    @cached_property
    def routines(self) -> "KinematicsRoutines":
        """The writer of its routines."""
        return KinematicsRoutines(self.layout, self._closure)

    @cached_property
    def functions(self) -> list[LinkedFunction]:
        """All linked functions, each after what it calls."""
        own, parts = Program(), {name: x.functions for name, x in self.programs.items()}
        for prefix, functions in parts.items():
            own.functions |= {f"{prefix}_{name}": x for name, x in functions.items()}
        self.routines.add_to(own)
        close = "project" if self._closure.has_partly_active_rotations else "close"
        bindings = {"close": ("loops", close), "follow": ("loops", "follow")}
        roots = [("machine", x) for x in self.routines.entries]
        return link_functions({**parts, "machine": own.functions}, roots, bindings)

    @cached_property
    def entries(self) -> dict[str, LinkedFunction]:
        """Routines by name; each takes an instance, and further arrays."""
        linked = {x.name: x for x in self.functions}
        return {x: linked[f"machine_{x}"] for x in self.routines.entries}

    @cached_property
    def loads(self) -> frozenset[int]:
        """Elements of an instance that formulas read."""
        entries = self.entries.values()
        return frozenset().union(*(x.loads.get("instance", frozenset()) for x in entries))


class InstanceWriter:
    """Writer of routines whose argument `instance` is an instance of a layout."""

    def __init__(self, layout: Layout):
        self.layout = layout

    def _part(self, name: str) -> ArrayPointer:
        return ArrayPointer("instance").element_pointer(self.layout.start_index(name))

    def _element(self, name: str, index: int = 0) -> RoutineValue:
        return self._part(name)[index]

    def _store(self, r: Routine, name: str, value: Operand, index: int = 0) -> None:
        r.store(self._part(name), index, value)


class KinematicsRoutines(InstanceWriter):
    """Writer of the routines that need only the loops.

    Args:
        layout: Layout of an instance.
        closure: The loops.

    Attributes:
        entries: Names of the routines that others may call.
    """

    def __init__(self, layout: Layout, closure: CompiledClosure):
        super().__init__(layout)
        self._closure, self.entries = closure, list[str]()

    @contextmanager
    def _entry(self, program: Program, name: str, *arrays: str) -> Iterator[Routine]:
        """Context in which a routine is written that returns that it is done."""
        self.entries.append(name)
        with program.add_routine(name, arrays=("instance", *arrays)) as r:
            yield r
            r.return_value(DONE)

    def _call_or_return(
        self, r: Routine, status: int, name: str, *arguments: ArrayPointer | int
    ) -> None:
        """Write a call of a routine, and a return of a status where it is not done."""
        with r.if_then(r.call(name, *arguments) < 1):
            r.return_value(status)

    def add_to(self, program: Program) -> None:
        """Add close_loops, follow_loops and gamma."""
        geometry, cursor, bounds = (self._part(x) for x in ("geometry", "cursor", "bounds"))
        with self._entry(program, "close_loops", "q") as r:
            result = r.local_array("result", self._closure.formula_outputs("newton"))
            self._call_or_return(r, NOT_CLOSED, "loops_close", geometry, r.q, result, bounds)
        with self._entry(program, "follow_loops", "q_a", "q") as r:
            found = 1, geometry, r.q_a, cursor, r.q, bounds
            self._call_or_return(r, NOT_CLOSED, "loops_follow", *found)
        with self._entry(program, "gamma", "q", "gamma") as r:
            self._call_or_return(r, BEYOND_CHART, "loops_gamma_each", 1, geometry, r.q, r.gamma)


def compiled_loops(machine: Machine) -> CompiledClosure:
    """Formulas of the loops of a machine.

    Raises:
        InputError: They have none.
    """
    if not machine.closure.is_compiled:
        raise InputError(f"the loops of '{machine.name}' have no formulas to export")
    return machine.closure.compiled_closure
