"""Short forms of circuits in machine files: defaults for all items, bores and rods."""

import re
import textwrap
from pathlib import Path

import numpy as np
import pytest

import crane
from crane.common.errors import CraneError

MANUAL = Path(__file__).parents[1] / "docs" / "machine_file.md"


@pytest.fixture
def crane_of(tmp_path):
    """The PATU 655 with another circuit."""
    (tmp_path / "bare.yaml").write_text(
        "extends: patu655\nname: bare\nhydraulics: null\ntasks: null\n"
    )

    def load(text):
        path = tmp_path / "own.yaml"
        path.write_text(f"extends: bare.yaml\nname: own\n{textwrap.dedent(text)}")
        return crane.load(path)

    return load


def test_the_crane_of_the_manual_is_ten_lines_and_moves(crane_of):
    text = MANUAL.read_text().split("described in ten lines:\n\n")[1].split("\n\n")[0]
    assert len(text.splitlines()) == 10
    machine = crane_of(text)
    circuit = machine.hydraulics
    assert circuit.joints == machine.active == ("slew", "X_lift", "X_tilt", "X_ext")
    bores = {"X_lift": (0.11, 0.06), "X_tilt": (0.10, 0.056), "X_ext": (0.063, 0.036)}
    for joint, (bore, rod) in bores.items():
        cylinder = circuit.cylinders[joint]
        assert cylinder.area_a == pytest.approx(np.pi / 4 * bore**2, rel=1e-15)
        assert cylinder.area_b == pytest.approx(np.pi / 4 * (bore**2 - rod**2), rel=1e-15)
        assert (cylinder.hose_a, cylinder.relief) == (2e-4, 2.3e7)
    assert circuit.cylinders["slew"].area_a == 60 * 5e-5
    assert all(valve.sharing and valve.bandwidth == 30 for valve in circuit.valves.values())
    levers = {"X_lift": [(0, 0), (1, 0.4), (3, 0.4), (3.2, 0)]}
    run = crane.simulate(machine, crane.joystick(machine, levers), duration=4.0, step=1e-2)
    flow = 0.0  # c y sqrt(p_S - p_LS) with the margin less what the pump droops by
    for _ in range(20):
        flow = 5e-7 * 0.4 * np.sqrt(2e6 - 2e5 * flow / 2.5e-3)
    speed = flow / circuit.cylinders["X_lift"].area_a
    assert run.v[250, 1] == pytest.approx(speed, rel=2e-3)


def test_what_an_item_says_itself_stands(crane_of):
    machine = crane_of("""
        hydraulics:
          supply: {pressure: 2.0e+7}
          cylinders:
            all: {hose_a: 2.0e-4, hose_b: 3.0e-4}
            X_lift: {bore: 0.1, rod: 0.05, count: 2, hose_b: 1.0e-4}
            X_tilt: {area_a: 0.01, area_b: 0.005}
          valves:
            all: {type: orifice, c1: 1.0e-7, c2: 1.0e-7, c3: 1.0e-7, c4: 1.0e-7}
            X_tilt: {c3: 2.0e-7, dead_band: 0.2}
          control:
            all: {kp: 10, kd: 0.1}
        """)
    lift, tilt = machine.hydraulics.cylinders.values()
    assert (lift.hose_a, lift.hose_b, tilt.hose_b) == (2e-4, 1e-4, 3e-4)
    assert lift.area_a == pytest.approx(2 * np.pi / 4 * 0.1**2) and tilt.area_a == 0.01
    one, other = machine.hydraulics.valves.values()
    assert (one.c3, other.c3, one.dead_band, other.dead_band) == (1e-7, 2e-7, 0.0, 0.2)
    assert machine.hydraulics.control["X_lift"].kp == 10


@pytest.mark.parametrize(
    ("lift", "line"),
    [
        ("bore: 0.05, rod: 0.1", r":7: 'bore' .* more than the rod"),
        ("bore: 0.1, area_a: 0.1", r":7: 'area_a' stands beside 'bore'"),
        ("rod: 0.1, area_a: 0.1", r":7: 'rod' .* goes with 'bore'"),
        ("bore: 0.1, count: 1.5", r":7: 'count' .* a whole number"),
        ("bore: 0.1, tube: 0.1", r":7: tube of .* is 0.1 m, it must be more than the bore"),
        ("bor: 0.1", r":7: unknown key 'bor' .*did you mean"),
    ],
)  # fmt: skip
def test_wrong_bores_are_told(crane_of, lift, line):
    text = f"""
        hydraulics:
          supply: {{pressure: 2.0e+7}}
          cylinders:
            X_lift: {{{lift}, hose_a: 1.0e-4, hose_b: 1.0e-4}}
          valves:
            all: {{type: orifice, c1: 1.0e-7, c2: 1.0e-7, c3: 1.0e-7, c4: 1.0e-7}}
        """
    with pytest.raises(CraneError) as caught:
        crane_of(text)
    assert re.search(line, str(caught.value)), caught.value
