"""A closed machine in ROS: tree as URDF, states of all joints from those of the actuators."""

import runpy
import sys
import types
from pathlib import Path
from urllib.parse import unquote, urlparse

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy
from broken_machines import DATA
from command_line import typed
from executed_lines import at_most
from lxml import etree

import crane
from crane.common.errors import InputError, OutOfReachError

ROOT = Path(__file__).parents[1]
OTHERS = ROOT.parent / "shared" / "data" / "third_party" / "parallel_robots"
BUNDLED = ["mini_forwarder", "patu655_grapple", "excavator", DATA / "stewart.urdf", DATA / "delta"]
FLOATING = "excavator that floats"
THEIRS = ["5bar_linkage_iso6d", "digit_like_2legs", "robot_delta", "wl16_like"]
EPS = np.finfo(float).eps


def loaded(name):
    if name in THEIRS and not OTHERS.is_dir():
        pytest.skip(f"{OTHERS} with robots of others is not there")
    if name == FLOATING:
        return crane.load("excavator", floating=True)
    return crane.load(OTHERS / name if name in THEIRS else name)


def near_home(machine, rng, share=1e-3):
    units = machine.closure.units[machine.closure.active]
    home = machine.home[machine.closure.active]
    moved = [not joint.startswith("base_") for joint in machine.active]
    return home + share * units * rng.uniform(-1, 1, len(home)) * moved


def by_pinocchio(text, state):
    """Model of a URDF, its data with all frames placed at a state of its joints, and these."""
    model = pin.buildModelFromXML(text)
    data, q = model.createData(), pin.neutral(model)
    for name, value in zip(state.name, state.position, strict=True):
        joint = model.joints[model.getJointId(name)]  # an endless one has cosine and sine
        own = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        q[joint.idx_q : joint.idx_q + joint.nq] = own
    pin.framesForwardKinematics(model, data, q)
    return model, data, q


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
@pytest.mark.parametrize("name", [*BUNDLED, FLOATING, *THEIRS], ids=lambda name: Path(name).stem)
def test_other_readers_place_every_link_of_the_tree_where_the_machine_has_it(name, tmp_path):
    machine, rng = loaded(name), np.random.default_rng(5)
    path = tmp_path / "tree.urdf"
    path.write_text(crane.formats.robot_description(machine))
    transmission = crane.motion.Transmission(machine)
    own = crane.Kinematics(machine, machine.tip or machine.closure.equations.loops[0].successor)
    tree = yourdfpy.URDF.load(path, load_meshes=False)
    names = {x for x in machine.joints if not x.startswith("base_")}
    assert set(tree.actuated_joint_names) - {"base"} == names
    for _ in range(3):
        q_a = near_home(machine, rng)
        state = transmission.update(machine.active, q_a)
        model, data, _ = by_pinocchio(path.read_text(), state)
        assert set(model.names[1:]) - {"base"} == names == set(state.name)
        tree.update_cfg(dict(zip(state.name, state.position.tolist(), strict=True)))
        tolerance = 100 * EPS * machine.closure.characteristic_length
        ends = [(loop.predecessor, loop.successor) for loop in machine.closure.equations.loops]
        for one, two in ends:  # pins and balls: the two frames' origins meet
            places = [data.oMf[model.getFrameId(end)].translation for end in (one, two)]
            assert np.abs(places[0] - places[1]).max() < tolerance
        tip = data.oMf[model.getFrameId(own.frame)]
        assert np.abs(tip.translation - own.position(q_a)).max() < tolerance
        theirs = tree.get_transform(own.frame)
        assert np.abs(theirs[:3] - tip.homogeneous[:3]).max() < 10 * tolerance


@pytest.mark.parametrize("name", BUNDLED, ids=lambda name: Path(name).stem)
def test_urdfdom_takes_the_tree_without_a_word(name, capfd):
    machine = loaded(name)
    pin.buildModelFromXML(crane.formats.robot_description(machine))  # its parser is urdfdom's
    assert capfd.readouterr().err == ""
    root = etree.fromstring(crane.formats.robot_description(machine))
    tags = {element.tag for element in root.iterchildren(etree.Element)}
    assert tags <= {"link", "joint", "material"}
    assert not list(root.iter("mimic"))
    assert set().union(*(joint.attrib for joint in root.iter("joint"))) == {"name", "type"}
    assert set().union(*(link.attrib for link in root.iter("link"))) == {"name"}


@pytest.mark.parametrize("name", ["mini_forwarder", DATA / "stewart.urdf"])
def test_torques_of_the_tree_become_the_forces_of_the_actuators(name):
    machine = loaded(name)
    machine = machine.replace(forces=(), gas_springs=(), friction={})
    transmission = crane.motion.Transmission(machine)
    q_a = near_home(machine, np.random.default_rng(3), 0.02)
    state = transmission.update(machine.active, q_a)
    model, data, q = by_pinocchio(crane.formats.robot_description(machine), state)
    weight = pin.computeGeneralizedGravity(model, data, q)
    torques = {x: weight[model.joints[model.getJointId(x)].idx_v] for x in state.name}
    held = transmission.joint_to_actuator(torques)
    expected = crane.Dynamics(machine).gravity(q_a)
    assert tuple(held) == machine.active
    assert np.abs(list(held.values()) - expected).max() < 1e-11 * np.abs(expected).max()


def test_velocities_are_derivatives_and_power_is_the_same_on_both_sides():
    machine, rng = loaded("patu655_grapple"), np.random.default_rng(8)
    transmission = crane.motion.Transmission(machine)
    q_a = near_home(machine, rng, 0.02)
    v_a, tau = rng.normal(size=len(q_a)), rng.normal(size=len(machine.joints))
    h = 1e-5
    ahead, behind = (transmission.update(machine.active, q_a + x * v_a) for x in (h, -h))
    state = transmission.update(machine.active, q_a, v_a)
    difference = (ahead.position - behind.position) / (2 * h)
    assert np.abs(difference - state.velocity).max() < 1e-8
    f_a = transmission.joint_to_actuator(dict(zip(state.name, tau.tolist(), strict=True)))
    assert np.isclose(np.dot(list(f_a.values()), v_a), tau @ state.velocity, rtol=1e-12)
    wrench = rng.normal(size=6)
    f_a = transmission.wrench_to_actuator(wrench)
    place = crane.Kinematics(machine)
    moved = (place.position(q_a + h * v_a) - place.position(q_a - h * v_a)) / (2 * h)
    push = transmission.wrench_to_actuator([*wrench[:3], 0, 0, 0])
    assert np.isclose(np.dot(list(push.values()), v_a), wrench[:3] @ moved, atol=1e-8)
    applied = crane.Dynamics(machine).project_wrenches(q_a, {machine.tip: wrench})
    assert np.allclose(list(f_a.values()), applied, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "joints"),
    [
        ("patu655", ("slew", "q2", "q3", "X_ext")),  # booms for their cylinders
        (DATA / "stewart.urdf", ("a1", "b1", "s1", "c1", "d1", "e1")),  # one leg for all six
    ],
)
def test_forces_of_actuators_are_forces_at_other_joints_and_back(name, joints):
    machine, rng = loaded(name), np.random.default_rng(2)
    transmission = crane.motion.Transmission(machine)
    q_a = near_home(machine, rng, 0.02)
    state = transmission.update(machine.active, q_a)
    forces = dict(zip(machine.active, rng.normal(size=len(q_a)).tolist(), strict=True))
    there = transmission.actuator_to_joint(forces, joints)
    back = transmission.joint_to_actuator(there)
    assert tuple(there) == joints
    assert np.allclose([back[x] for x in forces], list(forces.values()), rtol=1e-10, atol=1e-10)
    seen = machine.with_active_joints(joints)  # whose own gravity is the same machine's
    held = crane.Dynamics(machine).gravity(q_a)
    there = transmission.actuator_to_joint(dict(zip(machine.active, held, strict=True)), joints)
    expected = crane.Dynamics(seen).gravity(state.position[seen.closure.active])
    tolerance = 1e-9 * np.abs(expected).max()
    assert np.abs(np.array(list(there.values())) - expected).max() < tolerance


def test_messages_name_some_joints_in_any_order_and_others_too():
    machine = loaded("patu655")
    transmission = crane.motion.Transmission(machine)
    home = dict(zip(machine.joints, machine.home.tolist(), strict=True))
    assert transmission.update(["X_tilt", "engine"], [home["X_tilt"], 180.0], [0.1, 0.0]) is None
    assert transmission.unknown_actuators == ("slew", "X_lift", "X_ext")
    assert transmission.state is None
    assert transmission.update(["pump"], [1.0]) is None
    rest = ["X_ext", "q2", "slew", "X_lift"]  # q2 is passive, and what is said of it is not read
    given = [home["X_ext"], 9.9, home["slew"], home["X_lift"]]
    state = transmission.update(rest, given, [0.0] * 4, [1.0, 2.0, 3.0, 4.0])
    assert transmission.unknown_actuators == () and state is transmission.state
    assert np.abs(state.position - machine.home).max() < 1e-14
    assert state.name == machine.joints
    v_a = np.array([0.0, 0.0, 0.1, 0.0])
    assert np.array_equal(state.velocity, machine.closure.gamma(state.position) @ v_a)
    assert len(state.effort) == 0  # nobody has said that of the tilt cylinder
    state = transmission.update(["X_tilt"], [np.nan], [0.2], [7.0])
    assert np.abs(state.position - machine.home).max() < 1e-14
    told = {x: y for x, y in zip(state.name, state.effort.tolist(), strict=True) if y}
    assert told == {"slew": 3.0, "X_lift": 4.0, "X_tilt": 7.0, "X_ext": 1.0}
    state = transmission.update(["X_lift"], [home["X_lift"] + 0.01])  # its velocity is old now
    assert len(state.velocity) == len(state.effort) == 0
    assert np.array_equal(state.position[machine.column("X_tilt")], home["X_tilt"])


def test_a_vehicle_that_floats_is_placed_by_others_and_its_crane_is_as_on_the_ground():
    machine, same = loaded(FLOATING), loaded("excavator")
    transmission, other = crane.motion.Transmission(machine), crane.motion.Transmission(same)
    assert transmission.actuators == transmission.unknown_actuators == same.active
    assert transmission.update(["base_x", "slew"], [3.0, 0.4], [1.0, 0.1]) is None
    strokes = near_home(same, np.random.default_rng(6), 0.02)
    states = [x.update(same.active, strokes, strokes, strokes) for x in (transmission, other)]
    assert states[0].name == states[1].name
    for field in ("position", "velocity", "effort"):
        one, two = (getattr(state, field) for state in states)
        assert np.allclose(one, two, rtol=1e-12, atol=1e-13)
    wrench = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    there = [list(x.wrench_to_actuator(wrench).values()) for x in (transmission, other)]
    assert np.allclose(*there, rtol=1e-11)
    with pytest.raises(InputError, match="joint 'base_x' is unknown, known: X_arm, "):
        transmission.joint_to_actuator({"base_x": 1.0})


def test_what_is_out_of_reach_is_an_error_and_the_state_stays():
    machine = loaded("patu655")
    transmission = crane.motion.Transmission(machine)
    home = machine.home[machine.closure.active]
    before = transmission.update(machine.active, home)
    with pytest.raises(OutOfReachError, match="loop 'lift_eye' cannot be closed at slew = 1, X_l"):
        transmission.update(["X_lift", "slew"], [-1.0, 1.0])
    assert transmission.state is before
    state = transmission.update(["X_tilt"], [home[2] + 0.01])
    expected = machine.closure.solve(home + [0, 0, 0.01, 0])
    assert np.abs(state.position - expected).max() < 1e-14


def test_an_update_is_little_work_so_that_a_thousand_fit_into_a_second():
    machine = loaded("patu655_grapple")
    transmission = crane.motion.Transmission(machine)
    q_a = machine.home[machine.closure.active]
    for k in range(3):
        with at_most(10**6 if k < 2 else 250):  # what is made once is made by then
            transmission.update(machine.active, q_a + 1e-3 * k, q_a, q_a)


@pytest.mark.parametrize(
    ("act", "error"),
    [
        (lambda t: t.update(["X_lift"], [0.1, 0.2]),
         "position has 2 values for 1 names, give one each or none"),
        (lambda t: t.update(["X_lift"], [0.1], [np.inf]),
         "velocity has an infinite value, give NaN for what is not measured"),
        (lambda t: t.joint_to_actuator({"boom": 1.0}), "joint 'boom' is unknown, known: "),
        (lambda t: t.joint_to_actuator({"q2": np.nan}), "effort of q2 is nan, "),
        (lambda t: t.actuator_to_joint({"q2": 1.0}, ["q3"]), "'q2' is not active, known: "),
        (lambda t: t.actuator_to_joint({}, ["slew", "q2"]),
         "slew, q2 do not determine the motion of the machine here, give 4 independent joints"),
        (lambda t: t.actuator_to_joint({}, ["slew", "q2", "lift_barrel", "X_ext"]), "slew, q2, "
         "lift_barrel, X_ext do not determine the motion of the machine here, give 4 independent"),
        (lambda t: t.wrench_to_actuator([1.0, 0, 0]), "the wrench on 'tip' has the shape (3,)"),
        (lambda t: t.wrench_to_actuator([0.0] * 6, "hook"), "frame 'hook' is unknown, "),
        (lambda t: crane.motion.Transmission(t.machine).wrench_to_actuator([0.0] * 6),
         "the configuration is not known yet, update it with slew, X_lift, X_tilt, X_ext"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_one_line(act, error):
    machine = loaded("patu655")
    transmission = crane.motion.Transmission(machine)
    transmission.update(machine.active, machine.home[machine.closure.active])
    with pytest.raises(InputError) as caught:
        act(transmission)
    assert str(caught.value).startswith(error)


def test_meshes_have_uris_and_packages_keep_theirs(tmp_path):
    text = (DATA / "four_bar_loop.urdf").read_text()
    (tmp_path / "a rod.stl").write_bytes(b"")
    (tmp_path / "arms").mkdir()
    (tmp_path / "arms" / "package.xml").write_text("<package><name>arms</name></package>")
    (tmp_path / "arms" / "arm.stl").write_bytes(b"")
    names = ["a rod.stl", "package://arms/arm.stl", "gone.stl"]
    shapes = "".join(
        f'<visual><geometry><mesh filename="{name}"/></geometry></visual>' for name in names
    )
    path = tmp_path / "bar.urdf"
    path.write_text(text.replace('<link name="crank_arm">', f'<link name="crank_arm">{shapes}'))
    root = etree.fromstring(crane.formats.robot_description(crane.load(path)))
    first, *rest = [mesh.get("filename") for mesh in root.iter("mesh")]
    assert urlparse(first).scheme == "file"
    assert Path(unquote(urlparse(first).path)) == (tmp_path / "a rod.stl").resolve()
    assert rest == names[1:]


def test_the_command_line_writes_the_tree(tmp_path):
    path = tmp_path / "crane.urdf"
    assert typed("convert", "patu655", path, "--to", "urdf").returncode == 0
    assert path.read_text() == crane.formats.robot_description(crane.load("patu655"))


class _Message:
    """A message of ROS: the fields that it is given, others empty."""

    def __init__(self, **fields):
        self.__dict__ = {"header": None, "velocity": [], "effort": []} | fields


class _Ros:
    """What the example uses of rclpy, with the messages that go through it."""

    def __init__(self, heard):
        self.heard, self.topics, self.said, self.callbacks = heard, {}, [], {}
        outer = self

        class Node:
            def __init__(self, name):
                assert outer.begun

            def create_publisher(self, kind, topic, qos):
                outer.topics[topic] = (kind, qos, [])
                return types.SimpleNamespace(publish=outer.topics[topic][2].append)

            def create_subscription(self, kind, topic, callback, qos):
                outer.callbacks[topic] = callback

            def get_logger(self):
                return types.SimpleNamespace(
                    warning=lambda text, throttle_duration_sec: outer.said.append(text)
                )

        self.begun, self.node = False, Node

    def init(self):
        self.begun = True

    def spin(self, node):
        for topic, message in self.heard:
            self.callbacks[topic](message)

    def modules(self):
        def module(name, **parts):
            made = types.ModuleType(name)
            made.__dict__.update(parts)
            return name, made

        qos = {"QoSProfile": dict, "DurabilityPolicy": types.SimpleNamespace(TRANSIENT_LOCAL=1)}
        return dict(
            [
                module("rclpy", init=self.init, spin=self.spin),
                module("rclpy.node", Node=self.node),
                module("rclpy.qos", **qos),
                module("sensor_msgs"),
                module("sensor_msgs.msg", JointState=_Message),
                module("std_msgs"),
                module("std_msgs.msg", String=type("String", (_Message,), {})),
            ]
        )


def test_the_node_of_the_example_publishes_by_rclpy(monkeypatch):
    machine = loaded("patu655")
    q_a = machine.home[machine.closure.active].tolist()
    stamps = [_Message(stamp=x) for x in range(4)]
    messages = [
        _Message(header=stamps[0], name=["X_lift"], position=q_a[1:2]),  # too few yet
        _Message(header=stamps[1], name=[*machine.active], position=q_a, velocity=[0.1] * 4),
        _Message(header=stamps[2], name=["X_lift"], position=[-1.0]),  # out of reach
        _Message(header=stamps[3], name=["X_lift"], position=[q_a[1] + 0.01]),
    ]
    ros = _Ros([("actuator_states", message) for message in messages])
    for name, module in ros.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(ROOT / "examples" / "ros2_joint_states.py"), run_name="__main__")
    _, qos, (description,) = ros.topics["robot_description"]
    assert qos == {"depth": 1, "durability": 1}  # who comes later gets it, too
    assert description.data == crane.formats.robot_description(machine)
    _, _, (first, second) = ros.topics["joint_states"]
    assert (first.header, second.header) == (stamps[1], stamps[3])
    assert type(first.position) is list and first.name == list(machine.joints)
    expected = machine.closure.solve([q_a[0], q_a[1] + 0.01, *q_a[2:]])
    assert np.abs(np.array(second.position) - expected).max() < 1e-14
    assert len(first.velocity) == 10 and second.velocity == second.effort == []
    (said,) = ros.said
    assert said.startswith("loop 'lift_eye' cannot be closed at slew = 0, X_lift = -1,")
