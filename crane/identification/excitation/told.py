"""What a recording of valve signals tells of numbers that are fitted through the simulation."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from crane.common.errors import InputError, known
from crane.common.samples import Array, as_number
from crane.control.valves import circuit_of
from crane.description.sensors import INCLINATION, SIGNAL, VELOCITY
from crane.dynamics.joint_forces import sticking
from crane.formats.loading import Variants
from crane.identification.calibration.problem import Case, Problem, case_of
from crane.identification.calibration.unknowns import unknowns_of
from crane.identification.excitation.information import Quality, quality
from crane.machine import Machine
from crane.recordings.recording import Recording
from crane.recordings.timeseries import TIME, Table
from crane.simulation.readings import read_off, sensors_of, units_of

# Standard deviations of usual sensors, by unit.
_NOISE = {"rad": 1e-3, "m": 5e-4, "rad/s": 5e-3, "m/s": 2e-3, "Pa": 3e4}
_NOTHING = 1e-6  # noises that a number of its own size changes all readings by, taken together


class Told:
    """The information of recordings about numbers p that are fitted, `crane.calibrate`'s.

    Readings y of white noise sigma depend on p, each in its scale, and on the recording's start s,
    known beforehand to its deviations, each 1 in these:

        M = J_p^T (1 - J_s (J_s^T J_s + 1)^-1 J_s^T) J_p,    J = sigma^-1 dy/d(p, s),

    whose inverse is the covariance that the best fit has. With [J_s J_p; 1 0] = Q R the rows of
    R that belong to p alone are a root of it.

    Args:
        machine: The machine.
        fit: Numbers by name, see `crane.calibrate`.
        sensors: Columns of what is measured; active joints on valves and their pressures if not
            given.
        noise: Standard deviations by column; those of usual sensors if not given.
        seed: Of the noise on the virtual recordings, which only says how well starts are known.

    Attributes:
        machine: With the numbers from which a fit starts.
        units: Of the sensors by column.
        noise: (k,) standard deviations.
        unknowns: See `crane.identification.calibration.unknowns.Unknown`.

    Raises:
        InputError: Names that cannot be, or noise that nothing tells.
        RecordingError: An inclination of no link.

    Source: Ljung 1999, System Identification, section 7.4.
    """

    def __init__(
        self,
        machine: Machine,
        fit: Mapping[str, object] | Sequence[str],
        sensors: Sequence[str] | None,
        noise: Mapping[str, float] | None,
        seed: int,
    ):
        self.machine, self._seed = machine, seed
        joints = circuit_of(machine).joints
        usual = [*joints, *(f"pressure_{joint}_{side}" for joint in joints for side in "ab")]
        every = units_of(machine)
        self.units = {
            name: _unit(every, name)
            for name in dict.fromkeys(usual if sensors is None else sensors)
        }
        if not self.units:
            raise InputError(f"no sensor is named, choose among {', '.join(every)}")
        given = {x: y.noise for x, y in machine.sensors.items() if y.noise and x in self.units}
        given |= noise or {}
        for name in given:
            if name not in self.units:
                raise InputError(
                    f"noise of '{name}', which is not measured, {known(self.units, name)}"
                )
        self.noise = np.array([_deviation(name, given, unit) for name, unit in self.units.items()])
        signals = {SIGNAL + joint: "V" for joint in joints}
        sensors_of(machine, Table(self.units, np.zeros((0, len(self.units))), {}))
        variants = Variants(machine)
        self.unknowns = unknowns_of(fit, variants.spec, variants.values, self.units | signals)
        begun = {x: y for one in self.unknowns for x, y in one.changes(one.start).items()}
        if any(variants.values[name] != value for name, value in begun.items()):
            self.machine = variants.machine(begun)
        # where and when something sticks depends on everything before
        self._sticks = bool(sticking(machine))
        self._problem = self._smoothed([])

    def variant(self, values: Mapping[str, float]) -> Machine:
        """The machine with some of the wanted numbers changed, of friction that is smooth."""
        z = [(values.get(one.name, one.start) - one.start) / one.scale for one in self.unknowns]
        return self._problem.variant(np.array(z), self._problem.smooth)

    def table(self, run: Recording, noisy: bool = False) -> Table:
        """What a run's recording would hold: signals and readings, with noise or without."""
        names = list(self.units)
        values = read_off(self.machine, run, names)
        if noisy:
            random = np.random.default_rng(self._seed)
            values = values + self.noise * random.normal(size=values.shape)
            pressures = [unit == "Pa" for unit in self.units.values()]
            values[:, pressures] = np.maximum(values[:, pressures], 0.0)
        joints = circuit_of(self.machine).joints
        units = {TIME: "s"} | {SIGNAL + joint: "V" for joint in joints} | self.units
        columns = [run.channels[SIGNAL + joint] for joint in joints]
        return Table(units, np.column_stack([run.time, *columns, values]), {})

    def rows(self, run: Recording, starts: bool = True) -> Array:
        """A root of M, (p, p) upper triangle.

        Args:
            run: A simulation of the machine with the signals.
            starts: Whether the start has to be found, too; quicker without.

        Raises:
            CraneError: A machine of slightly other numbers cannot be simulated.
        """
        names, table = list(self.units), self.table(run, noisy=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            case = case_of(self.machine, "the design", table, {}, names, (0.0, np.inf))
        if not self._problem.cases:
            self._problem = self._smoothed([case])
        problem, case = self._problem, replace(case, first=len(self.unknowns))
        if not starts:
            case = replace(case, starts=np.zeros_like(case.starts))
        _, slopes = problem.linearized(case, np.zeros(problem.size))
        J = (slopes / self.noise[:, None]).reshape(-1, problem.size)
        count = len(self.unknowns)
        rest = problem.size - count
        prior = np.hstack([np.eye(rest), np.zeros((rest, count))])
        both = np.vstack([np.roll(J, rest, axis=1), prior])
        return _triangle(both)[rest:, rest:]

    def quality(self, run: Recording) -> Quality:
        """What a recording of a run will tell; deviations in the units of the numbers."""
        rows = self.rows(run)
        told = quality(rows, np.eye(len(self.unknowns)), 0.0)
        scale = np.array([unknown.scale for unknown in self.unknowns])
        return replace(told, std=self.deviations(rows) * scale)

    def deviations(self, rows: Array) -> Array:
        """(p,) standard deviations of the numbers in their scales, infinite if not told."""
        some = np.linalg.norm(rows, axis=0) > _NOTHING
        out = np.full(len(rows), np.inf)
        if some.any():
            inside = _triangle(rows[:, some])
            out[some] = quality(inside, np.eye(len(inside)), 0.0).std
        return out

    def _smoothed(self, cases: list[Case]) -> Problem:
        problem = Problem(self.machine, self.unknowns, cases)
        problem.smooth = self._sticks
        return problem


def _triangle(matrix: Array) -> Array:
    """R of Q R."""
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=np.float64)


def _unit(every: Mapping[str, str], name: str) -> str:
    if name.startswith(INCLINATION):
        return "rad/s" if name.endswith(VELOCITY) else "rad"
    if name not in every:
        raise InputError(f"'{name}' cannot be compared, {known(every, name)}")
    return every[name]


def _deviation(name: str, given: Mapping[str, float], unit: str) -> float:
    if name in given:
        return as_number(given[name], f"noise of '{name}'", unit, above=0)
    if unit not in _NOISE:
        raise InputError(f"noise of '{name}' is not known, give its deviation in {unit or '1'}")
    return _NOISE[unit]
