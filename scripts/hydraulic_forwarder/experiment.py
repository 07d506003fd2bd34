"""The crane, its motions, and the logger: a simulated replacement of the paper's laboratory."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

import crane
from crane.common.samples import Array
from crane.hydraulics.hydraulic_circuit import PDGains
from crane.identification.excitation.fourier_trajectory import FourierTrajectory
from crane.identification.signals.signal_processing import average_periods
from crane.recordings import timeseries
from hydraulic_forwarder.paper import ANGLES

LOAD = 80.0  # [kg] at the tip: rotator and gripper of a crane of this size
LEAKAGE = 3.3e-14  # of a closed spool [m3/(s Pa)]
STEP = 5e-3  # [s] of the logger
CYLINDERS = ("X_lift", "X_tilt", "X_ext")

# True c1 to c4 [m3/(s Pa^0.5)]. The published valve has 8.0e-7 where its compensation is lost;
# edges of a spool for cylinders of two areas are narrower at the smaller one.
COEFFICIENTS = {
    "X_lift": (8.0e-7, 6.0e-7, 6.5e-7, 4.5e-7),
    "X_tilt": (10.0e-7, 7.5e-7, 8.0e-7, 5.5e-7),
    "X_ext": (8.0e-7, 6.0e-7, 7.0e-7, 5.0e-7),
}
OIL = 1.65e9  # [Pa], the machine file's

# White noise of usual sensors: encoders of 16 bits, a draw-wire sensor, pressure transmitters of
# 250 bar with 0.08 % of it, read with 12 bits, and the current driver's voltage.
NOISE = {"deg": 0.01, "mm": 0.1, "bar": 0.2, "V": 5e-3}
BITS = 250 / 4096  # [bar]

# With these the crane does not hunt. F_f makes the loop steep around the dead band, and where it
# opens the valve the spool's lag leaves little room for K_d.
GAINS = {
    "X_lift": PDGains(6.0, 0.1),
    "X_tilt": PDGains(10.0, 0.05),
    "X_ext": PDGains(10.0, 0.1),
}


@dataclass(frozen=True, eq=False)
class Crane:
    """One crane, seen from its cylinders and from its joints.

    Attributes:
        machine: Driven by the cylinders.
        joints: The same, driven by q2, q3, q4.
    """

    machine: crane.Machine
    joints: crane.Machine

    def strokes(self, q: Array) -> Array:
        """(N, 3) of the cylinders at joint coordinates (N, 3): x_i(q_i)."""
        return self.joints.closure.solve(q)[:, self.machine.closure.active]

    def ratios(self, q: Array) -> Array:
        """(N, 3, 3) dx / dq."""
        closure = self.joints.closure
        return closure.gamma(closure.solve(q))[:, self.machine.closure.active]

    def torques(self, q: Array, forces: Array) -> Array:
        """tau_2, tau_3, F_4 (N, 3) of cylinder forces (N, 3): (18), (19)."""
        return np.einsum("nij,ni->nj", self.ratios(q), forces)


def crane_of(kind: str) -> Crane:
    """The full-size crane without slewing, its boom as rigid as the paper's.

    Its closed spools leak as valves of this kind may, 20 ml/min at 100 bar.

    Args:
        kind: "published"; "orifices": with the paper's valves (21), (22) in place of compensated
            ones; "tight": and without leakage; "rigid": and with rigid hoses and walls; "paper":
            and with a spool that follows at once, all as in the paper's equations.
    """
    changes = {"payload.mass": LOAD}
    changes |= {f"friction.{joint}.smoothing": 1e-3 for joint in CYLINDERS}  # [m/s]; A
    # strokes follow from angles by the closed loops: nothing gives way in between
    changes |= {f"cylinder.{joint}.stiffness": 0.0 for joint in CYLINDERS}
    changes |= {f"cylinder.{x}.leakage_{side}": LEAKAGE for x in CYLINDERS for side in "ab"}
    if kind != "published":
        for joint, values in COEFFICIENTS.items():
            changes[f"valve.{joint}.margin"] = 0.0
            changes |= {f"valve.{joint}.c{i + 1}": c for i, c in enumerate(values)}
    if kind in ("rigid", "paper"):
        changes |= {"oil.hose_modulus": 0.0, "oil.steel_modulus": 0.0}
    if kind in ("tight", "rigid", "paper"):
        changes |= {f"cylinder.{x}.leakage_{side}": 0.0 for x in CYLINDERS for side in "ab"}
    if kind == "paper":
        for joint in CYLINDERS:
            changes |= {f"valve.{joint}.rate": 0.0, f"valve.{joint}.bandwidth": 0.0}
    machine = crane.load("patu655", changes, {"slew": 0.0})
    return Crane(machine, machine.with_active_joints(ANGLES))


Tones = Mapping[int, tuple[float, float]]


def series(
    period: float, periods: int, rows: Sequence[tuple[float, float, Tones]]
) -> FourierTrajectory:
    """A periodic reference of the joints.

    Args:
        period: [s].
        periods: How many, between half a period of setting out and half a period of ending.
        rows: Per joint least and largest coordinate, and harmonics with their share and phase;
            the same twice for a joint that is held.
    """
    harmonics = max(k for *_, tones in rows for k in tones)
    table, w = np.zeros((1 + 2 * harmonics, len(rows))), 2 * np.pi / period
    time = np.linspace(0, period, 5001)
    for i, (low, high, tones) in enumerate(rows):
        y = sum(share * np.sin(w * k * time + phase) for k, (share, phase) in tones.items())
        scale = (high - low) / np.ptp(y)
        table[0, i] = low - scale * y.min()
        for k, (share, phase) in tones.items():
            table[k, i] = scale * share * w * k * np.cos(phase)
            table[harmonics + k, i] = -scale * share * w * k * np.sin(phase)
    return FourierTrajectory(table, period, periods)


# To learn from, and the validation sets of Figures 4 and 5
MOTIONS = {
    "learn": series(
        60.0,
        4,
        [
            (0.20, 0.75, {1: (1, 0), 3: (0.5, 1), 5: (0.1, 2)}),
            (-1.05, -0.20, {2: (0.7, 0.5), 5: (0.5, 0), 9: (0.1, 1)}),
            (0.40, 1.15, {1: (0.3, 2), 4: (1, 0), 7: (0.3, 1)}),
        ],
    ),
    "set 1": series(
        60.0,
        4,
        [
            (0.30, 0.65, {1: (1, 0), 2: (0.55, 1)}),
            (-0.90, -0.30, {2: (1, 0.5), 4: (0.5, 0)}),
            (0.50, 1.10, {4: (1, 0), 5: (0.4, 1)}),
        ],
    ),
    "set 2": series(
        50.0,
        4,
        [
            (0.35, 0.70, {2: (1, 0.3), 3: (0.6, 1)}),
            (-1.00, -0.40, {4: (1, 0.5), 6: (0.5, 0.5)}),
            (0.50, 1.05, {3: (1, 1), 5: (0.4, 1)}),
        ],
    ),
}
HELD = ((-0.6, -0.6, {1: (1, 0)}), (0.8, 0.8, {1: (1, 0)}))
# Those of Figure 8: the lift boom alone
LIFTS = {
    "1": series(20.0, 3, [(-0.15, 0.45, {1: (1, 0), 3: (0.15, 1)}), *HELD]),
    "2": series(30.0, 5, [(-0.15, 0.55, {1: (1, 0), 2: (0.4, 2)}), *HELD]),
    "3": series(25.0, 4, [(-0.05, 0.45, {1: (1, 0), 2: (0.3, 1), 5: (0.05, 0)}), *HELD]),
}


def perform(plant: Crane, motion: FourierTrajectory, step: float = STEP) -> crane.Recording:
    """Follow a reference by (37) and record its steady periods.

    The joints' reference is mapped to strokes by the closed loops.
    """
    time = np.linspace(0.0, motion.duration, round(motion.duration / 0.02) + 1)
    path = crane.motion.Trajectory(CubicSpline(time, plant.strokes(motion(time)[0])))
    control = crane.ValvePD(plant.machine, path, GAINS)
    whole = crane.simulate(plant.machine, control, step=step)
    first, count = round(motion.lead / step), round(motion.periods * motion.period / step)
    return cut(whole, first, count)


def cut(recording: crane.Recording, first: int, count: int) -> crane.Recording:
    """Some samples of a recording, from time zero."""
    kept = slice(first, first + count)
    return dataclasses.replace(
        recording,
        time=recording.time[kept] - recording.time[first],
        q=recording.q[kept],
        v=recording.v[kept],
        tau=recording.tau[kept],
        channels={name: values[kept] for name, values in recording.channels.items()},
    )


def log(
    recording: crane.Recording,
    path: Path,
    random: np.random.Generator,
    share: float = 1.0,
    spool: bool = False,
) -> None:
    """Write what a crane's data logger would: angles in deg, pressures in bar, voltages.

    Args:
        recording: What happened.
        path: CSV to write.
        random: Of the noise.
        share: Of `NOISE`; none and unrounded with 0.
        spool: Whether it has the spools' positions, which few valves tell.
    """
    columns: dict[str, tuple[str, Array]] = {}
    count = len(recording.time)

    def add(name: str, unit: str, values: Array) -> None:
        noisy = values + share * NOISE.get(unit, 0.0) * random.standard_normal(count)
        if unit == "bar" and share:
            noisy = np.maximum(np.round(noisy / BITS) * BITS, 0.0)
        columns[name] = unit, noisy

    for joint in ("q2", "q3"):
        add(joint, "deg", np.degrees(recording.channels[joint]))
    add("X_ext", "mm", 1e3 * recording.q[:, recording.joints.index("X_ext")])
    chambers = [f"{joint}_{side}" for joint in recording.joints for side in "ab"]
    for place in ("supply", "tank", *chambers):
        add(f"pressure_{place}", "bar", recording.channels[f"pressure_{place}"] / 1e5)
    for joint in recording.joints:
        add(f"voltage_{joint}", "V", recording.channels[f"voltage_{joint}"])
        if spool:
            columns[f"spool_{joint}"] = "", recording.channels[f"spool_{joint}"]
    units = {"time": "s"} | {name: unit for name, (unit, _) in columns.items()}
    values = np.column_stack([recording.time, *(values for _, values in columns.values())])
    timeseries.write_table(path, timeseries.Table(units, values, {"machine": recording.machine}))


def measured(
    plant: Crane,
    recording: crane.Recording,
    folder: Path,
    seed: int,
    share: float = 1.0,
    spool: bool = False,
) -> crane.Recording:
    """What comes back from the logger's file, as for any crane.

    Strokes by closing the loops, forces by (20).
    """
    path = folder / "logger.csv"
    log(recording, path, np.random.default_rng(seed), share, spool)
    return crane.recordings.read_measured(plant.machine, path)


def averaged(recording: crane.Recording, period: float) -> crane.Recording:
    """One period, the mean of all that were recorded."""
    names = list(recording.channels)
    parts = [recording.q, recording.v, recording.tau]
    parts += [recording.channels[name][:, None] for name in names]
    time, columns, _ = average_periods(recording.time, np.hstack(parts), period)
    n = len(recording.joints)
    q, v, tau = (columns[:, i * n : (i + 1) * n] for i in range(3))
    rest = dict(zip(names, columns[:, 3 * n :].T, strict=True))
    return dataclasses.replace(recording, time=time, q=q, v=v, tau=tau, channels=rest)
