"""Active joints that no actuator drives."""

import warnings

import pytest
from command_line import typed

import crane
from crane.common.errors import CraneWarning

ARM = """<robot name="swinging">
  <link name="base"/>
  <link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="10"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="grapple"><inertial><origin xyz="0.4 0 0"/><mass value="20"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="lift" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 -1 0"/>
    <limit lower="-2" upper="2" effort="500" velocity="2"/></joint>
  <joint name="swing" type="revolute"><origin xyz="1 0 0"/><parent link="arm"/><child link="grapple"/>
    <axis xyz="0 -1 0"/><limit lower="-3" upper="3" EFFORT velocity="2"/></joint>
</robot>
"""  # noqa: E501


def arm(folder, effort, section=""):
    (folder / "arm.urdf").write_text(ARM.replace("EFFORT", effort))
    (folder / "arm.yaml").write_text(
        "name: swinging\nchains:\n  - {name: arm, urdf: arm.urdf}\nactive: [lift, swing]\n"
        + section
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        return crane.load(folder / "arm.yaml")


def hold(machine):
    return crane.point_to_point([0.3, -0.3], [0.3, -0.3], 0.02)


@pytest.mark.parametrize("effort", ["", 'effort="0"'])
def test_computed_torque_names_what_nothing_drives_and_its_force(tmp_path, effort):
    """Arm and grapple held level with it: m g l = 20 * 9.81 * 0.4 = 78.48 N m at the swing."""
    machine = arm(tmp_path, effort)
    assert machine.undriven_joints == ("swing",)
    with pytest.warns(CraneWarning) as caught:
        control = crane.ComputedTorque(machine, hold(machine))
    (text,) = [str(one.message) for one in caught]
    assert text.startswith("nothing is said to drive 'swing' (up to 78.5 N m) of 'swinging'")
    assert "an effort above 0 into the <limit>" in text and "\n" not in text
    recording = crane.simulate(machine, control)
    assert recording.tau[:, 1] == pytest.approx(20 * 9.81 * 0.4, rel=1e-6)


@pytest.mark.parametrize(
    ("effort", "section"),
    [
        ('effort="100"', ""),
        ("", "control:\n  lift: {kp: 1e3, ki: 1e2}\n  swing: {kp: 1e3, ki: 1e2}\n"),
        ("", "hydraulics:\n  supply: {pressure: 2e7}\n  cylinders:\n    swing: {area_a: 1e-4, "
         "area_b: 1e-4, hose_a: 1e-5, hose_b: 1e-5}\n  valves:\n    swing: {type: orifice, "
         "c1: 1e-8, c2: 1e-8, c3: 1e-8, c4: 1e-8}\n"),
    ],
)  # fmt: skip
def test_effort_gains_and_cylinders_drive(tmp_path, effort, section):
    machine = arm(tmp_path, effort, section)
    assert machine.undriven_joints == ()
    with warnings.catch_warnings():
        warnings.simplefilter("error", CraneWarning)
        crane.ComputedTorque(machine, hold(machine))


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
@pytest.mark.parametrize("name", ["mini_forwarder", "patu655", "kr300", "tx40", "ur5_robot"])
def test_bundled_machines_and_arms_are_driven(name):
    assert crane.load(name).undriven_joints == ()


def test_motors_of_other_formats_drive(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1" mass="1"/>'
        '<body pos="0.3 0 0"><joint name="b" axis="0 1 0"/><geom size="0.1" mass="1"/></body>'
        '</body></worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        assert crane.load(tmp_path / "arm.xml").undriven_joints == ()


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_locked_joint_needs_no_drive(tmp_path):
    arm(tmp_path, "")
    assert crane.load(tmp_path / "arm.yaml", lock={"swing": 0.1}).undriven_joints == ()


def test_the_command_line_tells_it_in_one_line(tmp_path):
    task = "tasks:\n  hold: {duration: 0.01, active: {lift: [0.3], swing: [-0.3]}}\n"
    arm(tmp_path, 'effort="0"', "home: {lift: 0.3, swing: -0.3}\n" + task)
    words = ["simulate", tmp_path / "arm.yaml", "--task", "hold", "--out", tmp_path / "run"]
    done = typed(*words)
    assert done.returncode == 0
    lines = [line for line in done.stderr.splitlines() if "swing" in line]
    assert len(lines) == 1
    assert lines[0].startswith("warning: nothing is said to drive 'swing' (up to 78.5 N m)")
