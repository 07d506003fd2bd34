"""Incomplete files: completed by documented assumptions, with a warning."""

from functools import partial

import numpy as np
import pytest
from broken_machines import GROUND, LOOPED, MACHINE, MINI, ROCKER, Edit, copy_machine, swap
from command_line import typed
from test_mechanism import WHEEL
from warned import told

import crane


def completed(text: str, *edits: Edit, machine: str = MACHINE):
    return text, edits, machine


loaded = partial(told, crane.load)


def edited(folder, edits, machine=MACHINE):
    path = copy_machine(machine, folder)
    for edit in edits:
        edit.apply(folder)
    return path


CHAIN_B1 = "urdf/mini_forwarder/chain_b1.urdf"
ROD_INERTIAL = """    <inertial>
      <origin xyz="-0.02544736842105262 0 0"/>
      <mass value="0.00646"/>
      <inertia ixx="0" ixy="0" ixz="0" iyy="1.3944309649122797e-06" iyz="0"
               izz="1.3944309649122797e-06"/>
    </inertial>
"""
STOPS = swap("end_stops:\n  crank: {stiffness: 1e4, damping: 2}\n", "")

INCOMPLETE = [
    completed(
        "1 active joint for 3 degrees of freedom: nothing drives coupler, rocker, free",
        swap(
            '  <loop name="pin" type="continuous">\n'
            '    <predecessor link="coupler_arm"><origin xyz="0.4 0 0"/></predecessor>\n'
            '    <successor link="rocker_arm"><origin xyz="0.3 0 0"/></successor>\n'
            '    <axis xyz="0 0 2"/>\n'
            "  </loop>\n",
            "",
            LOOPED,
        ),
        machine=LOOPED,
    ),
    completed(
        "2 active joints for 1 degree of freedom: coupler shares the load with the others",
        swap(
            'name="coupler" type="continuous"',
            'name="coupler" type="continuous" independent="true"',
            LOOPED,
        ),
        machine=LOOPED,
    ),
    completed(
        "1 degree of freedom and no active joints named, taken as driven: [crank] (co",
        swap(' independent="true"', "", LOOPED),
        machine=LOOPED,
    ),
    completed(
        "ground.urdf:10: joint 'crank' is revolute and has no <limit>, taken as unl",
        swap('<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>', "", GROUND),
        STOPS,
    ),
    completed(
        "ground.urdf:14: the limit of joint 'crank' has no lower and no u",
        swap(
            '<limit lower="-1.5" upper="2.5" effort="10" velocity="5"/>',
            '<limit effort="10" velocity="5"/>',
            GROUND,
        ),
        STOPS,
    ),
    completed(
        "ground.urdf:17: link 'crank_arm', which joint 'crank' moves, has no mass, taken",
        swap(
            "    <inertial>\n"
            '      <origin xyz="0.1 0 0" rpy="0 0 0"/>\n'
            '      <mass value="1.5"/>\n'
            '      <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.006" iyz="0" izz="0.006"/>\n'
            "    </inertial>\n",
            "",
            GROUND,
        ),
    ),
    completed(
        "3 active joints for 5 degrees of freedom: nothing drives ",
        swap(
            "  - {name: K, type: revolute, predecessor: link7_K,",
            "  # - {name: K, type: revolute, predecessor: link7_K,",
            MINI,
        ),
        machine=MINI,
    ),
    completed(
        "four_bar.yaml:12: 1 active joint for 2 degrees of freedom: nothing drives spin, free",
        swap("</robot>", WHEEL, ROCKER),
    ),
]


@pytest.mark.parametrize(("text", "edits", "machine"), INCOMPLETE)
def test_what_is_missing_is_assumed_and_told(text, edits, machine, tmp_path):
    found, told = loaded(edited(tmp_path, edits, machine))
    (line,) = [one for one in told if text in one]
    assert "\n" not in line
    assert found.closure.residual(found.home) < 1e-12
    found = found.replace(friction={})  # which would need a short step
    run = crane.simulate(found, lambda t, q, v: np.zeros(len(q)), duration=0.05)
    energy = run.channels["kinetic"] + run.channels["potential"]
    lost = run.channels["dissipated"]
    scale = max(np.ptp(lost), np.ptp(run.channels["kinetic"]))
    assert energy + lost - energy[0] == pytest.approx(0.0, abs=1e-6 * scale)


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_a_massless_link_is_the_limit_of_a_light_one(tmp_path):
    """Accelerations of the forwarder with a rod of 1 ng and with one of nothing."""
    light = ROD_INERTIAL.replace("0.00646", "1e-12").replace("1.3944309649122797e-06", "2e-15")
    found = []
    for i, inertial in enumerate((light, "")):
        (tmp_path / str(i)).mkdir()
        path = edited(tmp_path / str(i), [swap(ROD_INERTIAL, inertial, CHAIN_B1)], MINI)
        machine = crane.load(path)
        q_a = machine.home[machine.closure.active]
        for backend in ("compiled", "pinocchio"):
            dynamics = crane.Dynamics(machine, backend=backend)
            found.append(dynamics.forward(q_a, [0.3, 0.01, -0.02], [0.1, 20.0, 5.0]))
    assert np.array(found) == pytest.approx(np.tile(found[0], (4, 1)), rel=1e-9)


def test_a_rotor_of_inertia_without_mass_moves_as_its_inertia_says(tmp_path):
    """A massless flywheel with inertia adds its inertia to M, and nothing else."""
    rotor = WHEEL.replace('<mass value="1"/>', '<mass value="0"/>').replace("rocker_pin", "BASE")
    (tmp_path / "wheel.urdf").write_text('<robot name="wheel"><link name="BASE"/>' + "\n" + rotor)
    machine, told = loaded(tmp_path / "wheel.urdf")
    assert told == []
    for backend in ("compiled", "pinocchio"):
        dynamics = crane.Dynamics(machine, backend=backend)
        assert dynamics.forward([0.2], [3.0], [0.5])[0] == pytest.approx(0.5, rel=1e-14)
        assert dynamics.gravity([0.2])[0] == pytest.approx(0.0, abs=1e-15)


SWINGING = """<robot name="swing">
  <link name="base"/>
  <link name="arm">{mass}</link>
  <joint name="lift" type="continuous"><parent link="base"/><child link="arm"/>
    <axis xyz="0 1 0"/></joint>
  <link name="end">{end}</link>
  <joint name="swing" type="continuous"><parent link="arm"/><child link="end"/>
    <origin xyz="1 0 0"/><axis xyz="0 1 0"/></joint>
</robot>
"""
MASS = (
    '<inertial><origin xyz="0.5 0 0"/><mass value="2"/>'
    '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.2"/></inertial>'
)


def swinging(folder, mass=MASS, end=MASS):
    (folder / "swing.urdf").write_text(SWINGING.format(mass=mass, end=end))
    return folder / "swing.urdf"


def test_a_motion_without_mass_is_refused(tmp_path):
    with pytest.raises(crane.CraneError) as caught:
        crane.load(swinging(tmp_path, end=""))
    assert str(caught.value) == (
        "swing.urdf:6: joint 'swing' moves link 'end', which has no mass, give it an <inertial>"
    )


def test_kinematics_needs_no_masses(tmp_path):
    """Closure, tip, check and sketch of a machine of frames; dynamics says what it lacks."""
    machine, told = loaded(swinging(tmp_path, "", ""))
    assert told == [
        "swing.urdf: no link that moves has a mass: kinematics only, dynamics needs an <inertial> "
        "of each"
    ]
    tip = crane.Kinematics(machine, "end")
    assert tip.position([np.pi / 2, 0.3]) == pytest.approx([0, 0, -1], abs=1e-15)
    with pytest.raises(crane.CraneError, match="without masses there is kinematics"):
        crane.Dynamics(machine)
    for words in (["check"], ["info"], ["sketch", "--out", str(tmp_path / "a.png")]):
        done = typed(words[0], machine.path, *words[1:])
        assert done.returncode == (1 if words == ["check"] else 0), done.stderr
    done = typed("simulate", machine.path, "--duration", "1", "--out", tmp_path / "run")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("error: no link of 'swing' that moves has")


@pytest.mark.slow
def test_free_joints_get_no_force_and_computed_torque_moves_the_others(tmp_path):
    """Partial feedback linearisation: the lift follows to rounding, the swing has no force."""
    machine, told = loaded(swinging(tmp_path), active=["lift"], free=["swing"])
    assert told == []
    assert (machine.active, machine.free) == (("lift", "swing"), ("swing",))
    assert machine.undriven_joints == ()
    reference = crane.point_to_point([0.0, 0.0], [0.4, 0.0], 1.0)
    run = crane.simulate(machine, crane.ComputedTorque(machine, reference))
    assert np.abs(run.tau[:, 1]).max() == 0.0
    assert run.q[:, 0] == pytest.approx(reference.position(run.time)[:, 0], abs=1e-9)
    assert np.ptp(run.q[:, 1]) > 0.1  # it swings
    a = crane.Dynamics(machine).forward(run.q, run.v, run.tau)
    assert a[:, 0] == pytest.approx(reference(run.time)[2][:, 0], abs=1e-6)
    plain = crane.simulate(machine, crane.ComputedTorque(machine, reference), backend="pinocchio")
    assert plain.q == pytest.approx(run.q, abs=1e-10)
    assert "reference_swing" not in run.channels
    assert crane.formats.load_from_expression(run.machine).free == ("swing",)


def test_gains_and_tasks_leave_free_joints_alone(tmp_path):
    swinging(tmp_path)
    path = tmp_path / "swing.yaml"
    path.write_text(
        "name: swing\nchains:\n  - {name: arm, urdf: swing.urdf}\nactive: [lift]\nfree: [swing]\n"
        "home: {lift: 0.1, swing: 1.4707963}\ncontrol:\n  lift: {kp: 500, ki: 100}\n"
        "tasks:\n  up: {duration: 0.1, active: {lift: [0.1, -1]}}\n"
    )
    machine, told = loaded(path)
    assert told == []
    run = crane.simulate(machine, crane.PI(machine, crane.task_trajectory(machine, "up")))
    assert np.abs(run.tau[:, 1]).max() == 0.0
    assert np.abs(run.tau[:, 0]).max() > 0.1
    path.write_text(path.read_text().replace("free: [swing]", "free: [lift]"))
    with pytest.raises(crane.CraneError, match="swing.yaml:5: 'lift' is active and free, keep"):
        crane.load(path)


def test_names_of_load_are_checked(tmp_path):
    path = swinging(tmp_path)
    for given, text in (
        ({"active": ["lif"]}, "active joint 'lif' is unknown, did you mean 'lift'?"),
        ({"free": ["lift", "lift"]}, "free joint 'lift' is named twice, once will do"),
        ({"active": ["lift"], "free": ["lift"]}, "joint 'lift' is active and free, keep one"),
        ({"active": "lift"}, "active is 'lift', give a list of joints such as"),
    ):
        with pytest.raises(crane.CraneError) as caught:
            crane.load(path, **given)
        assert str(caught.value).startswith(text)
    done = typed("info", path, "--active", "lift", "--free", "swing")
    assert done.returncode == 0
    assert [line.split()[0] for line in done.stdout.splitlines() if line.endswith("free")] == [
        "swing"
    ]


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_surplus_drives_share_the_load(tmp_path):
    """Crank and rocker of a four-bar both driven: the least sum of squares, or as is said."""
    edits = [swap("active: [crank]", "active: [crank, coupler]")]
    edits += [swap("control:\n  crank: {kp: 50, ki: 20}\n", "")]
    active = "    active:\n      crank: [1.2, 0.4, -0.2]\n"
    edits += [swap(active, "    tip: {x: [0], y: [0], z: [0]}\n")]
    machine = crane.load(edited(tmp_path, edits))
    assert [drive.name for drive in machine.drives] == ["crank", "coupler"]
    dynamics = crane.Dynamics(machine)
    q_a = np.linspace(0.9, 1.4, 7)[:, None]
    wanted = dynamics.inverse(q_a, 0.3 * q_a, 2 * q_a)
    gamma = machine.closure.gamma(machine.closure.solve(q_a))
    reach = gamma[:, [machine.column("crank"), machine.column("coupler")], 0]
    for sharing in (None, {"coupler": 4.0}):
        forces = dynamics.drive_forces(q_a, wanted, sharing)
        assert dynamics.active_forces(q_a, forces) == pytest.approx(wanted, rel=1e-12)
        # where the weighted squares are least, forces are as the reaches times weights
        weights = np.array([1.0, 4.0 if sharing else 1.0])
        assert forces == pytest.approx(
            wanted * weights * reach / (weights * reach**2).sum(axis=1)[:, None], rel=1e-12
        )
    one = dynamics.drive_forces(q_a[0], wanted[0])
    assert one == pytest.approx(dynamics.drive_forces(q_a, wanted)[0], rel=1e-14)
    with pytest.raises(crane.CraneError, match="sharing names the drive 'rod', known: coupler, c"):
        dynamics.drive_forces(q_a, wanted, {"rod": 1.0})
