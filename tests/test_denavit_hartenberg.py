"""The model against the Denavit-Hartenberg tables of the paper on the reduced-scale forwarder.

Appendix A of the paper: Table 3 and equations (13), (14), (15) give every body's pose, with the
numbers of Table 4. Misprints found there, and how they are read:

- Text before (13): "A_2^0 = A_1^0 A_2^1 A_3^2" and "A_3^0 = A_1^0 ... A_5^4" use one sign for two
  things. On the left the index counts links (1, 3, 7), on the right rows of the table: CM3 stands
  on the product of rows 1 to 3, CM7 on that of rows 1 to 5. By the convention of chains B, C, D,
  where the index is the last row, these are A_3^0 and A_5^0. "A_1^0 = A_1^0" says nothing.
- Table 4(b) calls PCZ3 what is PCY3 in (13): the boom's y axis is in the crane's plane.
- (15): the matrix of CMA2 has a fifth column and a "1" below its last row; it is that of (14)
  with PCXP2 + K_m X2.
- Before (14) and (15) K_m is "a constant proportional to the displacement": it is the constant
  factor of the displacement, 0.19 without unit.
- (16) is derived from "Eq. (2.2.2)": from (13).
- Table 4: A2B = 0.0424 and A2C = 0.0516 are rounded, sqrt(0.030^2 + 0.030^2) and
  sqrt(0.042^2 + 0.030^2); in (g) and (h) the names stand a row below their values.

All rows of Table 3 are right as printed. Its q5 is no coordinate of the paper's: it is the angle
from actuator A1 to the side D to F of link 2, positive clockwise, and follows from triangles.
"""

from functools import reduce

import numpy as np
import oracles
import pinocchio as pin
import pytest

HALF = np.pi / 2

# Table 4
D2, D3, A1A, A1B = 0.017, 0.087, 0.015, 0.017
A3, A31X, ALPHA10 = 0.22, 0.195, 0.0181
A4, A5, A6, A7 = 0.205, 0.045, 0.0431, 0.222
A2, A2B, A2C, A2D = 0.072, np.hypot(0.030, 0.030), np.hypot(0.042, 0.030), 0.050
AP, KM, PCXP = 0.0825, 0.19, 0.04

# Table 3: theta, d, a, alpha
TABLE_3 = {
    "A": lambda q: [
        (q["q1"], 0, 0, 0),
        (0, D3, A1A, HALF),
        (q["q2"], 0, 0, 0),
        (-ALPHA10, 0, A3, 0),
        (-q["q3"], 0, 0, 0),
    ],
    "B": lambda q: [
        (q["q1"], D2, -A1B, HALF),
        (q["q4"], 0, 0, 0),
        (0, 0, AP, 0),
        (-HALF, 0, 0, -HALF),
        (0, q["X1"], 0, 0),
        (0, 0, 0, HALF),
        (HALF, 0, 0, 0),
        (-q["q5"], 0, A2B, 0),
        (-q["q6"], 0, 0, 0),
        (0, 0, A4, 0),
        (-q["q7"], 0, 0, 0),
    ],
    "C": lambda q: [
        (q["q1"], D3, A1A, HALF),
        (q["q9"], 0, 0, 0),
        (0, 0, A2D, 0),
        (q["q10"], 0, 0, 0),
    ],
    "D": lambda q: [
        (q["q1"], D3, A1A, HALF),
        (q["q2"], 0, A31X, 0),
        (q["q11"], 0, 0, 0),
    ],
}

# Equations (13), (14), (15): chain, last row of the product, centre of mass in its frame
BODIES = {
    "link1": ("A", 1, lambda q: (0.0087, 0, 0.0032)),
    "link3": ("A", 3, lambda q: (0.11, 0.0109, 0)),
    "link7": ("A", 5, lambda q: (0.1061, 0.00025, 0)),
    "A1": ("B", 2, lambda q: (PCXP + KM * q["X1"], 0, 0)),
    "link4": ("B", 9, lambda q: (0.1025, 0, 0)),
    "link6": ("B", 11, lambda q: (0.02, 0.008, 0)),
    "link2": ("C", 2, lambda q: (0.0364, 0.0104, 0)),
    "A2": ("C", 4, lambda q: (PCXP + KM * q["X2"], 0, 0)),
    "link5": ("D", 3, lambda q: (0.0225, 0, 0)),
}


def transform(theta, d, a, alpha):
    """A_i = Rot_z(theta) Trans_z(d) Trans_x(a) Rot_x(alpha), section 2.2.2."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [
            [c, -s * ca, s * sa, a * c],
            [s, c * ca, -c * sa, a * s],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
    )


def product(chain, last, q):
    return reduce(np.matmul, [transform(*row) for row in TABLE_3[chain](q)[:last]])


def interior(opposite, one, two):
    """Angle between two sides of a triangle."""
    return np.arccos((one**2 + two**2 - opposite**2) / (2 * one * two))


def q5(x1):
    """At D: 180 degrees less the angles B D C and C D F."""
    across = interior(np.hypot(A1A + A1B, D3 - D2), AP + x1, A2C)
    return np.pi - across - interior(A2, A2C, A2B)


def body(machine, data, name):
    """Orientation, and centre of mass in the world, of a body or of an actuator's two."""
    parts = [name] if name.startswith("link") else [f"{name}_barrel", f"{name}_rod"]
    joints = [machine.model.frames[machine.frame(part)].parentJoint for part in parts]
    masses = [machine.model.inertias[joint].mass for joint in joints]
    centres = [data.oMi[joint].act(machine.model.inertias[joint].lever) for joint in joints]
    return data.oMf[machine.frame(parts[0])].rotation, np.average(centres, 0, weights=masses)


@pytest.fixture(scope="module")
def postures(mini):
    """Random closed postures: the paper's coordinates by closed form, the model's by closing."""
    random = np.random.default_rng(13)
    q1, x1, x2 = random.uniform([-np.pi, 0.0, 0.0], [np.pi, 0.030, 0.030], (200, 3)).T
    joints, _ = oracles.mini_forwarder(x1, x2)
    table = {"q1": q1, "X1": x1, "X2": x2, "q5": q5(x1), **joints}
    found = []
    for i in range(len(q1)):
        data = mini.model.createData()
        q = mini.closure.solve([q1[i], x1[i], x2[i]])
        pin.framesForwardKinematics(mini.model, data, q)
        found.append(({name: values[i] for name, values in table.items()}, data))
    return found


@pytest.mark.parametrize("name", BODIES)
def test_bodies_are_where_the_tables_put_them(mini, postures, name):
    chain, last, centre = BODIES[name]
    for q, data in postures:
        frame = product(chain, last, q)
        rotation, position = body(mini, data, name)
        np.testing.assert_allclose(position, (frame @ [*centre(q), 1])[:3], rtol=0, atol=1e-12)
        np.testing.assert_allclose(rotation, frame[:3, :3], rtol=0, atol=1e-12)


def test_every_body_of_the_model_is_in_the_equations(mini):
    moved = {mini.model.frames[mini.frame(name)].parentJoint for name in BODIES if name[0] == "l"}
    moved |= {
        mini.model.frames[mini.frame(f"{name}_{part}")].parentJoint
        for name in ("A1", "A2")
        for part in ("barrel", "rod")
    }
    assert moved == set(range(1, mini.model.njoints))


def test_the_tables_chains_meet(postures):
    """At D, F, J and K chain B meets C, D and A, and A2's rod eye meets the boom."""
    for q, _ in postures:
        triangle, boom = product("C", 2, q), product("A", 3, q)
        upper, outer = product("D", 3, q), product("A", 5, q)
        angle = np.deg2rad(100)
        for one, two in (
            (product("B", 7, q)[:, 3], triangle @ [0.042, 0.030, 0, 1]),
            (product("B", 9, q)[:, 3], triangle @ [A2, 0, 0, 1]),
            (product("B", 10, q)[:, 3], upper @ [A5, 0, 0, 1]),
            (
                product("B", 11, q) @ [A6, 0, 0, 1],
                outer @ [0.0305 * np.cos(angle), 0.0305 * np.sin(angle), 0, 1],
            ),
            (product("C", 4, q) @ [AP + q["X2"], 0, 0, 1], boom @ [0.095, 0, 0, 1]),
        ):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-12)


def test_the_tip_is_at_the_end_of_chain_a(mini, postures):
    for q, data in postures:
        tip = product("A", 5, q) @ [A7, 0, 0, 1]
        np.testing.assert_allclose(
            data.oMf[mini.frame("link7_tip")].translation, tip[:3], rtol=0, atol=1e-12
        )
