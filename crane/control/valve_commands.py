"""Sources of valve signals: given over time, PD control, functions in Python."""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen.symbolic import Scalar, apply_function
from crane.common.errors import InputError, check_name
from crane.common.one_line_repr import OneLineRepr
from crane.common.plausible_ranges import suggested_units_text
from crane.common.samples import Array, as_number, as_sample
from crane.common.threads import ThreadLocal
from crane.control.control_law import ControllerInputs, motion_units
from crane.hydraulics.components import Cylinder, Spool, Valve
from crane.hydraulics.hydraulic_circuit import Hydraulics, PDGains
from crane.machine.machine import Machine
from crane.motion.task_trajectories import add_free_joints
from crane.motion.trajectory import Trajectory

_MAX_LOG_INTERVAL = 0.02  # largest mean interval between the samples of a log [s]
_SLOPE_TOLERANCE = 1e-12  # share of a signal: difference of equal slopes over the shortest step
_TIME_TOLERANCE = 1e-9  # share of a period: difference of equal instants
MIN_PRESSURE_DROP = 1e5  # least pressure drop that an edge is assumed to have [Pa]
_DEAD_BAND_SMOOTHING = 0.01  # share of the stroke over which signals cross the dead band


@runtime_checkable
class ValveCommand(Protocol):
    """Source of the signals of m spools: one per valve and one more per second spool.

    The values below are the defaults. `ValveDrive` delays the signals of valves with a dead time.

    Attributes:
        reference: The reference trajectory, or None.
        initial_coordinates: (n,) initial active coordinates; None for home or the start of the
            reference.
        has_measured_pressures: Whether the last two references are the pressures of supply and
            tank.
        settings: (s,) its parameters.
        period: Time between calls of `update` [s]; 0 for no calls.
        is_open_loop: Whether the first m references are the signals, independently of the machine,
            and available for past instants.
        duration: Largest duration [s]; 0 if unknown.
        is_finished: Whether the command has ended; a run without a given duration ends then.
        channels: Names and units of the references behind the signals, which are recorded.
        clock: Function that returns phases (N,) at times (N,) [s]; None without phases.
        reference_units: Names and units of its `references`, see `ControlLaw`.
        setting_units: Names and units of `settings`.
    """

    reference: Trajectory | None = None
    initial_coordinates: Array | None = None
    has_measured_pressures: bool = False
    settings: Array = np.zeros(0)
    period: float = 0.0
    is_open_loop: bool = False
    duration: float = 0.0
    is_finished: bool = False
    channels: tuple[tuple[str, str], ...] = ()
    clock: Callable[[Array], Array] | None = None
    reference_units: Mapping[str, str] = MappingProxyType({})
    setting_units: Mapping[str, str] = MappingProxyType({})

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """Compute the signals of the next period.

        Args:
            time: [s].
            q: (nq,) configuration.
            v_a: (n,) active velocities.
            pressures: (cylinders, 2) pressures in A and B [Pa].
        """
        return

    def references(self, times: Array) -> Array:
        """Inputs that depend on time alone, (N, c) at times (N,) [s]; none by default."""
        return np.zeros((len(times), 0))

    def signals(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """Signals (m,) [V], floats or formulas; `inputs.settings` are those of the command."""
        raise NotImplementedError


def require_circuit(machine: Machine) -> Hydraulics:
    """The circuit of a machine.

    Raises:
        InputError: It has none.
    """
    if machine.hydraulics is None:
        raise InputError(
            f"machine '{machine.name}' has no valves, describe its circuit under 'hydraulics' of "
            "the machine file"
        )
    return machine.hydraulics


def lever_signals(spool: Spool, lever: Array) -> Array:
    """Signals of a spool (N,) [V] for lever positions (N,) from -1 to 1, shares of the flow.

    The signal jumps over the dead band at zero, as that of the electronics of such machines.
    """
    u = lever * (1.0 - spool.overlap) + spool.overlap * np.sign(lever)
    return np.asarray(spool.neutral + (spool.full - spool.neutral) * u)


def opening_per_velocity(
    valve: Valve, cylinder: Cylinder, is_positive: bool, force: ArrayLike, drop: ArrayLike
) -> Array:
    """Opening of a valve per velocity of its cylinder in one direction, positive [s/m], [s/rad].

    The flow through the inlet is Q = c y sqrt(dp), with dp the margin of the compensator or what
    the supply leaves. Where the load pulls the piston, the outlet sets the velocity.

    Args:
        valve: The valve.
        cylinder: Its cylinder.
        is_positive: Whether chamber A is filled.
        force: (N,) force of the cylinder [N], [N m].
        drop: (N,) pressure of the supply less that of the filled chamber [Pa].
    """
    edges = valve.c1, cylinder.area_a, valve.c2, cylinder.area_b
    if not is_positive:
        force, edges = np.negative(force), (valve.c4, cylinder.area_b, valve.c3, cylinder.area_a)
    inlet, inlet_area, outlet, outlet_area = edges
    inlet_drop = np.maximum(np.minimum(drop, valve.margin or np.inf), MIN_PRESSURE_DROP)
    by_inlet = inlet_area / (inlet * np.sqrt(inlet_drop))
    load_pressure = np.maximum(
        np.maximum(np.negative(force), 0.0) / outlet_area, MIN_PRESSURE_DROP
    )
    by_outlet = outlet_area / (outlet * np.sqrt(load_pressure))
    return np.where(np.less(force, 0.0), np.minimum(by_inlet, by_outlet), by_inlet)


class ValveSignals(ValveCommand, OneLineRepr):
    """Signals over time, linear between the given instants and constant outside of them.

    Args:
        machine: The machine.
        time: Instants (N,) [s], increasing.
        signals: Signals (N,) [V] by joint, and by JOINT_b for second spools, whose default is the
            signal of the first spool. Other valves stay neutral.
        supply: Measured pressure of the supply (N,) [Pa]; that of the circuit if not given.
        tank: Measured pressure of the tank (N,) [Pa]; that of the machine file if not given.

    Attributes:
        title: Name of the controller in recordings.
        duration: Time of the last instant [s].

    Raises:
        InputError: Unknown joints, wrong lengths, or times that do not increase.
    """

    title = "given valve signals"
    is_open_loop = True

    def __init__(
        self,
        machine: Machine,
        time: ArrayLike,
        signals: Mapping[str, ArrayLike],
        supply: ArrayLike | None = None,
        tank: ArrayLike | None = None,
    ):
        circuit = require_circuit(machine)
        shape = np.shape(time)
        if len(shape) != 1 or not shape[0]:
            raise InputError(f"time has the shape {shape}, give (N,) instants")
        self._instants = as_sample(time, shape[0], "time of the signals").copy()
        if not (np.diff(self._instants) > 0).all():
            raise InputError("time of the signals does not increase, sort it")
        if not isinstance(signals, Mapping):
            example = next(iter(circuit.spools))
            raise InputError(
                f"signals are a {type(signals).__name__}, give those of each valve by its joint, "
                f"as {{'{example}': [...]}}"
            )
        for name in signals:
            check_name(name, circuit.spools, f"no valve for '{name}'")
        columns = []
        for name, spool in circuit.spools.items():
            lever = name if name in signals else spool.joint
            columns.append(
                self._check_column(signals[lever], f"signal of '{lever}'")
                if lever in signals
                else np.full(len(self._instants), spool.neutral)
            )
        self.has_measured_pressures = supply is not None or tank is not None
        if self.has_measured_pressures:
            for given, default, port in (
                (supply, circuit.supply.pressure, "supply"),
                (tank, circuit.supply.tank, "tank"),
            ):
                samples = np.full(len(self._instants), default) if given is None else given
                columns.append(self._check_column(samples, f"pressure of the {port}"))
                if columns[-1].min() < 0:
                    raise InputError(
                        f"pressure of the {port} is {columns[-1].min():g} Pa, it counts from a "
                        "vacuum and cannot be negative: add 1e5 to gauge pressures"
                    )
            highest = float(columns[-2].max())
            if 0 < highest < columns[-1].min() / 2:  # the line of an idle pump has more pressure
                raise InputError(
                    f"pressure of the supply is {highest:g} Pa at most, far below the tank's"
                    + (
                        suggested_units_text("pressure", highest)
                        or ", give it in Pa from a vacuum"
                    )
                )
        self._columns = np.asfortranarray(np.column_stack(columns))  # read column by column
        self._spool_count = len(circuit.spools)
        lines = ("pressure_supply", "pressure_tank") if self.has_measured_pressures else ()
        self.reference_units = {
            **{f"signal_{name}": "V" for name in circuit.spools}, **dict.fromkeys(lines, "Pa"),
        }  # fmt: skip
        self.duration = float(self._instants[-1])

    def _check_column(self, values: ArrayLike, label: str) -> Array:
        return as_sample(values, len(self._instants), label)

    def breaks(self) -> Array:
        """Times (k,) [s] at which slopes change; none for a log, whose samples are close."""
        count, length = len(self._instants), self.duration - self._instants[0]
        return np.zeros(0) if count > 1 and length < _MAX_LOG_INTERVAL * count else self._instants

    def slope_changes(self, spool_index: int) -> Array:
        """Times (k,) [s] at which the slope of the signal of a spool changes."""
        time, values = self._instants, self._columns[:, spool_index]
        if len(time) < 2:
            return time
        slopes = np.concatenate([[0.0], np.diff(values) / np.diff(time), [0.0]])
        return time[
            np.abs(np.diff(slopes))
            > (_SLOPE_TOLERANCE * np.abs(values).max() / np.diff(time).min())
        ]

    def references(self, times: Array) -> Array:
        """See `ValveCommand`."""
        return np.column_stack([np.interp(times, self._instants, x) for x in self._columns.T])

    def signals(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ValveCommand`."""
        return inputs.reference[: self._spool_count]


class ValvePD(ValveCommand, OneLineRepr):
    """One PD controller per spool, equation (37) of the electro-hydraulic forwarder paper.

    u = K_p (q_ref - q) + K_d (q_ref' - q') + F_f. The feedforward F_f = d tanh(w / 0.01), with w
    the sum of the other terms, jumps over the dead band d. q are the active coordinates.

    Args:
        machine: The machine.
        reference: Trajectory of the active joints.
        gains: Gains by joint; those of the machine file if not given.

    Raises:
        InputError: No valves, or no gains for one.
    """

    def __init__(
        self, machine: Machine, reference: Trajectory, gains: Mapping[str, PDGains] | None = None
    ):
        circuit = require_circuit(machine)
        gains = circuit.control if gains is None else gains
        for joint in circuit.joints:
            if joint not in gains:
                raise InputError(
                    f"no gains for the valve of '{joint}' of '{machine.name}', give kp and kd "
                    "under 'control' of its 'hydraulics'"
                )
        self.reference: Trajectory = add_free_joints(machine, reference)
        spools = circuit.spools.values()
        self._active_indices = [machine.active.index(spool.joint) for spool in spools]
        settings = [
            (
                gains[spool.joint].kp, gains[spool.joint].kd, spool.overlap, spool.neutral,
                spool.full - spool.neutral,
            )
            for spool in spools
        ]  # fmt: skip
        self.settings = np.array(settings, dtype=np.float64).T.ravel()
        units = {name: machine.unit(spool.joint) for name, spool in circuit.spools.items()}
        self.reference_units = motion_units(units, 1)
        self.setting_units = {
            f"{name}_{setting}": text.format(unit)
            for setting, text in (
                ("kp", "1/{}"), ("kd", "s/{}"), ("command_overlap", ""), ("command_neutral", "V"),
                ("command_span", "V"),
            )
            for name, unit in units.items()
        }  # fmt: skip

    def references(self, times: Array) -> Array:
        """See `ValveCommand`."""
        q, v = self.reference.position(times), self.reference.velocity(times)
        return np.hstack([q[:, self._active_indices], v[:, self._active_indices]])

    def signals(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ValveCommand`."""
        m = len(self._active_indices)
        kp, kd, dead_bands, neutral, span = (
            inputs.settings[i * m : (i + 1) * m] for i in range(5)
        )
        out: list[Scalar] = []
        for i, joint in enumerate(self._active_indices):
            opening_command = kp[i] * (inputs.reference[i] - inputs.q_a[joint])
            opening_command = opening_command + kd[i] * (
                inputs.reference[m + i] - inputs.v_a[joint]
            )
            dead_band_jump = dead_bands[i] * apply_function(
                "tanh", opening_command * (1.0 / _DEAD_BAND_SMOOTHING)
            )
            out.append(neutral[i] + span[i] * (opening_command + dead_band_jump))
        return out


class SampledCommand(ValveCommand, OneLineRepr):
    """A Python function that sets valve signals or forces once per period, as a control unit does.

    Args:
        function: (t, q_a, v_a, pressures) -> signals, in the order of `machine.hydraulics.spools`
            (its joints where no valve has two spools); t [s], q_a and v_a (n,), pressures (m, 2)
            of A and B by joint [Pa], signals (s,) [V]. Of a machine without a circuit it returns
            the forces of the driven joints [N], [N m], and pressures are (0, 2).
        machine: The machine.
        period: Sampling period [s], a whole number of steps of the simulation.

    Attributes:
        output_names: Spools or driven joints that it sets.
        neutral: (s,) signals before the first sample.
    """

    is_open_loop = True

    def __init__(
        self,
        function: Callable[[float, Array, Array, Array], ArrayLike],
        machine: Machine,
        period: float = 0.01,
    ):
        if not callable(function):
            raise InputError(f"{function!r} is no function (t, q_a, v_a, pressures) -> signals")
        self._function = function
        circuit = machine.hydraulics
        names = machine.driven_joints if circuit is None else tuple(circuit.spools)
        self.output_names, self._active_columns = names, machine.closure.active
        self.period = as_number(period, "the period", "s", greater_than=0)
        spools = () if circuit is None else circuit.spools.values()
        self.neutral = np.array([spool.neutral for spool in spools] or [0.0] * len(names))
        # times [s] and signals of all samples; a run is in one thread
        self._samples = ThreadLocal(lambda: ([0.0], [self.neutral]))

    def update(self, time: float, q: Array, v_a: Array, pressures: Array) -> None:
        """See `ValveCommand`."""
        signals = self._function(time, q[self._active_columns].copy(), v_a.copy(), pressures)
        label = f"the sample at t = {time:g} s"
        times, samples = self._samples.value
        # later samples are those of an earlier run
        count = bisect_left(times, time - _TIME_TOLERANCE * self.period)
        times[count:] = [time]
        samples[count:] = [as_sample(signals, len(self.output_names), label, self.output_names)]

    def references(self, times: Array) -> Array:
        """See `ValveCommand`; all times are between two samples, at which steps end."""
        mid_time = 0.5 * (times[0] + times[-1]) + _TIME_TOLERANCE * self.period
        set_times, samples = self._samples.value
        i = max(bisect_right(set_times, mid_time) - 1, 0)
        return np.tile(samples[i], (len(times), 1))

    def signals(self, inputs: ControllerInputs) -> Sequence[Scalar]:
        """See `ValveCommand`."""
        return inputs.reference
