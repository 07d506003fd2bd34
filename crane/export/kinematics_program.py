"""The kinematics of a machine as one program for any target: loops and gamma."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property

import numpy as np

from crane.closure.compiled_closure import CompiledClosure
from crane.codegen import ArrayPointer, Layout, Program, Routine, RoutineValue
from crane.codegen.linked_functions import LinkedFunction, link_functions
from crane.codegen.routine_statements import Operand
from crane.common.errors import InputError
from crane.export.parameter_names import geometry_names
from crane.machine.machine import Machine

# Statuses of the routines, besides the number of what was done.
DONE, NOT_CLOSED, BEYOND_CHART, HALTED, TOO_MANY_EVENTS, TOO_MANY_CALLS = 1, -1, -2, -3, -4, -5
# over those of double precision: residuals of rounding, of closed loops; last step of Newton
SINGLE_PRECISION_BOUNDS = np.array([1e9, 1e8, 1e6])


class LinkedProgram(ABC):
    """A program of a machine whose routines are linked with all that they call."""

    machine: Machine

    @property
    @abstractmethod
    def _programs(self) -> Mapping[str, Program]:
        """Programs that the routines call, by the prefix of their functions."""

    @property
    @abstractmethod
    def routines(self) -> "KinematicsRoutines":
        """The writer of its routines."""

    @cached_property
    def _linked(self) -> tuple[dict[str, LinkedFunction], list[LinkedFunction]]:
        parts = {name: dict(program.functions) for name, program in self._programs.items()}
        own = Program()
        for prefix, functions in parts.items():
            own.functions |= {f"{prefix}_{name}": x for name, x in functions.items()}
        known = {*own.functions, *self.routines.inner_routines}
        self.routines.add_to(own)
        entries = [
            name
            for name, function in own.functions.items()
            if name not in known and isinstance(function, Routine)
        ]
        has_projection = self.machine.closure.compiled_closure.has_partly_active_rotations
        close = "project" if has_projection else "close"
        bindings = {"close": ("loops", close), "follow": ("loops", "follow")}
        linked = link_functions(
            {**parts, "machine": own.functions}, [("machine", x) for x in entries], bindings
        )
        by_name = {x.name: x for x in linked}
        return {x: by_name[f"machine_{x}"] for x in entries}, linked

    @property
    def entries(self) -> dict[str, LinkedFunction]:
        """Routines by name; each takes an instance, and further arrays."""
        return self._linked[0]

    @property
    def functions(self) -> list[LinkedFunction]:
        """All linked functions, each after what it calls."""
        return self._linked[1]

    @cached_property
    def loads(self) -> frozenset[int]:
        """Elements of an instance that formulas read."""
        entries = self.entries.values()
        return frozenset().union(*(x.loads.get("instance", frozenset()) for x in entries))


class KinematicsProgram(LinkedProgram):
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

    output_count = 0

    def __init__(self, machine: Machine):
        check_formulas(machine)
        self.machine, self._closure = machine, machine.closure.compiled_closure
        cursor, geometry = self._closure.new_cursor().state, self._closure.geometry.constants
        bounds = self._closure.tolerances
        self.layout = Layout(
            inputs=0, cursor=cursor.size, bounds=bounds.size, geometry=geometry.size
        )
        unnamed = ["cursor"] * cursor.size + ["bounds"] * bounds.size
        named = list(geometry_names(machine))
        self.names = [*unnamed, *(name for name, _ in named)]
        self.units = [*("" for _ in unnamed), *(unit for _, unit in named)]
        self.defaults, self.single_precision_defaults = (
            np.concatenate([cursor, factor * bounds, geometry])
            for factor in (1.0, SINGLE_PRECISION_BOUNDS)
        )

    @cached_property
    def _programs(self) -> Mapping[str, Program]:
        return {"loops": self._closure.new_program()}

    @property
    def routines(self) -> "KinematicsRoutines":
        """The writer of its routines."""
        return KinematicsRoutines(self.layout, self._closure)


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
        inner_routines: Names of routines that are only called by others.
    """

    inner_routines: tuple[str, ...] = ()

    def __init__(self, layout: Layout, closure: CompiledClosure):
        super().__init__(layout)
        self._closure = closure

    def add_to(self, program: Program) -> None:
        """Add close_loops, follow_loops and gamma."""
        newton = self._closure.formula_outputs("newton")
        with program.add_routine("close_loops", arrays=("instance", "q")) as r:
            result = r.local_array("result", newton)
            geometry, bounds = (self._part(x) for x in ("geometry", "bounds"))
            with r.if_then(r.call("loops_close", geometry, r.q, result, bounds) < 1):
                r.return_value(NOT_CLOSED)
            r.return_value(DONE)
        with program.add_routine("follow_loops", arrays=("instance", "q_a", "q")) as r:
            geometry, cursor, bounds = (self._part(x) for x in ("geometry", "cursor", "bounds"))
            done = r.call("loops_follow", 1, geometry, r.q_a, cursor, r.q, bounds)
            with r.if_then(done < 1):
                r.return_value(NOT_CLOSED)
            r.return_value(DONE)
        with program.add_routine("gamma", arrays=("instance", "q", "gamma")) as r:
            geometry = self._part("geometry")
            with r.if_then(r.call("loops_gamma_each", 1, geometry, r.q, r.gamma) < 1):
                r.return_value(BEYOND_CHART)
            r.return_value(DONE)


def check_formulas(machine: Machine) -> None:
    """Check that the loops of a machine have formulas.

    Raises:
        InputError: They have none.
    """
    if not machine.closure.is_compiled:
        raise InputError(f"the loops of '{machine.name}' have no formulas to export")
