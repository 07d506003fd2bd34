"""Linear models of a machine about an operating point, its modes and frequency responses."""

import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from crane.codegen import Program, Tape
from crane.codegen.derivative import derivatives
from crane.codegen.scalar import Expression, Number
from crane.common.errors import CraneWarning, InputError, OutputError, SimulationError, known
from crane.common.output import replacing
from crane.common.samples import Array, as_sample, as_samples
from crane.control import At, Signals, ValveDrive
from crane.description.changes import parameters, unknown_parameter
from crane.dynamics import Dynamics
from crane.formats import load
from crane.formats.loading import Variants
from crane.hydraulics.circuit import BALANCES
from crane.machine import Machine
from crane.motion.kinematics import Kinematics
from crane.recordings.recording import FORCE_UNITS, Recording
from crane.simulation.integration.traced import settings_of

_STILL = 1e-9  # what is left of a trimmed machine, in its size per its pace squared
_ROUNDS = 50  # of Newton's method
_AJAR = 1e-6  # of a spool's stroke, beyond the dead band
_BAR, _SOON = 1e5, 0.1  # [Pa], [s]
_FRAMES, _SWING = 50, 0.05  # per second; of a stroke, rad and machine's size, as modes are shown
_PAIRED = 1e-3  # share of a pole that is no imaginary part: the root of rounding, and more
_INTEGRATOR = 1e-7  # share of the fastest pole that is none: rounding of a pole at zero


class Mode(NamedTuple):
    """A pole, or a pair of complex ones.

    Attributes:
        pole: The eigenvalue, of a pair that with a positive imaginary part [1/s].
        frequency: |pole| / 2 pi [Hz].
        damping: -Re(pole) / |pole|; 1 of a real stable one, 0 at zero.
        shape: (nq,) complex, how all joints move, the largest share of its unit being 1.
        state: (k,) complex, eigenvector in the states of the model.
    """

    pole: complex
    frequency: float
    damping: float
    shape: Array
    state: Array

    @property
    def rings(self) -> bool:
        """Whether it swings, and is no pair of real poles that rounding took apart."""
        return self.pole.imag > _PAIRED * abs(self.pole)


@dataclass(frozen=True, eq=False)
class LinearModel:
    """x' = A x + B u, y = C x + D u, deviations from an operating point.

    Attributes:
        A: (k, k).
        B: (k, m).
        C: (p, k).
        D: (p, m).
        states: Names of x: active joints, their velocities, pressures and spools of the circuit.
        inputs: Names of u.
        outputs: Names of y.
        units: By name.
        x: (k,) operating point.
        u: (m,).
        y: (p,).
        rate: (k,) x' there, 0 of an equilibrium.
        machine: The machine.
        posture: (nq,) of all joints.
        ways: (nq, n) d posture / d q_A.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    x: Array
    u: Array
    y: Array
    rate: Array
    machine: Machine
    posture: Array
    ways: Array

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """From the slowest to the fastest."""
        from scipy.linalg import eig

        poles, vectors = eig(self.A)
        fastest = np.abs(poles).max(initial=0.0)
        units = self.machine.closure.units
        found = []
        for pole, vector in zip(poles, vectors.T, strict=True):
            if pole.imag < 0:
                continue
            size = abs(pole)
            if size < _INTEGRATOR * fastest:
                pole, size = 0j, 0.0
            moved = self.ways @ vector[: self.ways.shape[1]]
            at = np.argmax(np.abs(moved / units))
            largest = moved[at] / units[at]
            if abs(largest) > 1e-12 * np.abs(vector).max():
                moved = moved / largest
            damping = -pole.real / size if size else 0.0
            mode = Mode(complex(pole), size / (2 * np.pi), float(damping), moved, vector)
            found.append(mode)
        return tuple(sorted(found, key=lambda mode: (mode.frequency, mode.pole.imag)))

    def response(self, frequencies: ArrayLike) -> Array:
        """G = C (i w - A)^-1 B + D (f, p, m), complex, at frequencies (f,) [Hz]."""
        frequencies = np.asarray(frequencies, dtype=np.float64)
        eye, found = np.eye(len(self.A)), []
        for frequency in frequencies:
            resolvent = np.linalg.solve(2j * np.pi * frequency * eye - self.A, self.B)
            found.append(self.C @ resolvent + self.D)
        out: Array = np.array(found)
        return out

    def simulate(self, times: ArrayLike, start: ArrayLike, inputs: ArrayLike) -> Array:
        """Deviations y (N, p) from a start x (k,) under constant inputs u (m,), exactly.

        Args:
            times: (N,) [s].
            start: (k,) deviation from the operating point.
            inputs: (m,) deviation.
        """
        from scipy.linalg import expm

        k, m = self.B.shape
        start, u = as_sample(start, k, "start", self.states), as_sample(inputs, m, "inputs")
        whole = np.zeros((k + m, k + m))
        whole[:k, :k], whole[:k, k:] = self.A, self.B
        first = np.concatenate([start, u])
        rows = [expm(whole * time) @ first for time in np.asarray(times, dtype=np.float64)]
        out: Array = np.array([self.C @ row[:k] + self.D @ u for row in rows])
        return out

    def most(self, mode: Mode) -> str:
        """The state that a mode moves most: a joint, or where none moves a pressure or spool."""
        n = self.ways.shape[1]
        units = self.machine.closure.units
        if np.abs(mode.shape / units).max() > 0.5:
            return self.machine.joints[int(np.argmax(np.abs(mode.shape / units)))]
        return self.states[2 * n + int(np.argmax(np.abs(mode.state[2 * n :])))]

    def to_text(self) -> str:
        """A table of the modes, Markdown."""
        lines = [
            f"{self.machine.name} in small motions about "
            + ", ".join(
                f"{name} {value:.4g} {self.units[name]}"
                for name, value in zip(self.machine.active, self.x, strict=False)
            ),
            "",
            "| frequency [Hz] | damping [%] | time constant [s] | moves most |",
            "| ---: | ---: | ---: | --- |",
        ]
        for mode in self.modes:
            if not mode.frequency:
                continue
            lasting = -1.0 / mode.pole.real if mode.pole.real else np.inf
            frequency = f"{mode.frequency:.4g}" if mode.rings else ""
            damping = f"{100 * mode.damping:.3g}" if mode.rings else ""
            grows = " (grows)" if mode.pole.real > 0 else ""
            lines.append(
                f"| {frequency} | {damping} | {abs(lasting):.3g}{grows} | {self.most(mode)} |"
            )
        if zeros := sum(mode.frequency == 0 for mode in self.modes):
            lines += ["", f"{zeros} poles at zero: what stays where it is put"]
        return "\n".join(lines)

    def motion(self, seconds: float = 3.0, most: int = 8) -> Recording | None:
        """What rings, one mode after the other in slow motion, as a recording to look at.

        Args:
            seconds: Of each mode, in which it swings three times.
            most: Modes, from the slowest.

        Returns:
            The recording, whose channel `mode_frequency` says which; None where nothing rings.
        """
        machine, n = self.machine, self.ways.shape[1]
        rings = [mode for mode in self.modes if mode.rings][:most]
        if not rings:
            return None
        phase = np.linspace(0.0, 6.0 * np.pi, int(_FRAMES * seconds))
        columns, span = machine.closure.active, machine.upper - machine.lower
        room = np.minimum(np.where(np.isfinite(span), span, np.inf), 2.0)
        q_a, frequencies = [], []
        for mode in rings:
            shape = mode.shape[columns]
            large = np.abs(shape / machine.closure.units[columns]).max(initial=0.0)
            crowded = np.abs(shape / room).max(initial=0.0)
            if not large:
                continue
            size = min(_SWING / large, _SWING / crowded)
            swing = size * np.real(np.outer(np.exp(1j * phase), shape))
            swing *= np.sin(phase / 6.0)[:, None]  # from rest to rest, so that modes join
            q_a.append(np.clip(self.x[:n] + swing, machine.lower, machine.upper))
            frequencies.append(np.full(len(phase), mode.frequency))
        time = np.arange(len(q_a) * len(phase)) / _FRAMES
        q = np.vstack(q_a)
        return Recording(
            time=time,
            joints=machine.active,
            q=q,
            v=np.gradient(q, time, axis=0),
            tau=np.zeros_like(q),
            units={joint: machine.unit(joint) for joint in machine.active},
            channels={"mode_frequency": np.concatenate(frequencies)},
            channel_units={"mode_frequency": "Hz"},
            machine=machine.call,
            task="modes in slow motion",
        )

    def to_control(self) -> Any:
        """The same as python-control's `StateSpace`.

        Raises:
            InputError: python-control is not installed.
        """
        try:
            from control import StateSpace  # type: ignore[import-untyped, unused-ignore]
        except ImportError:
            raise InputError(
                "python-control is not installed, install it: pip install control"
            ) from None
        names = {"states": self.states, "inputs": self.inputs, "outputs": self.outputs}
        lists = {key: list(value) for key, value in names.items()}
        return StateSpace(self.A, self.B, self.C, self.D, **lists)

    def save(self, path: str | Path) -> Path:
        """Write matrices, names and operating point as .mat (MATLAB, Octave) or .npz.

        Raises:
            OutputError: Another suffix, or it cannot be written.
        """
        path = Path(path)
        values: dict[str, Any] = {name: getattr(self, name) for name in ("A", "B", "C", "D")}
        values |= {name: getattr(self, name) for name in ("x", "u", "y", "rate")}
        named = {name: getattr(self, name) for name in ("states", "inputs", "outputs")}
        if path.suffix == ".mat":
            from scipy.io import savemat

            cells = {key: np.array(value, dtype=object) for key, value in named.items()}
            with replacing(path) as part:
                savemat(str(part), values | cells, appendmat=False)
        elif path.suffix == ".npz":
            every: dict[str, Any] = values | {key: np.array(x) for key, x in named.items()}
            with replacing(path) as part, open(part, "wb") as file:
                np.savez(file, **every)
        else:
            raise OutputError(f"{path}: a linear model is written as .mat or .npz")
        return path


class _Drive:
    """What acts on the machine, its states and inputs: forces, or a circuit with its valves.

    Attributes:
        states: Names and units of the drive's own states.
        inputs: Names and units.
        seen: Names and units of what else can be an output.
        own: (k,) states where the machine stands still.
        u: (m,) inputs there.
    """

    def __init__(
        self,
        machine: Machine,
        dynamics: Dynamics,
        q: Array,
        valves: bool,
        pressures: Mapping[str, tuple[float, float]] | None,
    ):
        n = self._n = len(machine.active)
        self.states: dict[str, str] = {}
        self.inputs = {
            f"{joint}_force": FORCE_UNITS[machine.unit(joint)]
            for joint, driven in zip(machine.active, machine.driven, strict=True)
            if driven
        }
        self.seen: dict[str, str] = {}
        self.own, self.u = np.zeros(0), np.zeros(len(self.inputs))
        self.scales, self._vapour = np.zeros(0), 0.0
        self._control: ValveDrive | None = None
        self._spread = np.eye(n)[:, machine.driven]
        if valves:
            control = ValveDrive(machine, Signals(machine, [0.0], {}), pressures)
            self._control = control
            circuit = control.circuit
            self.states = dict(circuit.states)
            self._stiff, self.scales = circuit.stiff, circuit.scales[: circuit.stiff]
            self._vapour = circuit.hydraulics.oil.vapour_pressure
            ends = [*circuit.starts, circuit.stiff]
            self._owner = {
                name: joint
                for joint, first, last in zip(circuit.joints, ends, ends[1:], strict=False)
                for name in list(self.states)[first:last]
                if name != "pressure_supply"
            }
            self.inputs = {f"voltage_{joint}": "V" for joint in circuit.joints}
            self.seen = dict(control.channels) | {
                f"{joint}_force": FORCE_UNITS[machine.unit(joint)] for joint in circuit.joints
            }
            self._forces = [machine.active.index(joint) for joint in circuit.joints]
            self.own = control.start_at(dynamics, q)[: self._stiff]
            self.u = control.references(np.zeros(1))[0]
            self._program = self._built(machine)

    def moving(self, v_a: Array) -> Array:
        """(k + m,) which states and signals belong to joints that move, or to the supply."""
        assert self._control is not None
        joints = self._control.circuit.joints
        moving = {x for x, i in zip(joints, self._forces, strict=True) if v_a[i]}
        own = [
            self._owner.get(name) in moving or name == "pressure_supply" for name in self.states
        ]
        mask: Any = np.array([*own, *(joint in moving for joint in joints)]) & bool(moving)
        return mask

    def loaded(self, forces: Array) -> Any:
        """(k,) which states are pressures of the chambers that bear forces (n,)."""
        assert self._control is not None
        found = np.zeros(len(self.states), dtype=bool)
        for i, first in zip(self._forces, self._control.circuit.starts, strict=True):
            found[first + int(forces[i] < 0)] = True
        return found

    def opened(self, v_a: Array, share: float) -> tuple[Array, Array, Array, Array]:
        """States and signals z with valves open by a share of their stroke, and where they may go.

        Returns:
            z (k + m,); how it depends on pressures and openings (k + m, r); least and most of
            these (r,), which keep valves open and pumps within their droop.
        """
        assert self._control is not None
        hydraulics, names = self._control.circuit.hydraulics, list(self.states)
        supply, k = hydraulics.supply, len(names)
        z = np.concatenate([self.own, self.u])
        ways: list[Array] = []
        ends: list[tuple[float, float]] = []
        if "pressure_supply" in names:
            at = names.index("pressure_supply")
            z[at] = supply.pressure - 0.5 * supply.droop - self._vapour
            ways.append(np.eye(len(z))[at])
            ends.append((-0.5 * supply.droop, 0.5 * supply.droop))
        for i, (joint, valve) in enumerate(hydraulics.valves.items()):
            if not (side := float(np.sign(v_a[self._forces[i]]))):
                continue
            for at, name in enumerate(names):
                if name in (f"pressure_{joint}_a", f"pressure_{joint}_b"):
                    z[at] = max(z[at], 0.3 * supply.pressure)
                    ways.append(np.eye(len(z))[at])
                    ends.append((-z[at], np.inf))
            dead, open_to = valve.dead_band, valve.dead_band + share * (1.0 - valve.dead_band)
            way = np.zeros(len(z))
            way[k + i] = side * (valve.full - valve.neutral)
            z[k + i] = valve.neutral + open_to * way[k + i]
            if f"spool_{joint}" in names:
                at = names.index(f"spool_{joint}")
                way[at], z[at] = side, side * open_to
            ways.append(way)
            ends.append((dead + _AJAR - open_to, 1.0 - open_to))
        lower, upper = np.array(ends).T
        return z, np.array(ways).T, lower, upper

    @property
    def shown(self) -> Array:
        """(k,) what states are to be added for pressures to count from a vacuum."""
        return np.array([self._vapour * name.startswith("pressure_") for name in self.states])

    def _built(self, machine: Machine) -> Program:
        control, n, k, m = self._control, self._n, self._stiff, len(self.inputs)
        assert control is not None
        tape = Tape()
        q_a, v_a, own = tape.loads(0, 0, n), tape.loads(0, n, n), tape.loads(0, 2 * n, k)
        settings, u = settings_of(control, tape, 1, fold=True), tape.loads(0, 2 * n + k, m)
        integrals: list[Number] = [0.0] * len(BALANCES)
        at = At(q_a, v_a, [*own, *integrals], settings, u, _no_inverse)
        tau, rates = control.trace(at)
        seen = [*control.look(at), *(tau[i] for i in self._forces)]
        values = [*tau, *rates[:k], *seen]
        by = [x for x in (*q_a, *v_a, *own, *u) if isinstance(x, Expression)]
        slopes = [entry for row in derivatives(values, by) for entry in row]
        words = [x.index if isinstance(x, Expression) else float(x) for x in (*values, *slopes)]
        fast, key = machine.closure.fast, ("linear drive", repr((tape.operations, words)))

        def build(program: Program) -> None:
            program.add("formula", 2, {"values": values, "slopes": slopes})

        if key not in fast.programs:
            fast.programs[key] = fast.kept(key, build)
        return fast.programs[key]

    def at(self, q_a: Array, v_a: Array, own: Array, u: Array) -> tuple[Array, Array]:
        """Forces (n,), rates (k,) and what is seen, and their derivatives by all arguments."""
        n = self._n
        if self._control is None:
            slopes = np.zeros((n, 2 * n + len(u)))
            slopes[:, 2 * n :] = self._spread
            return self._spread @ u, slopes
        layout = self._program.outputs("formula")
        out = np.empty(layout.size)
        settings = np.ascontiguousarray(self._control.settings)
        self._program.call("formula", np.concatenate([q_a, v_a, own, u]), settings, out)
        values, slopes = out[layout["values"]], out[layout["slopes"]]
        return values, slopes.reshape(len(values), -1)


def _no_inverse(a_a: Sequence[Number], friction: bool) -> list[Number]:
    raise AssertionError("signals that are given do not ask for forces")


def linearize(
    machine: Machine | str | Path,
    at: Mapping[str, float] | ArrayLike | None = None,
    *,
    velocity: Mapping[str, float] | ArrayLike | None = None,
    drive: str | None = None,
    outputs: Sequence[str] | None = None,
    pressures: Mapping[str, tuple[float, float]] | None = None,
) -> LinearModel:
    """A machine in small motion about an operating point: x' = A x + B u, y = C x + D u.

    The operating point is trimmed: forces, or pressures and valve signals, are those at which the
    velocities stay what they are. Matrices are exact derivatives through the closed loops
    (`Dynamics.derivatives`), the circuit's by its formulas. Friction that sticks is that of small
    motions which have begun: at rest its viscous part alone, in motion the side that it is on.
    What the circuit only counts, such as the oil drawn, is no state.

    Args:
        machine: The machine, or what `crane.load` takes.
        at: Active coordinates [m], [rad], by joint or (n,); home for those that are not named.
        velocity: Their velocities [m/s], [rad/s], likewise; at rest if not given.
        drive: "valves" or "forces"; valves if not given where the machine has any.
        outputs: Names of joints, `JOINT_velocity` of active ones, `tip_x`, `JOINT_force`, and
            channels of the circuit such as `pressure_JOINT_a`; if not given, the active joints,
            the tip, and with valves the chambers' pressures.
        pressures: Of the chambers A and B [Pa] by joint, of which that of the loaded side is
            changed to what holds the machine; if not given, the other side is at the tank's
            pressure, where its valve would begin to let oil in: the model is that of the valve
            closed.

    Raises:
        InputError: Unknown names, a posture beyond the limits, or a drive that is not there.
        ClosureError: The loops do not close there.
        SimulationError: The machine cannot be trimmed there.
    """
    if not isinstance(machine, Machine):
        machine = load(machine)
    if drive not in (None, "valves", "forces"):
        raise InputError(f"drive '{drive}' is unknown, {known(('valves', 'forces'), drive)}")
    valves = machine.hydraulics is not None if drive is None else drive == "valves"
    if valves and machine.hydraulics is None:
        raise InputError(f"'{machine.name}' has no valves, take the drive 'forces'")
    home = machine.home[machine.closure.active]
    q_a = machine.check_limits(_by_joint(machine, at, home, "at"), "at")
    v_a = _by_joint(machine, velocity, np.zeros(len(home)), "velocity")
    if machine.coordinates.floating and v_a.any():
        raise InputError("a floating machine is linearized at rest, leave velocities out")
    dynamics = Dynamics(machine)
    q = machine.closure.solve(q_a)
    made = _Drive(machine, dynamics, q, valves, pressures)
    own, u = _trimmed(dynamics, made, q_a, v_a)
    n, k, m = len(q_a), len(own), len(u)
    values, slopes = made.at(q_a, v_a, own, u)
    tau = values[:n]
    found = dynamics.derivatives("forward", q_a, v_a, tau, friction=True)
    by_tau = found["tau_a"]
    size = 2 * n + k
    a, b = np.zeros((size, size)), np.zeros((size, m))
    a[:n, n : 2 * n] = np.eye(n)
    a[n : 2 * n] = by_tau @ slopes[:n, :size]
    a[n : 2 * n, :n] += found["q_a"]
    a[n : 2 * n, n : 2 * n] += found["v_a"]
    a[2 * n :] = slopes[n : n + k, :size]
    b[n : 2 * n], b[2 * n :] = by_tau @ slopes[:n, size:], slopes[n : n + k, size:]
    ways = machine.closure.gamma(q)
    states = {joint: machine.unit(joint) for joint in machine.active}
    states |= {f"{joint}_velocity": machine.unit(joint) + "/s" for joint in machine.active}
    every = _Outputs(machine, made, q, ways, (q_a, v_a), (values, slopes))
    c, d, y, units = every.of(outputs)
    acceleration = dynamics.forward(q_a, v_a, tau, friction=True)
    return LinearModel(
        A=a, B=b, C=c, D=d,
        states=(*states, *made.states),
        inputs=tuple(made.inputs),
        outputs=tuple(units),
        units=states | made.states | made.inputs | units,
        x=np.concatenate([q_a, v_a, own + made.shown]),
        u=u,
        y=y,
        rate=np.concatenate([v_a, acceleration, values[n : n + k]]),
        machine=machine,
        posture=q,
        ways=ways,
    )  # fmt: skip


def linear_models(
    machine: Machine | str | Path,
    vary: Mapping[str, ArrayLike],
    at: Mapping[str, float] | None = None,
    *,
    drive: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[tuple[dict[str, float], LinearModel]]:
    """Linear models over postures and numbers of a machine, at rest.

    Args:
        machine: See `linearize`.
        vary: Values by name of an active joint, or of a number of the machine as
            `crane.description.parameters` lists them; all combinations are taken.
        at: Active coordinates [m], [rad] that are the same in all.
        drive: See `linearize`.
        progress: Called with the finished share, 0 to 1.

    Returns:
        For each combination the values and the model, the last name varying fastest.

    Raises:
        InputError: See `linearize`; an unknown name.
    """
    if not isinstance(machine, Machine):
        machine = load(machine)
    values = {name: np.atleast_1d(np.asarray(x, dtype=np.float64)) for name, x in vary.items()}
    variants, found = Variants(machine), []
    numbers = parameters(variants.spec)
    for name in values:
        if name not in machine.active and name not in numbers:
            raise InputError(unknown_parameter(variants.spec, [*numbers, *machine.active], name))
    every = list(itertools.product(*(x.tolist() for x in values.values())))
    drifting = []
    for i, row in enumerate(every):
        here = dict(zip(values, row, strict=True))
        changes = {name: value for name, value in here.items() if name not in machine.active}
        joints = {name: value for name, value in here.items() if name in machine.active}
        variant = variants.machine(changes) if changes else machine
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            found.append((here, linearize(variant, dict(at or {}) | joints, drive=drive)))
        drifting += [str(warning.message) for warning in said]
        if progress is not None:
            progress((i + 1) / len(every))
    if drifting:
        text = f"{len(drifting)} of {len(every)} are {drifting[0]}, the first"
        warnings.warn(text, CraneWarning, stacklevel=2)
    return found


class _Outputs:
    """Rows of C and D by name.

    Args:
        machine: The machine.
        drive: What acts on it.
        q: (nq,) posture.
        ways: (nq, n) dq/dq_A.
        motion: q_A and v_A.
        found: What the drive does, see `_Drive.at`.
    """

    def __init__(
        self,
        machine: Machine,
        drive: _Drive,
        q: Array,
        ways: Array,
        motion: tuple[Array, Array],
        found: tuple[Array, Array],
    ):
        n, k, m = len(machine.active), len(drive.states), len(drive.inputs)
        self._size = 2 * n + k
        self._rows: dict[str, tuple[Array, float, str]] = {}
        width = self._size + m
        for column, joint in enumerate(machine.joints):
            row = np.zeros(width)
            row[:n] = ways[column]
            self._rows[joint] = row, float(q[column]), machine.unit(joint)
        for i, joint in enumerate(machine.active):
            name, unit = f"{joint}_velocity", machine.unit(joint) + "/s"
            self._rows[name] = np.eye(width)[n + i], float(motion[1][i]), unit
        self.usual = list(machine.active)
        if machine.tip is not None:
            kinematics = Kinematics(machine)
            jacobian, place = kinematics.jacobian(motion[0]), kinematics.position_at(q)
            for axis, along, value in zip("xyz", jacobian, place, strict=True):
                row = np.zeros(width)
                row[:n] = along
                self._rows[f"tip_{axis}"] = row, float(value), "m"
                self.usual.append(f"tip_{axis}")
        values, slopes = found
        if drive.states:
            seen = zip(drive.seen.items(), values[n + k :], slopes[n + k :], strict=True)
            for (name, unit), value, row in seen:
                self._rows[name] = row, float(value), unit
            self.usual += [name for name in drive.states if name.startswith("pressure_")]
        else:
            for i, (name, unit) in enumerate(drive.inputs.items()):
                self._rows[name] = np.eye(width)[self._size + i], 0.0, unit

    def of(self, names: Sequence[str] | None) -> tuple[Array, Array, Array, dict[str, str]]:
        """C, D, y and units of outputs.

        Raises:
            InputError: An unknown name.
        """
        names = self.usual if names is None else list(names)
        for name in names:
            if name not in self._rows:
                raise InputError(f"output '{name}' is unknown, {known(self._rows, name)}")
        rows = np.array([self._rows[name][0] for name in names]).reshape(len(names), -1)
        y = np.array([self._rows[name][1] for name in names])
        units = {name: self._rows[name][2] for name in names}
        return rows[:, : self._size], rows[:, self._size :], y, units


def _by_joint(
    machine: Machine, given: Mapping[str, float] | ArrayLike | None, usual: Array, what: str
) -> Array:
    """(n,) active coordinates or velocities, by joint or all of them."""
    if given is None:
        return usual.copy()
    if not isinstance(given, Mapping):
        return as_samples(given, len(usual), what, machine.active).astype(np.float64)
    out = usual.copy()
    for joint, value in given.items():
        if joint not in machine.active:
            raise InputError(
                f"{what}: '{joint}' is no active joint, {known(machine.active, joint)}"
            )
        out[machine.active.index(joint)] = float(value)
    return out


def _trimmed(dynamics: Dynamics, drive: _Drive, q_a: Array, v_a: Array) -> tuple[Array, Array]:
    """The drive's states and inputs at which velocities and states stay.

    Raises:
        SimulationError: There are none.
    """
    if drive.states:
        return _on_valves(_Trim(dynamics, drive, q_a, v_a))
    machine = dynamics.machine
    forces = dynamics.inverse(q_a, v_a, np.zeros(len(q_a))) + dynamics.friction(q_a, v_a)
    driven = machine.driven.astype(bool)
    held = np.where(driven, forces, 0.0)
    if np.abs(dynamics.forward(q_a, v_a, held, friction=True)).max() > _STILL:
        worst = int(np.argmax(np.abs(forces - held)))
        joint = machine.active[worst]
        unit = FORCE_UNITS[machine.unit(joint)]
        raise SimulationError(
            f"free joint '{joint}' does not stay there, {forces[worst]:.3g} {unit} would have to "
            "hold it: linearize where it hangs still"
        )
    return drive.own, forces[driven]


class _Trim:
    """What is left of an equilibrium on valves, over their states and signals z.

    Joints at rest have their valves closed: the pressure of the chamber that bears the load holds
    the machine for now, whatever leaks. All else has to stay what it is.

    Args:
        dynamics: Of the machine.
        drive: The circuit.
        q_a: (n,).
        v_a: (n,).

    Attributes:
        start: (k + m,) closed valves.
    """

    def __init__(self, dynamics: Dynamics, drive: _Drive, q_a: Array, v_a: Array):
        self._dynamics, self.drive, self._q_a, self.v_a = dynamics, drive, q_a, v_a
        closure = dynamics.machine.closure
        n, k = len(q_a), len(drive.states)
        pressure = np.array([unit == "Pa" for unit in drive.states.values()])
        scales = np.where(pressure, _BAR, 1.0)
        moving = drive.moving(v_a)
        loaded = drive.loaded(dynamics.inverse(q_a, v_a, np.zeros(n)))
        self._free = np.flatnonzero(np.concatenate([loaded | moving[:k], moving[k:]]))
        self._rows = np.concatenate([np.arange(n), n + np.flatnonzero(moving[:k])])
        self._scales = np.concatenate([scales, np.ones(len(drive.u))])
        # pressures of bars within tenths of a second are as much as such accelerations
        accelerations = closure.units[closure.active] / closure.pace**2
        self._units = np.concatenate([accelerations, scales / _SOON])[self._rows]
        self.start = np.concatenate([drive.own, drive.u])

    def rates(self, z: Array) -> Array:
        """(k,) of the states."""
        n, k = len(self._q_a), len(self.drive.states)
        return self.drive.at(self._q_a, self.v_a, z[:k], z[k:])[0][n : n + k]

    def left(self, z: Array) -> tuple[Array, Array]:
        """Accelerations and rates in their units, and their derivatives by z."""
        drive, n, k = self.drive, len(self._q_a), len(self.drive.states)
        values, slopes = drive.at(self._q_a, self.v_a, z[:k], z[k:])
        state = self._q_a, self.v_a, values[:n]
        a_a = self._dynamics.forward(*state, friction=True)
        found = self._dynamics.derivatives("forward", *state, friction=True, by=["tau_a"])
        by = slopes[:, 2 * n :]
        rows = np.vstack([found["tau_a"] @ by[:n], by[n : n + k]])
        left = np.concatenate([a_a, values[n : n + k]])
        return left[self._rows] / self._units, rows[self._rows] / self._units[:, None]

    def polished(self, z: Array) -> Array | None:
        """The nearest z at which nothing is left, by Newton's method; None if there is none."""
        z, free = z.copy(), self._free
        for _ in range(_ROUNDS):
            left, slopes = self.left(z)
            if np.abs(left).max() < _STILL:
                return z
            rows = (slopes * self._scales)[:, free]
            step = np.linalg.lstsq(rows, left, rcond=1e-10)[0]
            if not np.isfinite(step).all():
                return None
            z[free] -= step * self._scales[free]
        return None

    def searched(self, share: float) -> Array:
        """The best z from valves that are open by a share of their stroke, and stay open."""
        from scipy.optimize import least_squares

        z, ways, lower, upper = self.drive.opened(self.v_a, share)

        def left(x: Array) -> Array:
            return self.left(z + ways @ x)[0]

        def slopes(x: Array) -> Array:
            found: Array = self.left(z + ways @ x)[1] @ ways
            return found

        scales = 1.0 / (np.abs(ways) / self._scales[:, None]).max(axis=0)
        start = np.zeros(len(lower))
        found = least_squares(left, start, slopes, (lower, upper), x_scale=scales)
        return z + ways @ found.x


def _on_valves(trim: _Trim) -> tuple[Array, Array]:
    drive, k = trim.drive, len(trim.drive.states)
    starts = (trim.searched(share) for share in (0.2, 0.5, 0.8)) if trim.v_a.any() else ()
    done = next(
        (
            z
            for start in itertools.chain(starts, [trim.start])
            if (z := trim.polished(start)) is not None
        ),
        None,
    )
    if done is None:
        raise SimulationError(
            "the machine cannot be trimmed there: no pressures and signals keep these velocities"
        )
    rates = np.abs(trim.rates(done))
    worst = int(np.argmax(np.where(rates > 1e-3 * drive.scales, rates / drive.scales, 0.0)))
    if rates[worst] > _BAR * _STILL:
        name, unit = list(drive.states.items())[worst]
        warnings.warn(
            f"linearized where it does not stay: {name} changes by {rates[worst]:.3g} {unit}/s "
            "with closed valves, through leakage or relief valves",
            CraneWarning,
            stacklevel=4,
        )
    return done[:k], done[k:]
