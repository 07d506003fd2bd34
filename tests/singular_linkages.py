"""Linkages with dead centres and change points as URDF texts.

They lie in the plane of x and z and turn about y; rods are slender, of 1 kg per rod.
"""

import numpy as np
from benchmark_mechanisms import load
from urdf_text import body, frame, joint, loop


def _joint(name, parent, child, x=0.0):
    return joint(name, parent, child, (x, 0, 0), axis=(0, 1, 0))


def _rod(name, length):
    return body(name, 1.0, (length / 2, 0, 0), (1e-9, length**2 / 12, length**2 / 12))


def _end(rod, length):
    return frame(f"{rod}_end", rod, (length, 0, 0))


def _pin(name, one, two):
    return loop(name, one, two, (0, 1, 0))


def slider_crank(folder, active, crank=1.0, rod=1.0):
    """Of equal lengths branches cross where the slider is at the crank's pin."""
    home = {"a": -np.pi / 4}
    lift = crank * np.sin(np.pi / 4)
    home["b"] = np.pi / 4 + np.arcsin(lift / rod)
    home["s"] = crank * np.cos(np.pi / 4) + np.sqrt(rod**2 - lift**2)
    parts = [
        _rod("crank", crank), _rod("rod", rod),
        body("slider", 1.0, moments=(1e-3, 1e-3, 1e-3)),
        _joint("a", "base", "crank"), _joint("b", "crank", "rod", crank), _end("rod", rod),
        joint("s", "base", "slider", kind="prismatic", axis=(1, 0, 0), limits=(-50, 50)),
        _pin("wrist", "rod_end", "slider"),
    ]  # fmt: skip
    return load(folder, "linkage", parts, home, active)


def four_bar(folder, active, a=1.0, b=0.9, c=1.2, d=2.2):
    """A double rocker of Grashof's second kind: every joint turns back."""
    parts = [
        _rod("one", a), _rod("two", b), _rod("three", c), _joint("a", "base", "one"),
        _joint("b", "one", "two", a), _joint("c", "base", "three", d), _end("two", b),
        _end("three", c), _pin("pin", "two_end", "three_end"),
    ]  # fmt: skip
    return load(folder, "linkage", parts, {"a": -1.0, "b": 0.7, "c": -2.2}, active)


def kite_angles(crank, a=1.0, b=1.5):
    """Joint angles (3, N) of a kite, along its smooth motion: symmetric about a diagonal.

    Crank and base of length a, coupler and rocker of length b; the diagonal through the pins of
    coupler and rocker turns by half the crank's angle.
    """
    tilt = np.arctan2(a * np.sin(crank / 2), np.sqrt(b**2 - (a * np.sin(crank / 2)) ** 2))
    return np.array([crank, -crank / 2 - tilt, crank / 2 + tilt])


def kite(folder, active, coupler="continuous"):
    """Of a crank of 1 m on a base of 1 m, coupler and rocker of 1.5 m; folds once in a turn.

    Its coupler may be on a ball joint, and turns as on a pin.
    """
    parts = [
        _rod("one", 1.0), _rod("two", 1.5), _rod("three", 1.5), _joint("a", "base", "one"),
        joint("b", "one", "two", (1, 0, 0), kind=coupler, axis=(0, 1, 0)), _end("two", 1.5),
        _joint("c", "base", "three", 1.0), _end("three", 1.5),
        _pin("pin", "two_end", "three_end"),
    ]  # fmt: skip
    names = "a", "b_ry" if coupler == "spherical" else "b", "c"
    home = dict(zip(names, kite_angles(-1.0), strict=True))
    return load(folder, "linkage", parts, home, active)


def windows(folder, active, count):
    """N-four-bar of the IFToMM benchmarks: N parallelograms side by side, rods of 1 m.

    Gonzalez, Dopico, Lugris, Cuadrado: A benchmarking system for MBS simulation software (2006).
    All links are in line twice a turn.
    """
    parts, home = [], {}
    for k in range(count + 1):
        parts += [_rod(f"rod{k}", 1.0), _joint(f"r{k}", "base", f"rod{k}", float(k))]
        home[f"r{k}"] = -np.pi / 2
    for k in range(count):
        parts += [_rod(f"bar{k}", 1.0), _joint(f"c{k}", f"rod{k}", f"bar{k}", 1.0)]
        parts += [_end(f"bar{k}", 1.0), _end(f"rod{k + 1}", 1.0)]
        parts += [_pin(f"l{k}", f"bar{k}_end", f"rod{k + 1}_end")]
        home[f"c{k}"] = np.pi / 2
    return load(folder, "linkage", parts, home, active)


def start(machine, joint, speed):
    """Home, with a joint's velocity."""
    rows = machine.closure.gamma(machine.home)[machine.column(joint)]
    return machine.home[machine.closure.active], np.array([speed]) / rows


def postures(machine, run):
    """(N, nq) of a recording."""
    return np.column_stack(
        [
            run.q[:, run.joints.index(j)] if j in run.joints else run.channels[j]
            for j in machine.joints
        ]
    )


def imbalance(run):
    """Of work, energies and dissipation, as a share of the kinetic energy that comes and goes."""
    c = run.channels
    return np.ptp(c["work"] - c["kinetic"] - c["potential"] - c["dissipated"]) / np.ptp(
        c["kinetic"]
    )
