"""All results that the page and its figures show, computed once."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crane.common.samples import Array
from crane.identification.hydraulics.cylinder_equations import EquationSides
from crane.identification.hydraulics.cylinder_friction import CylinderFriction
from crane.identification.hydraulics.orifice_coefficients import OrificeCoefficients
from crane.identification.hydraulics.valve_curve import ValveCurve
from crane.identification.mechanics.identification_result import Identification
from crane.identification.signals.signal_processing import Motion
from hydraulic_forwarder import circuit, mechanics
from hydraulic_forwarder.experiment import LIFTS, MOTIONS, averaged, crane_of, measured, perform

MODELS = ("closed", "seven", "seven, friction at joints")
KINDS = ("paper", "rigid", "orifices")
REST = tuple(body for group in mechanics.REST.values() for body in group)


@dataclass(frozen=True, eq=False)
class Results:
    """What was found.

    Attributes:
        plant: The crane of the mechanical part.
        motions: Averaged, by set.
        references: q, q', q'' over the same time, by set.
        found: Identified parameters by model; "seven, rest known" of torques without the rest,
            "seven, stiction" the same with stiction of the Stribeck velocity 5 mm/s.
        judged: Held-out sets by model ("true": by the true parameters) and set.
        shares: RMS and largest part of the forces (3,) that bodies ask for, by group of them.
        oscillation: Frequency of the strongest swing of tau_2 above 1 Hz [Hz].
        clean: X without noise, by method, on the crane of the paper's equations.
        quiet: The same by "ls" with a tenth of the noise, as of a hundred times the periods.
        tight: X without noise on the machine without leakage, by "chambers".
        noisy: X by kind of the crane and method.
        left_out: X from two recordings by kind, method and the third's name.
        predicted: Relative error of (29) on the third, likewise.
        sizes: Of the lifting recordings.
        lifting: For Figure 8: time, reference, u, F'.
        held_out: For Figure 9: sides of (29) of each recording by X of the others.
        all_joints: Relative error of (29) on sets 1 and 2, in which all joints move.
        softness: Ranges (2, 2) of 1/K in A and B over the lifts [1/Pa].
        signals: X by what stands for the opening.
        disturbed: X by what is off.
        valves: Curves by joint.
        edges: Curve of the lift valve without compensation.
        friction: From averaged passes; `still` without noise; `heavy` with a lift boom that is
            taken 5 % too heavy.
        law: True friction (2, N): speeds, forces.
    """

    plant: circuit.Crane
    motions: dict[str, Motion]
    references: dict[str, tuple[Array, Array, Array]]
    found: dict[str, Identification]
    judged: dict[str, dict[str, mechanics.HeldOutForces]]
    shares: dict[str, tuple[Array, Array]]
    oscillation: float
    clean: dict[str, OrificeCoefficients]
    quiet: OrificeCoefficients
    tight: OrificeCoefficients
    noisy: dict[str, dict[str, OrificeCoefficients]]
    left_out: dict[str, dict[str, dict[str, OrificeCoefficients]]]
    predicted: dict[str, dict[str, dict[str, float]]]
    sizes: dict[str, circuit.Sizes]
    lifting: list[tuple[Array, Array, Array, Array]]
    held_out: dict[str, EquationSides]
    all_joints: dict[str, float]
    softness: Array
    signals: dict[str, OrificeCoefficients]
    disturbed: dict[str, OrificeCoefficients]
    valves: dict[str, ValveCurve]
    edges: ValveCurve
    friction: CylinderFriction
    still: CylinderFriction
    heavy: CylinderFriction
    law: Array


def compute(folder: Path) -> Results:
    """All of it; the logger's files go to a folder."""
    plant = crane_of("orifices")
    motions, references, recorded = {}, {}, {}
    for seed, (name, motion) in enumerate(MOTIONS.items()):
        run = measured(plant, perform(plant, motion), folder, seed)
        recorded[name] = averaged(run, motion.period)
        motions[name] = mechanics.joint_motion(plant, run, motion.period)
        references[name] = motion(motion.lead + motions[name].time)
    learn = motions["learn"]
    found = {model: mechanics.learned(plant.joints, learn, model) for model in MODELS}
    alone = mechanics.without(plant.joints, learn, REST)
    found["seven, rest known"] = mechanics.learned(plant.joints, alone, "seven")
    found["seven, stiction"] = mechanics.learned(plant.joints, alone, "seven", (5e-3,))
    judged: dict[str, dict[str, mechanics.HeldOutForces]] = {}
    for name in ("set 1", "set 2"):
        motion = motions[name]
        for model in MODELS:
            judged.setdefault(model, {})[name] = mechanics.judge(found[model], motion)
        rest = mechanics.forces_of(plant.joints, motion, REST)
        judged.setdefault("seven, rest known", {})[name] = mechanics.judge(
            found["seven, rest known"], motion, rest
        )
        judged.setdefault("true", {})[name] = mechanics.true_forces(plant.joints, motion)
    shares = {}
    whole = np.sqrt(np.mean(motions["set 1"].tau ** 2, axis=0))
    for group, bodies in (mechanics.REST | {"all of these": REST}).items():
        part = mechanics.forces_of(plant.joints, motions["set 1"], bodies)
        shares[group] = np.sqrt(np.mean(part**2, axis=0)) / whole, np.abs(part).max(axis=0)

    clean: dict[str, OrificeCoefficients] = {}
    noisy: dict[str, dict[str, OrificeCoefficients]] = {}
    left_out: dict[str, dict[str, dict[str, OrificeCoefficients]]] = {}
    predicted: dict[str, dict[str, dict[str, float]]] = {}
    for kind in KINDS:
        lifter, runs = circuit.lifts(kind)
        if kind == "paper":
            # as they come: averages of what is not quite periodic would not be exact
            exact = {name: measured(lifter, run, folder, 0, 0.0) for name, run in runs.items()}
            clean = circuit.identified(lifter, exact)
            tenth = circuit.logged(lifter, runs, folder, 0.1)
            quiet = circuit.identified(lifter, tenth, ("ls",))["ls"]
        logged = circuit.logged(lifter, runs, folder)
        noisy[kind] = circuit.identified(lifter, logged)
        left_out[kind] = {m: circuit.left_out(lifter, logged, m) for m in circuit.METHODS}
        predicted[kind] = {
            method: {name: X.predict(logged[name]).relative_error for name, X in one.items()}
            for method, one in left_out[kind].items()
        }
    # the last kind is the crane itself
    chosen = left_out["orifices"]["chambers"]
    lifting = [
        (run.time, LIFTS[name](LIFTS[name].lead + run.time)[0][:, 0],
         *circuit.sides_of(lifter, run)[:2])
        for name, run in logged.items()
    ]  # fmt: skip
    X = noisy["orifices"]["chambers"]
    x = np.concatenate([run.q[:, 0] for run in logged.values()])
    softness = np.array([[k.min(), k.max()] for k in circuit.softness(lifter.machine, x)])
    friction = circuit.friction_strokes(folder, 1.0)
    return Results(
        plant=plant,
        motions=motions,
        references=references,
        found=found,
        judged=judged,
        shares=shares,
        oscillation=swing(motions["set 1"]),
        clean=clean,
        quiet=quiet,
        tight=without_leakage(folder),
        noisy=noisy,
        left_out=left_out,
        predicted=predicted,
        sizes=circuit.sizes(lifter, logged),
        lifting=lifting,
        held_out={name: chosen[name].predict(run) for name, run in logged.items()},
        all_joints={name: X.predict(recorded[name]).relative_error for name in ("set 1", "set 2")},
        softness=softness,
        signals=circuit.signals_used(lifter, runs, folder),
        disturbed=circuit.disturbed(lifter, logged),
        valves={
            "X_ext": circuit.staircase("X_ext", circuit.LEVEL, folder),
            "X_lift": circuit.staircase("X_lift", circuit.LIFTED, folder),
        },
        edges=circuit.staircase("X_lift", circuit.LEVEL, folder, kind="orifices"),
        friction=friction,
        still=circuit.friction_strokes(folder, 0.0),
        heavy=circuit.friction_strokes(folder, 0.0, 1.05),
        law=true_law(friction.speed),
    )


def without_leakage(folder: Path) -> OrificeCoefficients:
    """X of the machine whose closed spools do not leak, without noise."""
    lifter, runs = circuit.lifts("tight")
    exact = {name: measured(lifter, run, folder, 0, 0.0, spool=True) for name, run in runs.items()}
    return circuit.identified(lifter, exact, ("chambers",))["chambers"]


def swing(motion: Motion) -> float:
    """Frequency of the strongest oscillation of tau_2 above 1 Hz [Hz]."""
    from scipy.signal import periodogram

    frequency, power = periodogram(motion.tau[:, 0], 1 / (motion.time[1] - motion.time[0]))
    fast = frequency > 1
    return float(frequency[fast][power[fast].argmax()])


def true_law(speed: Array) -> Array:
    """Friction of the machine file at speeds both ways (2, N)."""
    law = crane_of("published").machine.friction["X_lift"]
    top = np.abs(speed).max()
    v = np.concatenate([-np.geomspace(top, 3e-3, 200), np.geomspace(3e-3, top, 200)])
    stick = law.coulomb + law.stiction * np.exp(-((v / law.stribeck) ** 2))
    return np.array([v, stick * np.tanh(v / law.smoothing) + law.viscous * v])
