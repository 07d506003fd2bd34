"""Random planar linkages load, close, and move as constraint dynamics says.

Trees of revolute and prismatic joints in a vertical plane, closed by one to three pins at random
places. Which joints to drive is left to the package. What is thrown away is counted by reason.
"""

import re
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import crane
from crane.common.errors import MechanismError

DRAWN = Counter()  # reasons of draws that were thrown away, and "kept"
POSTURES = Counter()  # likewise, of postures of those that were kept
PROPOSED = re.compile(r"driven: \[(.*?)\] \(condition (.*?)\)")


def numbers(values):
    return " ".join(repr(float(value)) for value in values)


def linkage(folder, parents, kinds, cuts, seed):
    """Write a linkage that is closed at zero, no joint of it driven; its path.

    Args:
        folder: Where to.
        parents: Body that carries joint i + 1, at most i.
        kinds: Whether joint i + 1 slides.
        cuts: Pairs of bodies that a pin joins.
        seed: Of all lengths, angles and masses.
    """
    random = np.random.default_rng(seed)
    lines = ['<robot name="linkage">', '<link name="body0"/>']
    places = [np.eye(3)]  # of the bodies in the plane (x, z), at zero
    for i, (parent, slides) in enumerate(zip(parents, kinds, strict=True), start=1):
        away, turn = random.uniform(-0.6, 0.6, 2), random.uniform(-3, 3)
        places.append(places[parent] @ placed(away, turn))
        along = random.uniform(-3, 3)
        axis = (np.cos(along), 0, np.sin(along)) if slides else (0, -1, 0)
        mass, spin = random.uniform(0.5, 3), random.uniform(0.01, 0.1)
        com = random.uniform(-0.2, 0.2, 2)
        lines.append(
            f'<joint name="j{i}" type="{"prismatic" if slides else "continuous"}">'
            f'<origin xyz="{numbers((away[0], 0, away[1]))}" rpy="{numbers((0, -turn, 0))}"/>'
            f'<parent link="body{parent}"/><child link="body{i}"/><axis xyz="{numbers(axis)}"/>'
            + ('<limit lower="-0.5" upper="0.5" effort="99" velocity="9"/>' if slides else "")
            + f'</joint><link name="body{i}"><inertial>'
            f'<origin xyz="{numbers((com[0], 0, com[1]))}"/><mass value="{mass!r}"/>'
            f'<inertia ixx="{spin!r}" ixy="0" ixz="0" iyy="{spin!r}" iyz="0" izz="{spin!r}"/>'
            "</inertial></link>"
        )
    for k, cut in enumerate(cuts):
        point = np.append(random.uniform(-0.8, 0.8, 2), 1.0)
        ends = []
        for end, body in zip(("predecessor", "successor"), cut, strict=True):
            x, z, _ = np.linalg.solve(places[body], point)
            ends.append(f'<{end} link="body{body}"><origin xyz="{numbers((x, 0, z))}"/></{end}>')
        lines.append(
            f'<loop name="pin{k}" type="revolute">{"".join(ends)}<axis xyz="0 1 0"/></loop>'
        )
    path = folder / "linkage.urdf"
    path.write_text("\n".join([*lines, "</robot>"]))
    return path


def placed(away, turn):
    """(3, 3) of a frame in the plane, angles from x to z."""
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, -s, away[0]], [s, c, away[1]], [0, 0, 1]])


@st.composite
def plans(draw):
    """Parents, kinds and cuts: as many joints as the pins lock, and one to three more."""
    loops = draw(st.integers(1, 3))
    count = 2 * loops + draw(st.integers(1, 3))
    parents = [draw(st.integers(max(0, i - 3), i)) for i in range(count)]
    kinds = [draw(st.integers(0, 3)) == 0 for _ in range(count)]
    cuts = []
    for _ in range(loops):
        one = draw(st.integers(1, count))
        two = draw(st.integers(0, count - 1))
        cuts.append((one, two if two < one else two + 1))
    return parents, kinds, cuts, draw(st.integers(0, 2**32 - 1))


def driven(path):
    """The machine, driven as proposed; None where the draw makes none, which is counted."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", crane.CraneWarning)
        try:
            machine = crane.load(path)
        except MechanismError as refused:
            for words, reason in (
                ("no freedom to move", "rigid"),
                ("locks nothing", "pin that locks nothing"),
                ("home configuration", "singular at home"),
                ("closes at home only", "locks up"),
            ):
                if words in str(refused):
                    DRAWN[reason] += 1
                    return None
            raise
    (text,) = [str(one.message) for one in caught if "taken as driven" in str(one.message)]
    joints, condition = PROPOSED.search(text).groups()
    if float(condition) > 20:
        DRAWN["condition above 20"] += 1
        return None
    assert set(machine.active) == set(joints.split(", "))
    assert float(machine.closure.condition_number(machine.home)) == pytest.approx(
        float(condition), rel=6e-3
    )
    return machine


@pytest.mark.slow
@settings(max_examples=20)
@given(plans())
def test_random_linkages_move_as_constraint_dynamics_says(plan):
    with tempfile.TemporaryDirectory() as folder:
        machine = driven(linkage(Path(folder), *plan))
    if machine is None:
        return
    closure = machine.closure
    n, model = len(machine.active), machine.model
    structure = closure.structure
    assert closure.residual(machine.home) < 1e-13 and np.abs(machine.home).max() < 1e-12
    assert len(structure.independent_rows) == model.nv - n == len(closure.passive)
    assert len(structure.independent_rows) + len(structure.redundant_rows) == 5 * len(
        closure.equations.loops
    )
    random = np.random.default_rng(plan[-1])
    dynamics = crane.Dynamics(machine, backend="pinocchio")
    tested = 0
    for reach in (0.1, 0.03, 0.01, 0.003, 0.0):
        q_a = reach * random.uniform(-1, 1, n)
        try:
            q = closure.solve(q_a)
        except crane.CraneError:
            POSTURES["out of reach"] += 1
            continue
        if closure.condition_number(q) > 100:
            POSTURES["condition above 100"] += 1
            continue
        gamma = closure.gamma(q)
        v_a, tau_a = random.uniform(-1, 1, n), random.uniform(-20, 20, n)
        v = gamma @ v_a
        tau = np.zeros(model.nv)
        tau[closure.active] = tau_a
        exact = oracles.constraint_dynamics(machine, q, v, tau, mu=1e-8)
        found = gamma @ dynamics.forward(q_a, v_a, tau_a) + closure.drift(q, v)
        assert np.abs(found - exact).max() < 1e-9 * max(1.0, np.abs(exact).max())
        tested += 1
        POSTURES["compared"] += 1
    assert tested >= 1
    DRAWN["kept"] += 1


@pytest.mark.slow
def test_most_draws_are_kept():
    """Most draws are used; `pytest -s` prints the reasons of the others."""
    if not DRAWN:
        pytest.skip("the draws were not made in this process")
    print(dict(DRAWN), dict(POSTURES))
    assert DRAWN["kept"] >= 0.9 * sum(DRAWN.values())
    assert POSTURES["compared"] >= 0.9 * sum(POSTURES.values())
