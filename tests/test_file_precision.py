"""Machines with few digits, whose redundant equations contradict the others by as much."""

import re

import mechanisms
import numpy as np
import pytest
from warned import told

import crane
from crane.common.errors import MechanismError

NUMBER = re.compile(r"-?\d+\.\d{7,}(?:e-?\d+)?")
PLANAR = ["four_bar", "six_bar", "crane", "bucket", "platform", "scissor", "chain"]


def written(folder, text):
    path = folder / "mechanism.urdf"
    path.write_text(text)
    return path


def loaded(path):
    machine, messages = told(crane.load, path)
    return machine, [message for message in messages if "only to file precision" in message]


def rounded(text, digits):
    return NUMBER.sub(lambda number: f"{float(number[0]):.{digits}f}", text)


def aside(text, far):
    """The first loop's second frame moved out of the plane, as far as is said [m]."""
    mechanism = re.compile(r'(<successor link="\w+"><origin xyz=")([^"]+)" rpy="([^"]+)"')

    def moved(found):
        place, turn = (np.array(found[i].split(), dtype=float) for i in (2, 3))
        roll, pitch, yaw = turn
        c, s = np.cos, np.sin
        # second column of the rotation: the world's y, seen from the body
        y = np.array([
            c(yaw) * s(pitch) * s(roll) - s(yaw) * c(roll),
            s(yaw) * s(pitch) * s(roll) + c(yaw) * c(roll),
            c(pitch) * s(roll),
        ])  # fmt: skip
        x = " ".join(repr(float(v)) for v in place + far * y)
        return f'{found[1]}{x}" rpy="{found[3]}"'

    return mechanism.sub(moved, text, count=1)


def assert_closed(machine, least, most):
    """Independent equations to rounding, all others within what is allowed, here and elsewhere."""
    closure, structure = machine.closure, machine.closure.structure
    surplus, units = structure.redundancy, closure.equations.residual_units
    assert least <= surplus.largest_gap * units[surplus.largest_row] <= most
    for reach in (0.0, 0.02, -0.03):
        q = closure.solve(machine.home[closure.active] + reach)
        phi = closure.equations.evaluate_scaled(q)[0]
        assert np.abs(phi[structure.independent_rows]).max() < 2e-13
        assert np.abs(phi).max() <= structure.redundancy.tolerance


@pytest.mark.parametrize("kind", PLANAR)
def test_seven_digits(kind, tmp_path):
    machine, told = loaded(written(tmp_path, rounded(mechanisms.drawn(kind, 0).urdf(), 7)))
    exact, silent = loaded(written(tmp_path, mechanisms.drawn(kind, 0).urdf()))
    assert_closed(machine, 1e-9, 1e-4)
    assert silent == [] and machine.active == exact.active
    (line,) = told
    assert re.search(r"loop 'loop\d' closes only to file precision: its redundant "
                     r"equations stay open by up "
                     r"to [\d.e-]+ (m|rad)", line)  # fmt: skip
    # the machine that was meant, to the digits
    np.testing.assert_allclose(machine.home, exact.home, rtol=0, atol=2e-5)


@pytest.mark.parametrize("kind", PLANAR)
def test_pins_a_tenth_of_a_micrometre_out_of_plane(kind, tmp_path):
    machine, told = loaded(written(tmp_path, aside(mechanisms.drawn(kind, 0).urdf(), 1e-7)))
    assert_closed(machine, 0.5e-7, 3e-7)
    assert len(told) == 1


@pytest.mark.parametrize("kind", PLANAR)
def test_pins_a_hundredth_out_of_plane_are_refused(kind, tmp_path):
    path = written(tmp_path, aside(mechanisms.drawn(kind, 0).urdf(), 0.03))
    with pytest.raises(MechanismError):
        loaded(path)


def four_bar(turn, back):
    """Crank, coupler and rocker about y, in frames that are turned about x and back."""
    body = (
        '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )
    joints = [
        ("crank", "ground", "0 0 0", turn, ' independent="true"'),
        ("coupler", "crank", "0.3 0 0", back, ""),
        ("rocker", "ground", "0.8 0 0.1", turn, ""),
    ]
    lines = ['<robot name="four_bar"><link name="ground"/>']
    for name, parent, xyz, rpy, driven in joints:
        axis = "0 0 1" if rpy == turn else "0 1 0"
        lines.append(
            f'<joint name="{name}" type="continuous"{driven}><origin xyz="{xyz}" rpy="{rpy} 0 0"/>'
            f'<parent link="{parent}"/><child link="{name}"/><axis xyz="{axis}"/></joint>'
            f'<link name="{name}">{body}</link>'
        )
    lines.append(
        '<loop name="pin" type="revolute"><predecessor link="coupler"><origin xyz="0.7 0 0"/>'
        f'</predecessor><successor link="rocker"><origin xyz="0.4 0 0" rpy="{back} 0 0"/>'
        '</successor><axis xyz="0 1 0"/></loop>'
        '<group_state name="home"><joint name="crank" value="1.2"/></group_state></robot>'
    )
    return "\n".join(lines)


def test_right_angles_with_five_digits(tmp_path):
    """rpy="1.5708" is 3.7e-6 rad off."""
    meant, silent = loaded(written(tmp_path, four_bar(repr(-np.pi / 2), repr(np.pi / 2))))
    machine, told = loaded(written(tmp_path, four_bar("-1.5708", "1.57079")))
    assert silent == [] and len(told) == 1
    assert_closed(machine, 1e-7, 1e-4)
    np.testing.assert_allclose(machine.home, meant.home, rtol=0, atol=1e-4)


def test_an_axis_that_is_a_degree_off_is_refused(tmp_path):
    with pytest.raises(MechanismError):
        loaded(written(tmp_path, four_bar("-1.5708", "1.5883")))
