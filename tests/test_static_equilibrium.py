"""Static equilibrium on contacts at the start of a run."""

import numpy as np
import pytest

import crane

BODY = '<mass value="{}"/><inertia ixx="9" iyy="9" izz="9" ixy="0" ixz="0" iyz="0"/>'
URDF = f"""<robot name="sledge">
  <link name="frame"><inertial><origin xyz="0 0 0.5"/>{BODY.format(400)}</inertial></link>
  <joint name="fore" type="fixed"><origin xyz="1 0 0"/><parent link="frame"/>
    <child link="foot_fore"/></joint>
  <joint name="aft" type="fixed"><origin xyz="-1 0 0"/><parent link="frame"/>
    <child link="foot_aft"/></joint>
  <link name="foot_fore"/><link name="foot_aft"/>
  <joint name="push" type="prismatic"><origin xyz="0 0 0.5"/><parent link="frame"/>
    <child link="ram"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1e4" velocity="1"/></joint>
  <link name="ram"><inertial>{BODY.format(100)}</inertial></link>
</robot>"""
YAML = """
name: sledge
chains: [{name: body, urdf: sledge.urdf}]
floating: [x, z, ry]
active: [push]
free: [base_x, base_z, base_ry]
home: {push: 0.5, base_z: 0.0}
ground: {height: 0, stiffness: 2.0e+5, friction: 0.5}
contacts: [{frame: foot_fore}, {frame: foot_aft, stiffness: 1.0e+5}]
tip: ram
"""
G = 9.81


@pytest.fixture
def load(tmp_path):
    (tmp_path / "sledge.urdf").write_text(URDF)

    def made(old="name: sledge", new="name: sledge"):
        assert old in YAML
        (tmp_path / "sledge.yaml").write_text(YAML.replace(old, new))
        free = ["base_x", "base_z", "base_ry"]
        return crane.load(tmp_path / "sledge.yaml", lock={"push": 0.5}, active=[], free=free)

    return made


def held(machine):
    return crane.simulate(machine, duration=1.0, step=0.01)


def test_it_stands_where_hand_statics_has_it_and_stays(load):
    run = held(load())
    aft, fore = (run[f"support_foot_{side}"] for side in ("aft", "fore"))
    # moments about the aft foot; what is 0.5 m above it leans forward
    lean = 0.5 * run["base_ry"][0]
    assert fore == pytest.approx(G * (400 * (1.0 + lean) + 100 * (1.5 + lean)) / 2, rel=1e-4)
    assert fore + aft == pytest.approx(G * 500, rel=1e-9)
    sunk = np.array([aft[0] / 1e5, fore[0] / 2e5])  # of the feet: each into its own ground
    assert run["base_z"][0] == pytest.approx(-sunk.mean(), rel=1e-4)
    assert run["base_ry"][0] == pytest.approx((sunk[1] - sunk[0]) / 2, rel=1e-4)
    assert np.abs(run.v).max() < 1e-8  # dropped from home, it is 0.3 m/s fast
    assert run.start == "in static equilibrium on its contacts, base_z -0.01779 m from home"
    assert f"starts {run.start}" in crane.recordings.recording_summary.summarize(run).to_markdown()


def test_a_run_that_is_told_its_start_starts_there(load):
    machine = load()
    run = crane.simulate(machine, initial=machine.home[machine.closure.active], duration=0.2)
    assert run["base_z"][0] == 0 and not run.start and np.abs(run.v).max() > 0.1


def test_it_comes_down_to_the_ground(load):
    """It is 2 cm above it in the file."""
    machine, above = load(), load("height: 0", "height: -0.02")
    on, run = held(machine), held(above)
    assert run["base_z"][0] == pytest.approx(on["base_z"][0] - 0.02, rel=1e-6)
    assert np.abs(run.v).max() < 1e-8


def test_what_is_far_above_falls_as_it_says(load):
    run = held(load("height: 0", "height: -1.5"))
    assert run["base_z"][0] == 0
    assert run.start == "at home, near which it has no static equilibrium on its contacts"


def test_on_a_slope_only_friction_in_motion_holds_it(load):
    run = held(load("height: 0", "height: -0.02, normal: [-0.02, 0, 1]"))
    assert run.start.endswith("where only friction in motion holds it along the ground")
    aft, fore = (run[f"support_foot_{side}"][0] for side in ("aft", "fore"))
    assert fore + aft == pytest.approx(G * 500 / np.hypot(1, 0.02), rel=1e-3)
    assert np.abs(run.v).max() < 0.05  # it creeps; dropped from home it is 0.3 m/s fast


def test_a_start_survives_a_file(load, tmp_path):
    run = held(load())
    run.to_csv(tmp_path / "run.csv")
    assert crane.Recording.from_csv(tmp_path / "run.csv").start == run.start


def test_what_has_no_contact_starts_at_home(load):
    machine = load("contacts: [{frame: foot_fore}, {frame: foot_aft, stiffness: 1.0e+5}]", "")
    run = crane.simulate(machine, duration=0.1)
    assert not run.start and run["base_z"][0] == 0
