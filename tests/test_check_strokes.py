"""`crane check` reports tasks beyond the strokes, and strokes at which the loops do not close."""

import math
import re

import misfit_linkages
import pytest

import crane
from crane.common.errors import SimulationError
from crane.control.levers import LeverPhases
from crane.description import bundled_machines
from crane.description.specification import Phase
from crane.formats.checks import check

VIA = (
    "tasks:\n  out:\n    via:\n      - {{time: 0, lift_stroke: 0.4}}\n"
    "      - {{time: 2, lift_stroke: {}}}\n"
)


def boom(folder, limits="", more=""):
    path = misfit_linkages.LINKAGES["boom"].write(folder)
    urdf = folder / "linkage.urdf"
    if limits:
        urdf.write_text(urdf.read_text().replace('lower="-9" upper="9"', limits))
    path.write_text(path.read_text() + more)
    return path


def told(path):
    return [finding.message for finding in check(path).findings]


def test_a_via_point_beyond_the_stroke_is_told(tmp_path):
    path = boom(tmp_path, 'lower="0.1" upper="0.6"', VIA.format(800))
    assert told(path) == [
        "task 'out' has 'lift_stroke' at 800 m at t = 2 s, beyond its limits 0.1 to 0.6 m, choose "
        "a position within them"
    ]
    assert told(boom(tmp_path, 'lower="0.1" upper="0.6"', VIA.format(0.5))) == []


def test_a_tip_beyond_all_links_is_told(tmp_path):
    tip = "tip: boom_eye\ntasks:\n  out:\n    via:\n      - {time: 0, x: 1, y: 0, z: 1.3}\n"
    path = boom(
        tmp_path, 'lower="0.1" upper="0.6"', tip + "      - {time: 1, x: 800, y: 0, z: 0}\n"
    )
    (line,) = told(path)
    assert line.startswith("task 'out' has its tip 800 m from the root at t = 1 s")


def test_the_part_of_the_strokes_that_does_not_close_is_told(tmp_path):
    """A triangle of pins 0.7616 and 1.2 m closes up to their sum, by hand."""
    pin, base, eye = (0.0, 0.8), (0.3, 0.2), (1.0, 1.3)
    longest = math.dist(pin, base) + math.dist(pin, eye) - 0.9
    shortest = abs(math.dist(pin, base) - math.dist(pin, eye)) - 0.9
    lower, upper = 0.1, 1.5
    path = boom(tmp_path, f'lower="{lower}" upper="{upper}"')
    (line,) = told(path)
    share = (upper - longest + max(0.0, shortest - lower)) / (upper - lower)
    found = re.match(r"(\d+) % of the strokes within the limits of lift_stroke lie beyond", line)
    assert abs(float(found[1]) - 100 * share) < 1.5
    last = float(re.search(r"closes is at lift_stroke = ([\d.]+)", line)[1])
    assert last == pytest.approx(longest, abs=1e-4) and "loop 'eye'" in line


@pytest.mark.parametrize("name", bundled_machines())
def test_bundled_machines_close_all_over_their_strokes(name):
    assert not [line for line in told(name) if "strokes" in line or "task" in line]


def test_a_dead_centre_in_the_way_of_a_phase_is_named(tmp_path):
    """The boom's pins are 2.5463 m and 0.9657 m from its cylinder's: it ends at their sum."""
    machine = crane.load("excavator", changes={"X_boom.upper": 3.0})
    up = Phase("up", {"X_boom": 1.0}, {"X_boom": 2.5}, 0.3)
    with pytest.raises(SimulationError) as caught:
        crane.simulate(machine, LeverPhases(machine, [up]), step=1e-2)
    text = str(caught.value)
    assert "'up' has not ended within 0.3 s" in text and "a dead centre is in between" in text
    assert "loop 'boom_eye' cannot be closed at" in text and "give a position before it" in text
