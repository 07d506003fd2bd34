"""Mechanisms of published benchmarks as URDF texts."""

import dataclasses

import numpy as np
import urdf_text
from urdf_text import body, frame, joint, loop
from warned import quiet

import crane


def link(name, mass, centre, inertia):
    """A body in the plane of x and y, its inertia about z."""
    return body(name, mass, centre, (inertia / 2, inertia / 2, inertia))


def load(folder, name, parts, home, active):
    """The machine of a URDF's parts."""
    states = "".join(f'<joint name="{x}" value="{value:.17g}"/>' for x, value in home.items())
    state = f'<group_state name="home">{states}</group_state>'
    path = urdf_text.write(folder, name, "base", *parts, state)
    machine = quiet(crane.load, path, active=[next(iter(home))])
    return (
        machine
        if active == machine.active[0]
        else machine.with_home_configuration(machine.home, (active,))
    )


# Andrews' squeezing mechanism: seven bodies, one freedom (Schiehlen 1990; Hairer and Wanner,
# Solving Ordinary Differential Equations II, VII.7; Test Set for IVP Solvers, II-9)
SQUEEZED = {  # at 0.03 s, by PSIDE with tolerances of 1e-14
    "beta": (0.1581077119629904e2, 0.1139920302151208e4),
    "theta": (-0.1575637105984298e2, -0.1424379294994111e4),
    "gamma": (0.4082224013073101e-1, 0.1103291221937134e2),
    "phi": (-0.5347301163226948, 0.1929337464421385e2),
    "delta": (0.5244099658805304, 0.5735699284790808),
    "omega": (0.5347301163226948, -0.1929337464421385e2),
    "epsilon": (0.1048080741042263e1, 0.3231791658026955),
}


def squeezer(folder, active="beta"):
    """Without gravity, under a spring and a constant torque."""
    a, b = (-0.06934, -0.00227, 0), (-0.03635, 0.03273, 0)
    home = {
        "beta": -0.0617138900142764496358948458001,
        "theta": 0.0,
        "gamma": 0.455279819163070380255912382449,
        "phi": 0.222668390165885884674473185609,
        "delta": 0.487364979543842550225598953530,
        "omega": -0.222668390165885884674473185609,
        "epsilon": 1.23054744454982119249735015568,
    }
    parts = [
        link("k1", 0.04325, (0.00092, 0, 0), 2.194e-6),
        link("k2", 0.00365, (-0.0115, 0, 0), 4.410e-7),
        link("k3", 0.02373, (0.01043, -0.01874, 0), 5.255e-6),
        link("k4", 0.00706, (0, -(0.02 - 0.01421), 0), 5.667e-7),
        link("k5", 0.07050, (0.02308, 0.00916, 0), 1.169e-5),
        link("k6", 0.00706, (0.02 - 0.01421, 0, 0), 5.667e-7),
        link("k7", 0.05498, (-0.00449, -0.01228, 0), 1.912e-5),
        joint("beta", "base", "k1"),
        joint("theta", "k1", "k2", (0.007, 0, 0)),
        joint("gamma", "base", "k3", b),
        joint("delta", "base", "k5", a),
        joint("phi", "k5", "k4", (0.04, 0, 0)),
        joint("epsilon", "base", "k7", a),
        joint("omega", "k7", "k6", (0, -0.04, 0)),
        frame("e2", "k2", (-0.028, 0, 0)),
        frame("e3", "k3", (0, -0.035, 0)),
        frame("e4", "k4", (0, -0.02, 0)),
        frame("e6", "k6", (0.02, 0, 0)),
        frame("c", "base", (0.014, 0.072, 0)),
        frame("d", "k3", (0.02, -0.018, 0)),
        *(loop(f"e2_{other}", "e2", other) for other in ("e3", "e4", "e6")),
    ]
    machine = load(folder, "squeezer", parts, home, active)
    spring = crane.description.ForceElement("", stiffness=4530.0, rest=0.07785, between=("c", "d"))
    model = machine.model.copy()
    model.gravity.linear = np.zeros(3)
    forces = (spring, crane.description.ForceElement("beta", force=0.033))
    return dataclasses.replace(machine, forces=forces, model=model)


def governor(folder):
    """Flyballs on arms that push a collar along the shaft against a stiff spring and damper."""
    lean = np.pi / 6
    parts = [
        link("shaft", 1.0, (0, 0, 0), 0.1),
        joint("spin", "base", "shaft"),
        body("collar", 1.0, moments=(0.01, 0.01, 0.01)),
        joint("collar", "shaft", "collar", kind="prismatic", limits=(-9, 9)),
    ]
    home = {"spin": 0.0, "collar": -np.cos(lean)}
    for side, sign in (("left", -1.0), ("right", 1.0)):
        for rod, length, mass, far in (("arm", 1.0, 0.3, 5.0), ("link", 0.5, 0.2, 0.0)):
            centre = -length * (0.5 * mass + far) / (mass + far)
            inertia = mass * length**2 / 12 + mass * (centre + length / 2) ** 2
            inertia += far * (centre + length) ** 2
            moments = (inertia, inertia, 0.001)
            parts.append(body(f"{rod}_{side}", mass + far, (0, 0, centre), moments))
        parts += [
            joint(f"arm_{side}", "shaft", f"arm_{side}", axis=(0, 1, 0)),
            joint(f"link_{side}", f"arm_{side}", f"link_{side}", (0, 0, -0.5), axis=(0, 1, 0)),
            frame(f"end_{side}", f"link_{side}", (0, 0, -0.5)),
            frame(f"eye_{side}", "collar", (0, 0, 0)),
            loop(f"pin_{side}", f"eye_{side}", f"end_{side}", (0, 1, 0)),
        ]
        home[f"arm_{side}"], home[f"link_{side}"] = -sign * lean, 2 * sign * lean
    machine = load(folder, "governor", parts, home, "spin")
    machine = machine.with_active_joints(("spin", "collar"))
    stiff = crane.description.ForceElement("collar", 8e5, -np.cos(lean), 4e4)
    return machine.replace(forces=(stiff,))


def bricard(folder, active="j0"):
    """Six bars of 1 m and 1 kg along the edges of a cube, one of them fixed: overconstrained."""
    corners = np.array([
        [0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1],
    ], dtype=float)  # fmt: skip
    axes = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]])
    parts, before, here = [], "base", np.zeros(3)
    for i in range(5):
        way = corners[i + 1] - corners[i]
        across = (1 - way**2) / 12 + 1e-6
        parts.append(body(f"bar{i}", 1.0, way / 2, across))
        parts.append(joint(f"j{i}", before, f"bar{i}", corners[i] - here, axis=axes[i]))
        before, here = f"bar{i}", corners[i]
    parts += [
        frame("far", "bar4", corners[5] - corners[4]),
        frame("near", "base", corners[5]),
        loop("j5", "near", "far", axes[5]),
    ]
    return load(folder, "bricard", parts, {f"j{i}": 0.0 for i in range(5)}, active)
