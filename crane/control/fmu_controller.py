"""A controller that is a Functional Mock-up Unit (FMU) for co-simulation."""

import contextlib
import re
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crane.common.errors import InputError, SimulationError, check_name
from crane.common.optional_libraries import import_optional_library
from crane.common.samples import Array
from crane.control.valve_commands import SampledCommand
from crane.machine.machine import Machine

Quantity = str | Callable[[float, Array, Array, Array], float]
_WRITTEN_TYPES = ("Real", "Float64")


class FmuController(SampledCommand):
    """An FMU of FMI 2 or 3 that sets valve signals, or forces of drives, once per step.

    At each instant it gets its inputs and makes a step; its outputs act until the next instant.
    Each run starts a new instance.

    Args:
        path: The .fmu file.
        machine: The machine.
        inputs: By input of the FMU what it gets: `q_JOINT`, `v_JOINT`, `pressure_JOINT_a` or
            `_b` in SI units, or a function (t, q_a, v_a, pressures), see `SampledCommand`.
        outputs: Output of the FMU by valve (signal [V]) or driven joint (force [N], [N m]);
            valves that are left out stay neutral, drives without force.
        step: Time between steps [s].
        parameters: Start values by variable of the FMU.

    Raises:
        InputError: The FMU cannot be loaded, or has no such variables.
    """

    def __init__(
        self,
        path: str | Path,
        machine: Machine,
        inputs: Mapping[str, Quantity],
        outputs: Mapping[str, str],
        step: float = 0.01,
        parameters: Mapping[str, float] | None = None,
    ):
        super().__init__(self._control, machine, step)
        fmpy = import_optional_library("fmpy", "a controller that is an FMU")
        self._path, self._machine = Path(path), machine
        self._fmu: Any = None
        self._time = 0.0
        if not self._path.is_file():
            raise InputError(f"{path}: there is no such FMU, give the path of a .fmu file")
        folder = tempfile.mkdtemp()
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        with self._errors("cannot be loaded", InputError):
            self._description = fmpy.read_model_description(str(path))
            self._folder = fmpy.extract(str(path), unzipdir=folder)
        if self._description.coSimulation is None:
            raise InputError(f"{path}: it has no co-simulation, export the controller with it")
        self._inputs = [
            (self._reference(x, "input"), self._quantity(y)) for x, y in inputs.items()
        ]
        for name in outputs:
            check_name(name, self.output_names, f"{path}: no valve or drive '{name}'")
        self._outputs = [self._reference(x, "output") for x in outputs.values()]
        self._places = [self.output_names.index(x) for x in outputs]
        self._parameters = {self._reference(x, ""): y for x, y in (parameters or {}).items()}

    def _reference(self, name: str, causality: str) -> int:
        """Value reference of a variable."""
        known = {
            x.name: x.valueReference
            for x in self._description.modelVariables
            if x.type in _WRITTEN_TYPES and (not causality or x.causality == causality)
        }
        check_name(name, known, f"{self._path}: no {causality or 'variable'} '{name}'")
        return int(known[name])

    def _quantity(self, quantity: Quantity) -> Callable[[float, Array, Array, Array], float]:
        """The function that gives a quantity at an instant."""
        if callable(quantity):
            return quantity
        active, circuit = self._machine.active, self._machine.hydraulics
        names: dict[str, tuple[int, Any]]
        names = {f"{kind}_{joint}": (i + 1, j) for i, kind in enumerate("qv")
                 for j, joint in enumerate(active)}  # fmt: skip
        for j, joint in enumerate(circuit.joints if circuit is not None else ()):
            names |= {f"pressure_{joint}_{side}": (3, (j, i)) for i, side in enumerate("ab")}
        check_name(quantity, names, f"{self._path}: no quantity '{quantity}'")
        argument, place = names[quantity]
        return lambda *values: float(values[argument][place])

    @contextlib.contextmanager
    def _errors(self, what: str, kind: type[InputError] | type[SimulationError]) -> Any:
        """Errors of FMPy, and of the FMU, in one line."""
        try:
            yield
        except Exception as error:  # FMPy has no base class of errors
            text = re.sub(r"\s+", " ", str(error)) or type(error).__name__
            raise kind(f"{self._path}: {what}: {text}") from None

    def _start(self, time: float, values: list[float]) -> Any:
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        if self._fmu is not None:
            self._fmu.terminate()
            self._fmu.freeInstance()
        given = self._description
        is_fmi3 = given.fmiVersion.startswith("3")
        fmu = (FMU3Slave if is_fmi3 else FMU2Slave)(
            guid=given.guid, unzipDirectory=self._folder,
            modelIdentifier=given.coSimulation.modelIdentifier,
        )  # fmt: skip
        fmu.instantiate()
        self._set, self._get = (fmu.setFloat64, fmu.getFloat64) if is_fmi3 else (
            fmu.setReal, fmu.getReal
        )  # fmt: skip
        self._set([*self._parameters], [*self._parameters.values()])
        if is_fmi3:
            fmu.enterInitializationMode(startTime=time)
        else:
            fmu.setupExperiment(startTime=time)
            fmu.enterInitializationMode()
        self._set([x for x, _ in self._inputs], values)
        fmu.exitInitializationMode()
        return fmu

    def _control(self, time: float, q_a: Array, v_a: Array, pressures: Array) -> ArrayLike:
        values = [float(f(time, q_a, v_a, pressures)) for _, f in self._inputs]
        with self._errors(f"at t = {time:g} s it stops", SimulationError):
            if self._fmu is None or time <= self._time:
                self._fmu = self._start(time, values)
            self._set([x for x, _ in self._inputs], values)
            self._fmu.doStep(time, self.period)
            found = self._get(self._outputs)
        self._time, out = time, np.array(self.neutral)
        out[self._places] = found
        if not np.isfinite(out).all():
            raise SimulationError(f"{self._path}: at t = {time:g} s its outputs are not finite")
        return out
