"""Selection of the active joints and mobility of overconstrained machines."""

import itertools
import re

import numpy as np
import oracles
import pinocchio as pin
import pytest

import crane
from crane.closure.active_joint_selection import (
    null_space_basis,
    select_columns,
)
from crane.common.errors import CraneError, CraneWarning, MechanismError

BODY = (
    '<inertial><origin xyz="0.05 0.01 0.02"/><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0"'
    ' iyy="0.02" iyz="0" izz="0.02"/></inertial>'
)


def origin(place):
    xyz, rpy = place.translation, pin.rpy.matrixToRpy(place.rotation)
    return '<origin xyz="{} {} {}" rpy="{} {} {}"/>'.format(*map(float, (*xyz, *rpy)))


def at(x=0.0, y=0.0, z=0.0, rpy=(0.0, 0.0, 0.0)):
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array([x, y, z]))


def write(folder, joints, loops, home=None, active=(), limits=None):
    """A machine file of joints (name, parent, place, axis), each moving the link of its name.

    loops: (name, type, link 1, place, link 2, place, axis).
    """
    lines = ['<robot name="linkage"><link name="base"/>']
    for name, parent, place, axis in joints:
        lower, upper, effort = (limits or {}).get(name, (-4.0, 4.0, None))
        rest = f'effort="{effort}" velocity="1"' if effort else ""
        lines.append(
            f'<joint name="{name}" type="revolute">{origin(place)}<parent link="{parent}"/>'
            f'<child link="{name}"/><axis xyz="{axis}"/>'
            f'<limit lower="{lower}" upper="{upper}" {rest}/></joint>'
            f'<link name="{name}">{BODY}</link>'
        )
    text = ["name: linkage", "chains: [{name: all, urdf: linkage.urdf}]", "loops:"]
    for name, kind, one, place1, two, place2, axis in loops:
        for end, link, place in (("1", one, place1), ("2", two, place2)):
            lines.append(
                f'<link name="{name}{end}"/><joint name="{name}{end}_fixed" type="fixed">'
                f'{origin(place)}<parent link="{link}"/><child link="{name}{end}"/></joint>'
            )
        text.append(
            f"  - {{name: {name}, type: {kind}, predecessor: {name}1, successor: {name}2, "
            f"axis: {axis}}}"
        )
    if active:
        text.append(f"active: [{', '.join(active)}]")
    if home:
        text.append(f"home: {{{', '.join(f'{k}: {float(v)!r}' for k, v in home.items())}}}")
    (folder / "linkage.urdf").write_text("\n".join([*lines, "</robot>"]))
    path = folder / "linkage.yaml"
    path.write_text("\n".join([*text, ""]))
    return path


# --- overconstrained linkages that move ------------------------------------------------------

TWIST, OTHER = 0.7, 1.9  # of opposite links [rad]
LENGTH = 0.3
OTHER_LENGTH = LENGTH * np.sin(OTHER) / np.sin(TWIST)  # Bennett's condition


def bennett(folder, active=("one",), other=OTHER_LENGTH):
    """Bennett's linkage: four hinges in space; its last one is the loop."""
    a, b = at(x=LENGTH, rpy=(TWIST, 0, 0)), at(x=other, rpy=(OTHER, 0, 0))
    first = 1.3
    second = 2 * np.arctan(bennett_ratio() / np.tan(first / 2))
    joints = [
        ("one", "base", at(), "0 0 1"), ("two", "one", a, "0 0 1"), ("three", "two", b, "0 0 1"),
    ]  # fmt: skip
    loops = [("four", "revolute", "three", a, "base", b.inverse(), [0, 0, 1])]
    home = {"one": first, "two": second, "three": -first}
    return write(folder, joints, loops, home, active)


def bennett_ratio():
    """tan(one / 2) tan(two / 2) (Bennett 1903)."""
    return np.sin((OTHER + TWIST) / 2) / np.sin((OTHER - TWIST) / 2)


def test_bennetts_linkage_moves_as_its_closed_form_says(tmp_path):
    machine = crane.load(bennett(tmp_path))
    structure = machine.closure.structure
    assert machine.closure.degrees_of_freedom == 1
    assert (len(structure.independent_rows), len(structure.redundant_rows)) == (2, 3)
    one = np.linspace(0.4, 2.9, 60)
    q = machine.closure.solve(one[:, None])
    assert machine.closure.residual(q).max() < 1e-13
    two, three = q[:, machine.column("two")], q[:, machine.column("three")]
    assert np.abs(np.tan(one / 2) * np.tan(two / 2) - bennett_ratio()).max() < 1e-12
    assert np.abs(np.angle(np.exp(1j * (one + three)))).max() < 1e-12  # opposite hinges
    data = machine.model.createData()
    for posture in q:  # and the fourth by the frames that it joins
        pin.framesForwardKinematics(machine.model, data, posture)
        end, start = (data.oMf[machine.frame(f"four{i}")].rotation for i in (1, 2))
        x, y = (end.T @ start)[:2, 0]
        four = np.arctan2(y, x)
        assert abs(np.angle(np.exp(1j * (four + posture[machine.column("two")])))) < 1e-12


def test_bennetts_condition_is_needed(tmp_path):
    """Another length still closes, as a rigid frame."""
    with pytest.raises(MechanismError, match="the loops leave one no freedom to move"):
        crane.load(bennett(tmp_path, other=1.1 * OTHER_LENGTH))


def test_bennetts_linkage_of_the_other_hand_is_told_to_be_far_from_what_the_file_says(tmp_path):
    """With opposite hinges reversed a length is negative, and they turn the same way."""
    path = bennett(tmp_path, other=-OTHER_LENGTH)
    message = "three is 2.6 rad off, loop 'four' in its other assembly mode"
    with pytest.raises(crane.CraneError, match=message):
        crane.load(path)
    with pytest.warns(CraneWarning, match=r"three closes far off; .* has three 2.6 rad off"):
        machine = crane.load(path, arguments={"nearest_assembly": True})
    one = np.linspace(0.4, 2.9, 60)
    q = machine.closure.solve(one[:, None])
    assert machine.closure.residual(q).max() < 1e-13
    apart = q[:, machine.column("three")] - one
    assert np.abs(np.angle(np.exp(1j * apart))).max() < 1e-12


def sarrus(folder, active=("a1",), skew=0.0):
    """Sarrus' linkage: two legs of three parallel hinges each, across each other."""
    y, x = "0 1 0", "1 0 0"
    joints = [
        ("a1", "base", at(x=0.2), y), ("a2", "a1", at(x=0.3), y), ("a3", "a2", at(x=-0.3), y),
        ("b1", "base", at(y=0.2, rpy=(0, 0, skew)), x), ("b2", "b1", at(y=0.4), x),
    ]  # fmt: skip
    # with all angles zero the legs lie folded flat
    loops = [
        ("hinge", "revolute", "a3", at(y=0.2, x=-0.2, rpy=(0, 0, skew)), "b2",
         at(y=-0.4), [1, 0, 0])
    ]  # fmt: skip
    lift = 0.8
    other = np.arcsin(0.3 * np.sin(lift) / 0.4)
    home = {"a1": -lift, "a2": 2 * lift, "a3": -lift, "b1": other, "b2": -2 * other}
    return write(folder, joints, loops, home, active)


def test_sarrus_moves_along_a_straight_line(tmp_path):
    machine = crane.load(sarrus(tmp_path))
    structure = machine.closure.structure
    assert machine.closure.degrees_of_freedom == 1 and len(structure.redundant_rows) == 1
    lift = np.linspace(0.1, 1.5, 40)
    q = machine.closure.solve(-lift[:, None])
    assert machine.closure.residual(q).max() < 1e-13
    data = machine.model.createData()
    for posture, turn in zip(q, lift, strict=True):
        pin.framesForwardKinematics(machine.model, data, posture)
        platform = data.oMf[machine.frame("a3")]
        assert platform.translation == pytest.approx([0.2, 0, 0.6 * np.sin(turn)], abs=1e-13)
        assert np.abs(platform.rotation - np.eye(3)).max() < 1e-13
    # 0.3 sin(a) = 0.4 sin(b)
    other = np.arcsin(0.75 * np.sin(lift))
    assert np.abs(q[:, machine.column("b1")] - other).max() < 1e-12


def cranks(folder, lengths, active=("one",), turned=True, home=None):
    """A table on three parallel cranks side by side, level at home, cranks upright."""
    up = (0, 0, np.pi / 2) if turned else (0, 0, 0)
    joints = [("one", "base", at(rpy=up), "0 0 1")]
    joints.append(("table", "one", at(x=lengths[0], rpy=(0, 0, -up[2])), "0 0 1"))
    loops = []
    for k, (name, length) in enumerate(zip(("two", "three"), lengths[1:], strict=True), 1):
        foot = at(x=0.3 * k, y=lengths[0] - length, rpy=up)
        joints.append((name, "base", foot, "0 0 1"))
        loops.append(
            (f"pin_{name}", "revolute", "table", at(x=0.3 * k), name, at(x=length), [0, 0, 1])
        )
    return write(folder, joints, loops, home, active)


def test_a_redundant_crank_is_counted_not_refused(tmp_path):
    machine = crane.load(cranks(tmp_path, (0.2, 0.2, 0.2)))
    assert machine.closure.degrees_of_freedom == 1
    assert len(machine.closure.structure.redundant_rows) == 7  # of 10 equations
    q = machine.closure.solve(np.linspace(-1.2, 1.2, 30)[:, None])
    one, table, two, three = (q[:, machine.column(x)] for x in ("one", "table", "two", "three"))
    for other in (-table, two, three):
        assert np.abs(other - one).max() < 1e-13


# --- overconstrained machines that lock up ---------------------------------------------------

LOCKED = r"closes at home only: .* leaves it (\S+) (m|rad) open.*overconstrained and locks up"


@pytest.mark.parametrize("active", [("one",), ("one", "two"), ()])
def test_cranks_of_different_lengths_lock_up(tmp_path, active):
    """To first order the table moves along; cos(t) of three circles then pulls it three ways."""
    with pytest.raises(MechanismError, match=LOCKED) as caught:
        crane.load(cranks(tmp_path, (0.2, 0.2, 0.3), active))
    assert str(caught.value).startswith("linkage.yaml:")
    gap = float(re.search(LOCKED, str(caught.value))[1])
    # by 0.02 of 0.2 m up to some factor: x^2 (1 / 0.2 - 1 / 0.3) / 2 at x = 0.004 or less
    assert 1e-8 < gap < 3e-5


def test_two_rods_in_line_lock_up(tmp_path):
    joints = [("left", "base", at(), "0 0 1"), ("right", "left", at(x=0.3), "0 0 1")]
    loops = [("far", "revolute", "right", at(x=0.2), "base", at(x=0.5), [0, 0, 1])]
    with pytest.raises(MechanismError, match=LOCKED):
        crane.load(write(tmp_path, joints, loops, None, ("left",)))
    # and on a turntable, whose own freedom is none of theirs
    joints = [("slew", "base", at(), "0 1 0"), ("left", "slew", at(), "0 0 1"), joints[1]]
    loops = [("far", "revolute", "right", at(x=0.2), "slew", at(x=0.5), [0, 0, 1])]
    with pytest.raises(MechanismError, match=LOCKED):
        crane.load(write(tmp_path, joints, loops, None, ("slew", "left")))


def test_a_linkage_in_line_that_moves_on_is_no_lock(tmp_path):
    """A parallelogram lying flat may leave its posture in two ways: home is singular, no more."""
    with pytest.raises(MechanismError, match=r"home configuration \(one = 0\) is singular"):
        crane.load(cranks(tmp_path, (0.2, 0.2, 0.2), turned=False, home={"one": 0.0}))


# --- choices ---------------------------------------------------------------------------------


def test_a_machine_without_active_joints_is_told_some(tmp_path):
    for path, count in ((bennett(tmp_path, ()), 1), (sarrus(tmp_path, ()), 1)):
        with pytest.warns(crane.CraneWarning, match="no active joints named") as caught:
            chosen = crane.load(path)
        (text,) = [str(one.message) for one in caught if "named" in str(one.message)]
        start = f"linkage.yaml: {count} degree of freedom and no active joints named, taken as d"
        assert text.startswith(start)
        assert f"driven: [{', '.join(chosen.active)}] (condition" in text
        for listed, said in re.findall(r"\[(.*?)\] \(condition (.*?)\)", text):
            again = path.read_text() + f"active: [{listed}]\n"
            path.with_name("driven.yaml").write_text(again)
            machine = crane.load(path.with_name("driven.yaml"))
            found = float(machine.closure.condition_number(machine.home))
            assert found == pytest.approx(float(said), rel=6e-3)


def test_actuators_are_proposed_first(mini):
    """The cranes' own drives, though pins on the booms would be the better conditioned ones."""
    for machine in (mini, crane.load("patu655")):
        first, second = machine.closure.proposed_active_joints
        assert set(first.joints) == set(machine.active)
        assert second.condition_number < first.condition_number
        assert first.condition_number == pytest.approx(
            float(machine.closure.condition_number(machine.home))
        )


def test_a_dead_centre_names_who_drives_through_it(tmp_path):
    """Crank and rod in line: the slider cannot push, the crank can."""
    joints = [("crank", "base", at(), "0 0 1"), ("rod", "crank", at(x=0.2), "0 0 1"),
              ("rocker", "base", at(x=0.5, y=0.3, rpy=(0, 0, -np.pi / 2)), "0 0 1")]  # fmt: skip
    loops = [("pin", "revolute", "rod", at(x=0.3), "rocker", at(x=0.3), [0, 0, 1])]
    path = write(tmp_path, joints, loops, {"rocker": 0.0}, ("rocker",))
    with pytest.raises(MechanismError) as caught:
        crane.load(path)
    said = re.search(r"or drive it by (.*)$", str(caught.value))[1]
    assert "at the edge of the branch" in str(caught.value) and "[crank]" in said
    path.write_text(path.read_text().replace("[rocker]", "[crank]"))
    assert crane.load(path).closure.degrees_of_freedom == 1


def test_a_file_that_says_nothing_of_a_singular_posture_gets_another(tmp_path):
    """The two above, whose active joint is at zero only because nothing is said of it."""
    flat = cranks(tmp_path, (0.2, 0.2, 0.2), turned=False)
    text = "configuration is singular; moving one, too, the nearest"
    with pytest.warns(CraneWarning, match=text):
        machine = crane.load(flat)
    assert float(machine.closure.condition_number(machine.home)) < 20


def everywhere(machine):
    names = range(machine.model.nv)
    return itertools.combinations(names, machine.closure.degrees_of_freedom)


def test_condition_is_that_of_the_orthonormal_equations(mini, stewart, five_bar):
    """||D^-1 gamma D_A|| against 1 / sigma_min(N_A) and 1 / sigma_min(J_P), rows orthonormal."""
    for machine in (mini, stewart, five_bar):
        closure, scale = machine.closure, machine.closure.equations.motion_scales
        jacobian = closure.equations.evaluate(machine.home)[1]
        basis = null_space_basis(jacobian, scale, 1e-8)
        found = float(closure.condition_number(machine.home))
        assert found >= 1
        for rows in (basis[closure.active], null_rows(jacobian * scale)[:, closure.passive]):
            least = np.linalg.svd(rows, compute_uv=False)[-1]
            assert found == pytest.approx(1 / least, rel=1e-9)
        stack = closure.solve(machine.home[closure.active] + np.zeros((3, 1)))
        assert closure.condition_number(stack) == pytest.approx(3 * [found], rel=1e-9)


def null_rows(matrix):
    _, values, right = np.linalg.svd(matrix)
    return right[: (values > 1e-8 * values[0]).sum()]


def test_choices_are_near_the_best(mini, five_bar, tmp_path):
    """All choices tried: volume never below the best's by more than what swaps allow."""
    machines = [mini, five_bar]
    for seed in range(12):
        try:
            machines.append(crane.load(oracles.random_mechanism(tmp_path, seed, "spherical")))
        except CraneError:
            continue
    assert len(machines) > 6
    for machine in machines:
        closure, scale = machine.closure, machine.closure.equations.motion_scales
        jacobian = closure.equations.evaluate(machine.home)[1]
        basis = null_space_basis(jacobian, scale, 1e-8)
        chosen = select_columns(basis, range(machine.model.nv))
        n, others = len(chosen), machine.model.nv - len(chosen)
        values = {
            choice: np.linalg.svd(basis[list(choice)], compute_uv=False)[-1]
            for choice in everywhere(machine)
        }
        found, best = 1 / values[tuple(chosen.tolist())], 1 / max(values.values())
        assert best <= found <= min(np.sqrt(1 + n * others), 3 * best) + 1e-9
        scaled = basis @ np.linalg.inv(basis[chosen])  # no joint moves by more than its scale
        assert np.abs(scaled).max() <= 1 + 1e-6


@pytest.mark.parametrize("size", [(6, 2), (9, 3), (14, 5), (21, 6)])
def test_no_joint_moves_by_more_than_those_that_were_chosen(size):
    """Spaces drawn at random, where pivoting alone does not get there; kept joints stay."""
    random = np.random.default_rng(7)
    joints, freedom = size
    for _ in range(60):
        basis = np.linalg.qr(random.normal(size=(joints, freedom)) ** 3)[0]
        chosen = select_columns(basis, range(joints))
        scaled = basis @ np.linalg.inv(basis[chosen])
        assert np.abs(scaled).max() <= 1 + 1e-8
        least = np.linalg.svd(basis[chosen], compute_uv=False)[-1]
        assert 1 / least <= np.sqrt(1 + freedom * (joints - freedom))
        kept = random.permutation(joints)[:1].tolist()
        others = select_columns(basis, range(joints), kept)
        assert kept[0] in others and len(set(others.tolist())) == freedom
