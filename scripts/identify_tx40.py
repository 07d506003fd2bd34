"""The TX40 identified from a recording, and judged by the part of it that was not used.

    python scripts/identify_tx40.py ../shared/data              # identify and print
    python scripts/identify_tx40.py ../shared/data --terms      # what each term brings
    python scripts/identify_tx40.py ../shared/data --settings   # cross-validation of settings

Motor 6 turns with joints 5 and 6: its rotor and its friction act on q5 + q6. First ordinary least
squares with Coulomb and viscous friction on the whole recording; then the first 60 % of the time
teach and the rest judges, without and with Stribeck friction and a prior. Settings come from
cross-validation in blocks of the first 60 %.
"""

import argparse
import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import crane
from crane.common.samples import Array
from crane.identification.estimation.estimators import least_squares, weighted
from crane.identification.mechanics.base import base_parameters
from crane.identification.mechanics.model import (
    PER_BODY,
    Direction,
    Inertial,
    Model,
    RotorInertia,
    Term,
    friction,
)
from crane.identification.signals.motion import differentiate, filter_rows

RATIO = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])  # motors by joints
RATIO[5, 4] = 32.0
ZERO = np.array([0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0])
SLOW = np.array([0.05009, 0.05009, 0.07505, 0.07156, 0.05585, 0.12217])  # [rad/s]
DIFFERENTIATION, BANDWIDTH, THINNING = 100.0, 20.0, 50  # [Hz], [Hz], samples
MOTOR6 = Direction("motor6", {"q5": 1.0, "q6": 1.0})
TRAINING = 0.6  # of the time
SCALE = {"q1": 7.0, "q2": 7.0, "q3": 7.0, "q4": 3.0, "q5": 2.0, "q6": 2.0, "motor6": 2.0}  # [N m]
BLOCKS, APART = (3, 6), 0.1  # of cross-validation, and the time between training and test [s]


@dataclass(frozen=True)
class Settings:
    """What cross-validation decided.

    Attributes:
        stribeck: Velocities of stiction [rad/s].
        body: Standard deviation of bodies, relative to mass and size.
        least: Least size of a body that this counts with [m]: the wrist's printed inertias are
            close to none.
        rotor: Standard deviation of rotor inertias about 0.1 kg m2.
        friction: That of friction, relative to `SCALE`.
    """

    stribeck: tuple[float, ...] = (0.3, 1.0)
    body: float = 0.03
    least: float = 0.1
    rotor: float = 0.3
    friction: float = 10.0


def model_of(machine: crane.Machine, stribeck: tuple[float, ...] = ()) -> Model:
    """Bodies, and rotor inertia, friction and offset of each joint and of the coupled motor."""
    terms: list[Term] = [Inertial(machine)]
    for direction in (*machine.active, MOTOR6):
        kinds = ["coulomb", "viscous"]
        if direction is not MOTOR6:
            kinds.append("coulomb_offset")
        terms.append(RotorInertia(machine, direction))
        terms.append(friction(machine, direction, kinds, smoothing=0.0, stribeck=stribeck))
    return Model(machine, terms)


def prior_of(model: Model, settings: Settings) -> tuple[Array, Array]:
    """Means and standard deviations of all parameters."""
    mean, std = model.nominal.copy(), np.zeros(len(model.names))
    for i, name in enumerate(model.names):
        where, kind = name.split(".", 1)
        if where in model.bodies and kind in PER_BODY:
            body = model.nominal[10 * (i // 10) : 10 * (i // 10) + 10]
            size = max(math.sqrt(max(body[4], body[6], body[9]) / body[0]), settings.least)
            power = (0, 1, 1, 1, 2, 2, 2, 2, 2, 2)[PER_BODY.index(kind)]
            std[i] = settings.body * body[0] * size**power
        elif kind == "rotor":
            mean[i], std[i] = 0.1, settings.rotor
        else:
            std[i] = settings.friction * SCALE[where]
    return mean, std


@dataclass(frozen=True, eq=False)
class Rows:
    """Filtered and thinned equations tau = W beta.

    Attributes:
        time: (M,) [s].
        W: (M, n, p).
        tau: (M, n) [N m].
        counted: (M, n) moving rows.
    """

    time: Array
    W: Array
    tau: Array
    counted: np.ndarray

    def stacked(self, kept: np.ndarray) -> tuple[Array, Array, np.ndarray, np.ndarray]:
        """W, tau, joint and instant of the moving rows at some instants (M,)."""
        joint, instant = np.nonzero((self.counted & kept[:, None]).T)
        return self.W[instant, joint], self.tau[instant, joint], joint, instant


def rows_of(folder: Path, model: Model) -> Rows:
    """The recording's equations on the joints' side."""
    with np.load(folder / "tx40" / "tx40_recording.npz") as file:
        time, motors, torques = file["time"], file["motor_position"], file["motor_torque"]
    q, tau = np.linalg.solve(RATIO, motors.T).T + ZERO, torques @ RATIO
    found = differentiate(time, q, "lowpass", DIFFERENTIATION)
    W = model.regressor(model.samples(found.q, found.v, found.a))
    step = float(time[1] - time[0])
    W, tau = filter_rows(W, tau, step, BANDWIDTH, THINNING)
    counted = np.abs(found.v[::THINNING]) > SLOW
    counted[:3] = counted[-3:] = False  # where the filter starts
    return Rows(time[::THINNING], W, tau, counted)


def relative(error: Array, tau: Array) -> float:
    """Norm of the error over that of the torque."""
    return float(np.linalg.norm(error) / np.linalg.norm(tau))


def plain(model: Model, rows: Rows, kept: np.ndarray) -> tuple[Array, Array]:
    """Ordinary least squares of the base parameters: their columns, and their values."""
    base = base_parameters(model)
    W, tau, joint, instant = rows.stacked(kept)
    return base.independent, least_squares(W[:, base.independent], tau, joint, instant).values


def regularised(model: Model, rows: Rows, kept: np.ndarray, settings: Settings) -> Array:
    """Rows by the noise of their joint, parameters towards the prior."""
    return weighted(*rows.stacked(kept), prior_of(model, settings)).values


def tested(rows: Rows, kept: np.ndarray, columns: np.ndarray | slice, values: Array) -> float:
    """Relative error over some instants."""
    W, tau, *_ = rows.stacked(kept)
    return relative(tau - W[:, columns] @ values, tau)


def cross_validated(model: Model, rows: Rows, settings: Settings) -> list[float]:
    """Relative error of blocks of the training part by what the others teach."""
    training = np.flatnonzero(rows.time <= TRAINING * rows.time[-1])
    prior, found = prior_of(model, settings), []
    margin = round(APART / float(rows.time[1] - rows.time[0]))
    for count in BLOCKS:
        errors, torques = [], []
        for block in np.array_split(training, count):
            kept, judged = np.zeros((2, len(rows.time)), dtype=bool)
            kept[training] = True
            kept[max(0, block[0] - margin) : block[-1] + 1 + margin] = False
            judged[block] = True
            values = weighted(*rows.stacked(kept), prior).values
            W, tau, *_ = rows.stacked(judged)
            errors.append(tau - W @ values)
            torques.append(tau)
        found.append(relative(np.concatenate(errors), np.concatenate(torques)))
    return found


def choices(settings: Settings) -> dict[str, Settings]:
    """Settings that were compared."""
    changes = {
        "no Stribeck friction": {"stribeck": ()},
        "one Stribeck velocity, 0.6 rad/s": {"stribeck": (0.6,)},
        "three, 0.2, 0.6 and 2 rad/s": {"stribeck": (0.2, 0.6, 2.0)},
        "bodies 10 %": {"body": 0.1},
        "bodies 30 %": {"body": 0.3},
        "printed wrist as it is": {"least": 0.0},
        "rotors within 0.03 kg m2": {"rotor": 0.03},
        "friction within its scale": {"friction": 1.0},
    }
    return {name: dataclasses.replace(settings, **change) for name, change in changes.items()}  # type: ignore[arg-type]


def main() -> None:
    """Identify and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder that holds tx40/")
    parser.add_argument("--terms", action="store_true", help="what each setting does to the test")
    parser.add_argument("--settings", action="store_true", help="cross-validation of settings")
    options = parser.parse_args()
    machine = crane.load("tx40")
    settings = Settings()

    model = model_of(machine)
    rows = rows_of(options.data, model)
    every = np.ones(len(rows.time), dtype=bool)
    first = rows.time <= TRAINING * rows.time[-1]
    columns, values = plain(model, rows, every)
    W, tau, *_ = rows.stacked(every)
    error = tau - W[:, columns] @ values
    print(f"ordinary least squares: {len(values)} parameters, {len(tau)} rows, "
          f"relative residual {100 * relative(error, tau):.2f} %, "
          f"RMSE {np.sqrt(np.mean(error**2)):.3f} N m")  # fmt: skip

    before = tested(rows, ~first, *plain(model, rows, first))
    full = model_of(machine, settings.stribeck)
    more = rows_of(options.data, full)
    values = regularised(full, more, first, settings)
    after = tested(more, ~first, slice(None), values)
    print("trained on the first 60 %, tested on the rest:")
    print(f"  Coulomb and viscous friction, ordinary least squares: {100 * before:.2f} %")
    print(f"  Stribeck friction, weighted, with a prior: {100 * after:.2f} %, "
          f"{100 * (1 - after / before):.0f} % less")  # fmt: skip

    if options.settings or options.terms:
        for name, other in {"these settings": settings, **choices(settings)}.items():
            same = other.stribeck == settings.stribeck
            this = full if same else model_of(machine, other.stribeck)
            there = more if same else rows_of(options.data, this)
            line = f"  {name:34s}"
            if options.settings:
                line += "".join(f" {100 * x:5.2f} %" for x in cross_validated(this, there, other))
            if options.terms:
                values = regularised(this, there, first, other)
                line += f"  tested {100 * tested(there, ~first, slice(None), values):5.2f} %"
            print(line)


if __name__ == "__main__":
    main()
