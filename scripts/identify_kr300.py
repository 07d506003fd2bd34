"""The KR300 identified from one recording and judged by another.

    python scripts/identify_kr300.py ../shared/data              # identify from A, judge by B
    python scripts/identify_kr300.py ../shared/data --terms      # what each term brings
    python scripts/identify_kr300.py ../shared/data --settings   # cross-validation on A

Errors are relative: root mean square of the residual over that of the joint torque, both sides
through a zero-phase low-pass of 5 Hz, 50 samples left out at each end, rows of a joint faster than
1 deg/s. Settings come from cross-validation in blocks of recording A.
"""

import argparse
import dataclasses
import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

import crane
from crane.common.samples import Array
from crane.identification.mechanics.feasible import Feasible, feasible
from crane.identification.mechanics.model import (
    PER_BODY,
    Along,
    GasScale,
    Inertial,
    Model,
    Presliding,
    RotorInertia,
    Samples,
    Term,
    friction,
)
from crane.identification.signals.motion import Motion, differentiate, filter_rows

RATIO = np.array([1798 / 7, 1872 / 7, 757 / 3, 221, 5032 / 21, 206793 / 1340])
ROTORS = np.array([0.00923, 0.0118, 0.0118, 0.00173, 0.00173, 0.00173])  # [kg m2], motor side
ZERO = np.deg2rad([0.0, -90.0, 90.0, 0.0, 0.0, 0.0])  # of the recordings
STEP = 0.004  # [s]
BANDWIDTH, TRIM, SLOW = 5.0, 50, math.radians(1.0)  # [Hz], samples, [rad/s]
DIFFERENTIATION = 20.0  # [Hz]
NOISE = np.array([45.0, 70.0, 70.0, 8.0, 12.0, 9.0])  # [N m] of a row
THINNING, INDEPENDENT = 5, 0.1  # rows that are used, and the share of them that is independent
BLOCKS = (3, 5, 10)  # of cross-validation
FREE = 1.0  # relative standard deviation of bodies that are free
SCALE = np.array([500.0, 500.0, 500.0, 100.0, 100.0, 100.0])  # [N m] of friction
LINKS = np.array([[-120, -110, -100, -90, -80, -70, -60, -50, -40]]).T
PRESSURES = np.array([170, 167, 164, 162, 164, 170, 180, 190, 200])  # [bar]


@dataclass(frozen=True)
class Settings:
    """What cross-validation on recording A decided, and which terms there are.

    Standard deviations are those of the prior.

    Attributes:
        body: Of bodies, relative.
        rotor: Of rotor inertias, relative.
        offset: Of torque offsets [N m], for the large joints; a fifth of it for the wrist.
        root: Of friction like the root of the speed, relative to `SCALE`; 0 leaves it out.
        memory: Of friction that remembers rest, likewise.
        direction: Of the difference of viscous friction between the directions, likewise.
        seals: Of the cylinder's Coulomb friction [N]; 0 leaves it out.
        presliding: Distance over which friction turns [rad]; 0: at once.
        lag: [s] over which rest is forgotten.
        speed: [rad/s] at which it is.
        gas: Whether there is a cylinder.
    """

    body: float = 0.002
    rotor: float = 0.1
    offset: float = 10.0
    root: float = 2.0
    memory: float = 1.0
    direction: float = 0.2
    seals: float = 1000.0
    presliding: float = math.radians(0.005)
    lag: float = 0.3
    speed: float = math.radians(2.0)
    gas: bool = True


class Memory:
    """Friction that remembers rest: sign(v) exp(-w / speed), lag w' = |v| - w.

    A joint that starts from rest sticks more than one that comes to rest, because the contact
    needs time to change.

    Args:
        column: Of the active joint.
        joint: Its name.
        settings: Lag and speed.
    """

    signs = (False,)

    def __init__(self, column: int, joint: str, settings: Settings):
        self._column, self._speed = column, settings.speed
        self._share = -math.expm1(-STEP / settings.lag)
        self.names, self.nominal = (f"{joint}.memory",), np.zeros(1)

    def columns(self, at: Samples) -> Array:
        """See `Term`."""
        from scipy.signal import lfilter

        v = at.v_a[:, self._column]
        w = np.empty_like(v)
        state = at.memory.get(self, np.zeros(1))
        edges = sorted({0, *at.starts, len(v)})
        for start, end in zip(edges[:-1], edges[1:], strict=True):
            if start in at.starts:
                state = np.zeros(1)
            part = np.abs(v[start:end])
            w[start:end], state = lfilter([self._share], [1, self._share - 1], part, zi=state)
        at.memory[self] = state
        out = np.zeros((*at.v_a.shape, 1))
        out[:, self._column, 0] = np.sign(v) * np.exp(-w / self._speed)
        return out


def model_of(machine: crane.Machine, settings: Settings) -> Model:
    """The machine with everything that is estimated."""
    if not settings.gas:
        machine = machine.replace(gas_springs=())
    terms: list[Term] = [Inertial(machine)]
    if settings.gas:
        terms.append(GasScale(machine, "stroke"))
        if settings.seals:
            terms.append(friction(machine, "stroke", ("coulomb",), smoothing=1e-4))
    for i, joint in enumerate(machine.active):
        terms.append(RotorInertia(machine, joint, ROTORS[i] * RATIO[i] ** 2))
        kinds = ["coulomb_offset", "viscous"]
        if settings.direction:
            kinds.append("viscous_offset")
        if settings.presliding:
            terms.append(Presliding(machine, joint, settings.presliding))
        else:
            kinds.append("coulomb")
        terms.append(friction(machine, joint, kinds, smoothing=0.0))
        if settings.root:
            root = {"root": lambda v: np.sign(v) * np.sqrt(np.abs(v))}
            terms.append(Along(machine, joint, root))
        if settings.memory:
            terms.append(Memory(i, joint, settings))
    return Model(machine, terms)


def spread_of(model: Model, settings: Settings) -> Array:
    """Standard deviations of the parameters that are not of bodies, about their nominal values."""
    wide = {
        "presliding": 10.0, "coulomb": 10.0, "viscous": 50.0, "viscous_offset": settings.direction,
        "root": settings.root, "memory": settings.memory, "coulomb_offset": settings.offset / 500,
    }  # fmt: skip
    spread = []
    for name, nominal in zip(model.names, model.nominal, strict=True):
        joint, kind = name.split(".")
        if joint in model.bodies and kind in PER_BODY:
            continue
        if joint == "stroke":
            spread.append(10.0 if kind == "gas_scale" else settings.seals)
        elif kind == "rotor":
            spread.append(settings.rotor * nominal)
        else:
            spread.append(wide[kind] * SCALE[model.machine.active.index(joint)])
    return np.array(spread)


def read(folder: Path, name: str) -> tuple[Motion, np.ndarray]:
    """A recording, joint side, and which rows are moving by its own velocities."""
    with np.load(folder / "kr300" / f"kr300_{name}.npz") as file:
        time, q = file["time"], np.deg2rad(file["motor_position_deg"]) + ZERO
        tau, speed = file["motor_torque"] * RATIO, np.deg2rad(file["motor_velocity_deg_s"])
    found = differentiate(time, q, "lowpass", DIFFERENTIATION)
    return Motion(time, found.q, found.v, found.a, tau), np.abs(speed) > SLOW


@dataclass(frozen=True)
class Errors:
    """Relative errors of a recording.

    Attributes:
        joints: (n,).
        stacked: Over all joints in N m.
    """

    joints: Array
    stacked: float

    @property
    def mean(self) -> float:
        """Over the joints."""
        return float(self.joints.mean())

    def __str__(self) -> str:
        each = " ".join(f"{100 * x:5.1f}" for x in self.joints)
        return f"{100 * self.mean:5.2f} %  {100 * self.stacked:5.2f} %   {each}"


def errors(measured: Array, modelled: Array, counted: np.ndarray) -> Errors:
    """Relative errors of filtered torques (N, n)."""
    gap = np.where(counted, measured - modelled, 0.0)
    size = np.where(counted, measured, 0.0)
    joints = np.linalg.norm(gap, axis=0) / np.linalg.norm(size, axis=0)
    return Errors(joints, float(np.linalg.norm(gap) / np.linalg.norm(size)))


@dataclass(frozen=True, eq=False)
class Rows:
    """Filtered equations of a recording: y = W beta.

    Attributes:
        W: (N, n, p).
        y: (N, n), without what no parameter changes.
        known: (N, n) what that is.
        counted: (N, n) moving rows away from the ends.
    """

    W: Array
    y: Array
    known: Array
    counted: np.ndarray

    def judge(self, parameters: Array) -> Errors:
        """Relative errors."""
        return errors(self.y + self.known, self.W @ parameters + self.known, self.counted)


def rows_of(model: Model, motion: Motion, moving: np.ndarray) -> Rows:
    """Both sides of the equations through the same low-pass."""
    at = model.samples(motion.q, motion.v, motion.a)
    both = np.concatenate([model.regressor(at), model.known(at)[:, :, None]], axis=2)
    step = float(motion.time[1] - motion.time[0])
    both, tau = filter_rows(both, motion.tau, step, BANDWIDTH, 1)
    counted = moving.copy()
    counted[:TRIM] = counted[-TRIM:] = False
    return Rows(both[:, :, :-1], tau - both[:, :, -1], both[:, :, -1], counted)


def fit(model: Model, rows: Rows, settings: Settings, kept: np.ndarray | None = None) -> Feasible:
    """Feasible parameters from the rows of a recording, of these instants (N,) if given."""
    chosen = rows.counted if kept is None else rows.counted & kept[:, None]
    instant, joint = np.nonzero(chosen[::THINNING])
    W, y = rows.W[::THINNING][instant, joint], rows.y[::THINNING][instant, joint]
    weights = np.sqrt(INDEPENDENT) / NOISE[joint]
    count = 10 * len(model.bodies)
    signs = [i for i, sign in enumerate(model.signs) if sign and i >= count]
    spread = spread_of(model, settings)
    return feasible(W, y, weights, model.bodies, model.nominal, settings.body**-2, spread, signs)


def cross_validated(model: Model, rows: Rows, settings: Settings) -> list[Errors]:
    """Errors of blocks of a recording by what the others teach, 0.2 s apart."""
    found, count = [], len(rows.y)
    for blocks in BLOCKS:
        modelled = np.zeros_like(rows.y)
        edges = np.linspace(TRIM, count - TRIM, blocks + 1).astype(int)
        for start, end in pairwise(edges):
            kept = np.ones(count, dtype=bool)
            kept[max(0, start - TRIM) : end + TRIM] = False
            values = fit(model, rows, settings, kept).values
            modelled[start:end] = rows.W[start:end] @ values
        found.append(errors(rows.y + rows.known, modelled + rows.known, rows.counted))
    return found


def others(settings: Settings) -> dict[str, Settings]:
    """Settings that were compared on A."""
    changes: dict[str, dict[str, float]] = {
        "bodies within 0.4 %": {"body": 0.004},
        "bodies within 1 %": {"body": 0.01},
        "rotors within 5 %": {"rotor": 0.05},
        "presliding over 0.02 deg": {"presliding": math.radians(0.02)},
        "presliding over 0.1 deg": {"presliding": math.radians(0.1)},
        "memory of 0.1 s": {"lag": 0.1},
        "memory of 0.6 s": {"lag": 0.6},
        "memory up to 1 deg/s": {"speed": math.radians(1.0)},
        "memory up to 5 deg/s": {"speed": math.radians(5.0)},
        "directions 0.5": {"direction": 0.5},
        "offsets 5 N m": {"offset": 5.0},
    }
    return {name: dataclasses.replace(settings, **change) for name, change in changes.items()}  # type: ignore[arg-type]


def pressure_error(machine: crane.Machine) -> float:
    """Root mean square of the machine's gas pressure less the measured one [bar]."""
    q_a = np.tile(machine.home[machine.closure.active], (len(LINKS), 1))
    q_a[:, 1:2] = np.deg2rad(LINKS)
    stroke = machine.closure.solve(q_a)[:, machine.column("stroke")]
    (gas,) = machine.gas_springs
    volume = gas.volume + gas.area * (stroke - gas.rest)
    pressure = gas.pressure * (gas.volume / volume) ** gas.exponent
    return float(np.sqrt(np.mean((pressure / 1e5 - PRESSURES) ** 2)))


def without(settings: Settings) -> dict[str, Settings]:
    """The settings without one term each."""
    changes: dict[str, dict[str, float]] = {
        "memory of rest": {"memory": 0.0},
        "root of the speed": {"root": 0.0},
        "presliding": {"presliding": 0.0},
        "the directions' difference": {"direction": 0.0},
        "friction of the cylinder": {"seals": 0.0},
        "free rotors": {"rotor": 1e-4},
    }
    return {name: dataclasses.replace(settings, **change) for name, change in changes.items()}  # type: ignore[arg-type]


def main() -> None:
    """Identify and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder that holds kr300/")
    parser.add_argument("--terms", action="store_true", help="what each term brings")
    parser.add_argument("--settings", action="store_true", help="cross-validation on A")
    options = parser.parse_args()
    machine = crane.load("kr300")
    recordings = {name: read(options.data, name) for name in "AB"}
    settings = Settings()

    def report(label: str, settings: Settings) -> tuple[Model, Feasible]:
        model = model_of(machine, settings)
        rows = {name: rows_of(model, *both) for name, both in recordings.items()}
        found = fit(model, rows["A"], settings)
        for name in rows:
            print(f"{label:36s} {name}  {rows[name].judge(found.values)}")
        return model, found

    print(f"{'relative errors [%]':36s}     mean  stacked  joints 1 to 6")
    model, found = report("all terms", settings)
    scale = found.values[model.names.index("stroke.gas_scale")]
    report("without the cylinder", dataclasses.replace(settings, gas=False))
    # held to the table, the bodies cannot take over what the cylinder does; freed, they can
    free = dataclasses.replace(settings, body=FREE)
    report("all terms, bodies free", free)
    report("without the cylinder, bodies free", dataclasses.replace(free, gas=False))
    if options.terms:
        for name, changed in without(settings).items():
            report(f"without {name}", changed)
    if options.settings:
        print(f"mean errors by cross-validation on A [%], in {BLOCKS} blocks")
        bare = {f"without {name}": changed for name, changed in without(settings).items()}
        for name, changed in {"these": settings, **bare, **others(settings)}.items():
            model = model_of(machine, changed)
            found_by = cross_validated(model, rows_of(model, *recordings["A"]), changed)
            print(f"{name:36s}" + "".join(f"  {100 * each.mean:5.2f}" for each in found_by))
    print(f"gas scale {scale:.3f}")
    print(f"gas pressure against nine measured pairs: {pressure_error(machine):.2f} bar RMS")
    print(f"smallest eigenvalue of a scaled pseudo-inertia: {found.smallest.min():.2e} kg")


if __name__ == "__main__":
    main()
