"""Orifices, oil, valve and friction of the lift cylinder: equations (21) to (32)."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import PPoly

import crane
from crane.common.samples import Array
from crane.control import ValveSignals
from crane.hydraulics.hydraulic_circuit import PDGains
from crane.identification.hydraulics.cylinder_equations import cylinder_signals
from crane.identification.hydraulics.cylinder_friction import (
    CylinderFriction,
    identify_cylinder_friction,
)
from crane.identification.hydraulics.orifice_coefficients import (
    METHODS,
    OrificeCoefficients,
    identify_orifices,
)
from crane.identification.hydraulics.valve_curve import ValveCurve, identify_valve
from crane.identification.signals.signal_processing import differentiate, low_pass
from hydraulic_forwarder.experiment import (
    COEFFICIENTS,
    CYLINDERS,
    LIFTS,
    OIL,
    STEP,
    Crane,
    averaged,
    crane_of,
    measured,
    perform,
)
from hydraulic_forwarder.paper import ANGLES

JOINT = "X_lift"
TRUE = np.array([1 / OIL, *COEFFICIENTS[JOINT]])
LEVEL = (0.4, -0.4, 0.4)  # [rad], [m] where the extension is level
LIFTED = (0.3, -0.4, 0.4)
SPEEDS = (3.3e-3, 4e-3, 5e-3, 6.5e-3, 8.5e-3, 12e-3, 18e-3, 30e-3, 45e-3)  # [m/s]
PASSES = 12  # over which strokes of constant speed are averaged
Runs = dict[str, crane.Recording]


def lifts(kind: str) -> tuple[Crane, Runs]:
    """The three recordings of Figure 8 by a crane of that kind, as they were."""
    plant = crane_of(kind)
    return plant, {name: perform(plant, motion) for name, motion in LIFTS.items()}


def logged(
    plant: Crane, runs: Runs, folder: Path, share: float = 1.0, spool: bool = False
) -> Runs:
    """The same through the logger, one averaged period each."""
    return {
        name: averaged(
            measured(plant, run, folder, 100 + int(name), share, spool), LIFTS[name].period
        )
        for name, run in runs.items()
    }


def identified(
    plant: Crane, runs: Runs, methods: tuple[str, ...] = METHODS
) -> dict[str, OrificeCoefficients]:
    """X of the lift cylinder by method."""
    return {
        method: identify_orifices(plant.machine, list(runs.values()), JOINT, method)
        for method in methods
    }


def left_out(plant: Crane, runs: Runs, method: str) -> dict[str, OrificeCoefficients]:
    """X from all recordings but one, by the name of that one."""
    return {
        name: identify_orifices(
            plant.machine, [run for other, run in runs.items() if other != name], JOINT, method
        )
        for name in runs
    }


def softness(machine: crane.Machine, x: Array) -> tuple[Array, Array]:
    """1/K of both chambers (N,) [1/Pa] along the stroke (N,) [m]."""
    assert machine.hydraulics is not None
    oil, cylinder = machine.hydraulics.oil, machine.hydraulics.cylinders[JOINT]
    stroke = float(np.ptp([machine.lower[0], machine.upper[0]]))
    out = []
    for area, hose, left in (
        (cylinder.area_a, cylinder.hose_a, x),
        (cylinder.area_b, cylinder.hose_b, stroke - x),
    ):
        volume = hose + area * left
        value = np.full_like(x, 1 / oil.bulk_modulus)
        if oil.steel_modulus:
            value += (1 - hose / volume) / oil.steel_modulus
        if oil.hose_modulus:
            value += hose / volume / oil.hose_modulus
        out.append(value)
    return out[0], out[1]


@dataclass(frozen=True)
class Sizes:
    """What a lifting recording is like, for the table beside Figure 8.

    Attributes:
        u: Largest share of the spool's stroke that the voltage asks for.
        rate: Largest F' as the smoother estimates it [N/s].
        slow: The same below 0.5 Hz, without the boom's swing.
        left: Largest |Y| [m2/s].
        share: RMS of F' / beta over that of Y, beta that of the oil.
    """

    u: float
    rate: float
    slow: float
    left: float
    share: float


def sides_of(plant: Crane, run: crane.Recording) -> tuple[Array, Array, Array]:
    """u, F' [N/s] and Y [m2/s] of an averaged lifting recording (N,)."""
    machine = plant.machine
    assert machine.hydraulics is not None
    cylinder, valve = machine.hydraulics.cylinders[JOINT], machine.hydraulics.valves[JOINT]
    signals = cylinder_signals(machine, run, JOINT)
    count = len(run.time)
    force = cylinder.area_a * signals.p_a - cylinder.area_b * signals.p_b
    columns = np.column_stack([force, signals.x])
    found = differentiate(STEP * np.arange(3 * count), np.tile(columns, (3, 1)))
    rate, speed = found.v[count : 2 * count].T
    volume_a = cylinder.hose_a + cylinder.area_a * signals.x
    volume_b = cylinder.hose_b + cylinder.area_b * (signals.stroke - signals.x)
    Y = -speed * (cylinder.area_a**2 / volume_a + cylinder.area_b**2 / volume_b)
    u = (run.channels[f"voltage_{JOINT}"] - valve.neutral) / (valve.full - valve.neutral)
    return u, rate, Y


def sizes(plant: Crane, runs: Runs) -> dict[str, Sizes]:
    """By recording."""
    out = {}
    for name, run in runs.items():
        u, rate, Y = sides_of(plant, run)
        share = float(np.linalg.norm(rate) / OIL / np.linalg.norm(Y))
        slow = low_pass(STEP * np.arange(3 * len(rate)), np.tile(rate, 3), 0.5)
        slow = slow[len(rate) : 2 * len(rate)]
        out[name] = Sizes(*(float(np.abs(x).max()) for x in (u, rate, slow, Y)), share)
    return out


def with_valve(plant: Crane, **numbers: float) -> Crane:
    """The crane as somebody takes it to be whose numbers of the lift valve are others."""
    circuit = plant.machine.hydraulics
    assert circuit is not None
    valve = dataclasses.replace(circuit.valves[JOINT], **numbers)
    other = dataclasses.replace(circuit, valves=dict(circuit.valves) | {JOINT: valve})
    return Crane(plant.machine.replace(hydraulics=other), plant.joints)


def signals_used(plant: Crane, runs: Runs, folder: Path) -> dict[str, OrificeCoefficients]:
    """X by what stands for the opening."""
    voltage = logged(plant, runs, folder)
    spool = logged(plant, runs, folder, spool=True)
    at_once = with_valve(plant, rate=0.0, bandwidth=0.0)

    def found(who: Crane, which: Runs) -> OrificeCoefficients:
        return identified(who, which, ("chambers",))["chambers"]

    return {
        "voltage, through the spool's second order": found(plant, voltage),
        "voltage, taken as the opening": found(at_once, voltage),
        "spool position": found(plant, spool),
    }


def disturbed(plant: Crane, runs: Runs) -> dict[str, OrificeCoefficients]:
    """X from logged recordings with sensors or assumptions that are off."""

    def shifted(channel: str, by: float) -> Runs:
        return {
            name: dataclasses.replace(
                run, channels=run.channels | {channel: run.channels[channel] + by}
            )
            for name, run in runs.items()
        }

    def late(samples: int) -> Runs:
        return {
            name: dataclasses.replace(
                run,
                channels={
                    key: np.roll(values, samples) if key.startswith("pressure") else values
                    for key, values in run.channels.items()
                },
            )
            for name, run in runs.items()
        }

    moved = {name: dataclasses.replace(run, q=run.q + [2e-3, 0, 0]) for name, run in runs.items()}
    cases = {
        "nothing": (plant, runs),
        "supply pressure read 1 bar low": (plant, shifted("pressure_supply", -1e5)),
        "pressure of chamber A read 1 bar high": (plant, shifted(f"pressure_{JOINT}_a", 1e5)),
        "stroke read 2 mm long": (plant, moved),
        "dead band taken as 0.1043 (is 0.1143)": (with_valve(plant, dead_band=0.1043), runs),
        "neutral voltage taken as 5.85 V (is 5.80)": (with_valve(plant, neutral=5.85), runs),
        "pressures 20 ms late": (plant, late(4)),
    }
    return {
        name: identified(who, which, ("chambers",))["chambers"]
        for name, (who, which) in cases.items()
    }


def staircase(
    joint: str,
    posture: tuple[float, float, float],
    folder: Path,
    share: float = 1.0,
    kind: str = "published",
    leakage: bool = True,
) -> ValveCurve:
    """A valve's curve from steps of its voltage, speeds by the Kalman smoother.

    Args:
        joint: The cylinder's.
        posture: Joint coordinates at the start.
        folder: For the logger's file.
        share: Of the noise.
        kind: Of the crane, see `crane_of`.
        leakage: Whether its closed spools leak.
    """
    plant = crane_of(kind)
    if not leakage:
        tight = {f"cylinder.{x}.leakage_{side}": 0.0 for x in CYLINDERS for side in "ab"}
        machine = crane.load(
            "patu655", dict(plant.machine.parameter_changes) | tight, {"slew": 0.0}
        )
        plant = Crane(machine, machine.with_active_joints(ANGLES))
    volts, hold, ramp = [], 2.5, 0.1
    for up, down in ((0.40, 0.42), (0.5, 0.5), (0.6, 0.6), (0.75, 0.7), (0.9, 0.85), (1.1, 1.0)):
        volts += [5.8 - up, 5.8, 5.8 + down, 5.8]
    time, levels = [0.0], [5.8]
    for level in volts:
        time += [time[-1] + ramp, time[-1] + ramp + hold]
        levels += [level, level]
    run = crane.simulate(
        plant.machine,
        ValveSignals(plant.machine, time, {joint: levels}),
        initial=plant.strokes(np.array([posture]))[0],
        duration=round(time[-1], 2),
        step=STEP,
    )
    read = measured(plant, run, folder, 200, share)
    return identify_valve(plant.machine, read, joint, settle=1.0)


def friction_strokes(folder: Path, share: float, masses: float = 1.0) -> CylinderFriction:
    """Friction of the lift cylinder from strokes at constant speeds both ways.

    Args:
        folder: For the logger's file.
        share: Of the noise of one pass; `PASSES` passes are averaged.
        masses: By what factor the lift boom's mass is taken wrongly.
    """
    plant = crane_of("published")
    machine = plant.machine
    start = plant.strokes(np.array([LIFTED]))[0]
    time, speed = [0.0], [0.0]
    for size in SPEEDS:
        for sense in (1, -1):
            hold = min(0.05 / size, 8.0)
            time += list(time[-1] + np.array([0.4, 0.9, 0.9 + hold, 1.4 + hold]))
            speed += [0.0, sense * size, sense * size, 0.0]
    t, v = np.array(time), np.array(speed)
    rise = np.diff(v) / np.diff(t)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    pieces = np.zeros((3, len(rise), 3))
    pieces[2] = start
    pieces[:, :, 0] = rise / 2, v[:-1], start[0] + way[:-1]
    gains = {"X_lift": PDGains(20, 0.1), "X_tilt": PDGains(10, 0.05), "X_ext": PDGains(10, 0.1)}
    path = crane.motion.Trajectory(PPoly(pieces, t))
    run = crane.simulate(
        machine, crane.ValvePD(machine, path, gains), duration=round(t[-1], 1), step=STEP
    )
    read = measured(plant, run, folder, 300, share / np.sqrt(PASSES))
    taken = machine
    if masses != 1.0:
        mass = {"lift_boom.mass": masses * 143.66}
        taken = crane.load("patu655", dict(machine.parameter_changes) | mass, {"slew": 0.0})
    return identify_cylinder_friction(taken, read, JOINT)
