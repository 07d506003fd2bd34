"""The assembled machine: its properties and its errors."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from broken_machines import MINI, copy_machine, swap
from oracles import (
    by_stroke,
    mini_forwarder,
    mini_forwarder_potential,
)

import crane
from crane.common.errors import InputError, LimitError, MechanismError
from crane.description import example_robots

ELEVEN = {"q1", "q2", "q3", "q4", "X1", "q6", "q7", "q9", "q10", "X2", "q11"}


def test_mini_forwarder_is_what_the_paper_describes(mini):
    assert set(mini.joints) == ELEVEN and mini.active == ("q1", "X1", "X2")
    assert [chain.name for chain in mini.chains] == ["A", "B1", "C", "B2", "D"]
    assert [loop.name for loop in mini.closure.equations.loops] == ["A1_eye", "A2_eye", "J", "K"]
    assert np.array_equal(mini.lower, [-np.pi, 0, 0])
    assert np.array_equal(mini.upper, [np.pi, 0.030, 0.030])
    assert {mini.unit(joint) for joint in ("X1", "X2")} == {"m"}
    assert {mini.unit(joint) for joint in ELEVEN - {"X1", "X2"}} == {"rad"}
    assert set(mini.tasks) == {"loading", "return", "lift"} and set(mini.control) == {*mini.active}
    assert mini.tip == "link7_tip" and mini.load_name == "mini_forwarder"
    assert pin.computeTotalMass(mini.model) == pytest.approx(1.2874, abs=1e-12)


def test_a_machine_cannot_be_changed(mini):
    with pytest.raises(dataclasses.FrozenInstanceError):
        mini.tip = "link3"
    changed = mini.replace(friction={})
    assert changed.friction == {} and mini.friction and changed.end_stops == mini.end_stops
    assert (
        mini.replace(forces=[crane.description.ForceElement("q3", stiffness=1.0)]).forces[0].joint
        == "q3"
    )


def test_limits_are_checked_where_asked(mini):
    inside = [[0.1, 0.0, 0.030], [-3.0, 0.03, 0.0]]
    assert np.array_equal(mini.check_limits(inside), inside)
    mini.check_limits([0.0, 0.030 + 1e-12, -1e-12])  # rounding counts as on the limit
    with pytest.raises(LimitError) as error:
        mini.check_limits([0.0, 0.031, 0.01], "the start")
    assert str(error.value) == (
        "the start: X1 = 0.031 is outside of its limits 0 to 0.03 m (chain_b1.urdf:57), choose "
        "one within them"
    )
    with pytest.raises(LimitError, match=r"q_a: q1 = 3\.2 in sample 1 is outside .* rad"):
        mini.check_limits([[0.0, 0.01, 0.01], [3.2, 0.01, 0.01]])


def test_errors_of_limits_tell_where_they_stand(tmp_path):
    """Errors name the start, path, task or configuration, and the parameter of a changed limit."""
    path = copy_machine(MINI, tmp_path)
    (file,) = tmp_path.rglob("chain_b1.urdf")
    (line,) = (i for i, text in enumerate(file.read_text().splitlines(), 1) if "<limit" in text)
    place = rf"0 to 0\.03 m \(chain_b1\.urdf:{line}\), choose one within them"
    machine = crane.load(path)
    far = machine.home[machine.closure.active] + [0, 0.02, 0]
    task = "  far: {duration: 1, active: {q1: [0], X1: [0.04], X2: [0.01]}}\n"
    text = path.read_text().replace("tasks:\n", f"tasks:\n{task}")
    (tmp_path / "task.yaml").write_text(text)
    for call in (
        lambda: crane.simulate(machine, initial=far, duration=0.1),
        lambda: crane.simulate(machine, crane.PI(machine, crane.point_to_point(far, far, 1.0))),
        lambda: crane.sketch(machine, tmp_path / "a.svg", far),
    ):
        with pytest.raises(LimitError, match=place):
            call()
    with pytest.raises(LimitError, match=rf"limit 0\.03 m \(chain_b1\.urdf:{line}\) from t"):
        crane.task_trajectory(crane.load(tmp_path / "task.yaml"), "far")
    shorter = crane.load(path, {"X1.upper": 0.025})
    with pytest.raises(LimitError, match=r"limits 0 to 0\.025 m \(changed by X1\.upper\), choose"):
        shorter.check_limits([0.0, 0.029, 0.01])
    with pytest.raises(crane.CraneError, match=r"0 to 0\.01 \(changed by X1\.upper\), choose"):
        crane.load(path, {"X1.upper": 0.01})


def test_unknown_names(mini):
    for call, text in (
        (lambda: mini.column("X3"), "joint 'X3' is unknown, .*X1.*"),
        (lambda: mini.unit("q5"), "joint 'q5' is unknown"),
        (lambda: mini.frame("link7_tipp"), "did you mean 'link7_tip'"),
        (lambda: mini.frame("q1"), "frame 'q1' is unknown"),  # a joint is not a link
        (
            lambda: mini.replace(friction={"q12": crane.description.Friction()}),
            "joint 'q12' is unknown",
        ),
        (
            lambda: mini.replace(forces=(crane.description.ForceElement("x1"),)),
            "joint 'x1' is unknown",
        ),
        (
            lambda: mini.replace(end_stops=(crane.description.EndStop("q2", 1.0),)),
            "'q2' has no limits",
        ),
        (lambda: mini.check_limits([0.0, np.nan, 0.0]), "q_a is nan at X1"),
    ):
        with pytest.raises(InputError, match=text):
            call()


@pytest.mark.parametrize(
    ("payload", "text"),
    [
        ({"frame": "link8"}, "frame 'link8' is unknown"),
        ({"mass": -1.0}, r"mass is -1 kg, it must not be negative"),
        ({"mass": np.nan}, "mass is nan kg"),
        ({"com": (0.0, 0.1)}, "payload's com has the shape"),
        ({"com": (0.0, np.inf, 0.0)}, "payload's com is inf"),
        ({"inertia": np.ones(3)}, "not a symmetric"),
        ({"inertia": [[1, 1, 0], [0, 1, 0], [0, 0, 1]]}, "not a symmetric"),
        ({"inertia": np.diag([1.0, 1.0, -0.1])}, "negative principal moment"),
        ({"inertia": np.diag([1.0, 1.0, 3.0])}, "no possible body"),
        ({"mass": 0.0, "inertia": np.eye(3)}, "inertia but no mass"),
    ],
)
def test_impossible_payloads(mini, payload, text):
    given = {"frame": "link7_tip", "mass": 1.0, **payload}
    with pytest.raises(InputError, match=text):
        mini.with_payload(crane.Payload(**given))


def test_endless_joints_have_infinite_limits(mini):
    for joint in mini.joints:
        column = mini.column(joint)
        limits = mini.model.lowerPositionLimit[column], mini.model.upperPositionLimit[column]
        assert np.isfinite(limits).all() == (joint in mini.active), joint


class TestDrivenBy:
    """The mini forwarder driven at its booms' angles instead of its strokes."""

    @pytest.fixture
    def strokes(self):
        random = np.random.default_rng(5)
        return random.uniform([-3.0, 0.001, 0.001], [3.0, 0.029, 0.029], (100, 3))

    def test_postures_are_the_same(self, mini, strokes):
        """Strokes from the angles that the closed form has at them."""
        driven = mini.with_active_joints(["q1", "q2", "q3"])
        assert driven.active == ("q1", "q2", "q3")
        assert driven.joints == mini.joints and driven.load_name == mini.load_name
        assert np.abs(driven.home - mini.home).max() < 1e-14
        joints, _ = mini_forwarder(*strokes.T[1:])
        q = driven.closure.solve(np.column_stack([strokes[:, 0], joints["q2"], joints["q3"]]))
        columns = [mini.column(joint) for joint in mini.active]
        assert np.abs(q[:, columns] - strokes).max() < 1e-13
        assert np.array_equal(driven.lower, [-np.pi, -np.inf, -np.inf])
        assert not driven.upper.flags.writeable

    def test_torques_are_the_forces_times_dx_dq(self, mini, strokes):
        """Equations (18), (19), in any motion; at rest also the slope of the potential."""
        driven = mini.with_active_joints(["q1", "q2", "q3"])
        random = np.random.default_rng(6)
        v_a, a_a = random.uniform(-0.05, 0.05, (2, *strokes.shape))
        q = mini.closure.solve(strokes)
        to_b = mini.closure.gamma(q)
        v = np.einsum("nij,nj->ni", to_b, v_a)
        a = np.einsum("nij,nj->ni", to_b, a_a) + mini.closure.drift(q, v)
        b = driven.closure.active
        forces = crane.Dynamics(mini).inverse(strokes, v_a, a_a)
        torques = crane.Dynamics(driven).inverse(q[:, b], v[:, b], a[:, b])
        lever = driven.closure.gamma(q)[:, mini.closure.active]
        expected = np.einsum("nij,ni->nj", lever, forces)
        assert np.abs(torques - expected).max() < 1e-12 * np.abs(expected).max()
        slope = by_stroke(mini_forwarder_potential, *strokes.T[1:])
        at_rest = np.einsum("nij,in->nj", lever[:, 1:, 1:], slope)
        held = crane.Dynamics(driven).gravity(q[:, b])
        assert np.abs(held[:, 1:] - at_rest).max() < 1e-12 * np.abs(at_rest).max()

    def test_what_belongs_to_the_old_joints_is_dropped(self, mini):
        driven = mini.with_active_joints(("q1", "q2", "q3"))
        assert driven.control == {} and set(driven.tasks) == set(mini.tasks)  # all of the tip
        assert driven.friction == mini.friction and driven.end_stops == mini.end_stops
        turned_round = mini.with_active_joints(["X2", "q1", "X1"])
        assert turned_round.control == mini.control
        assert np.array_equal(turned_round.lower, mini.lower[[2, 0, 1]])

    def test_tasks_of_active_joints_are_dropped(self, edited):
        machine = edited("four_bar.yaml")
        assert set(machine.tasks) == {"swing", "reach"}
        assert set(machine.with_active_joints(["crank"]).tasks) == {"swing", "reach"}
        assert set(machine.with_active_joints(["rocker"]).tasks) == {"reach"}

    def test_circuit_keeps_the_cylinders_that_still_drive(self, tmp_path):
        path = copy_machine(MINI, tmp_path)
        valve = "{type: compensated, flow: 1.0e-4, margin: 7.0e+5}"
        cylinder = "{area_a: 3.0e-4, area_b: 2.0e-4, hose_a: 1.0e-5, hose_b: 1.0e-5}"
        parts = ["cylinders", cylinder, "valves", valve]
        swap(
            "tip: link7_tip\n",
            "tip: link7_tip\nhydraulics:\n  supply: {pressure: 2.0e+6}\n"
            + "".join(
                f"  {kind}: {{X1: {part}, X2: {part}}}\n"
                for kind, part in zip(parts[::2], parts[1::2], strict=True)
            ),
            MINI,
        ).apply(tmp_path)
        machine = crane.load(path)
        assert machine.with_active_joints(["q1", "q2", "q3"]).hydraulics is None
        assert machine.with_active_joints(["q1", "X2", "q2"]).hydraulics.joints == ("X2",)
        circuit = machine.with_active_joints(["X2", "X1", "q1"]).hydraulics
        assert list(circuit.cylinders) == list(circuit.valves) == ["X2", "X1"]
        assert circuit.supply == machine.hydraulics.supply

    @pytest.mark.parametrize(
        ("names", "error", "text"),
        [
            (["q1", "q2", "q8"], InputError, "joint 'q8' is unknown, known: X1, X2, q1"),
            (["q1", "q2", "q2"], InputError, "joint 'q2' is named twice"),
            (["q1", "q2"], MechanismError, "2 active joints .q1, q2. for 3 degrees of freedom"),
            (["q1", "q2", "q3", "X1"], MechanismError, "name only 3 of them"),
            # q4 and q9 both follow from X1 alone
            (["q1", "q4", "q9"], MechanismError, "the active joints q1, q4, q9 cannot drive"),
            (["q2", "q3", "q9"], MechanismError, "cannot drive q1: choose others"),
        ],
    )
    def test_joints_that_cannot_drive(self, mini, names, error, text):
        with pytest.raises(error, match=text):
            mini.with_active_joints(names)


@pytest.mark.filterwarnings("ignore::crane.common.errors.CraneWarning")
@pytest.mark.parametrize("name", ["talos_reduced", "ur5_robot", "hyq_no_sensors", "kinova"])
def test_a_tree_is_what_pinocchio_makes_of_the_urdf(name):
    """Joints, frames and their order, placements to the last digit, inertias to rounding."""
    path = example_robots().get(name)
    if path is None:
        pytest.skip("example-robot-data is not installed")
    ours, theirs = crane.load(name).model, pin.buildModelFromUrdf(str(path))
    turning = [joint.shortname().replace("RUB", "R") for joint in theirs.joints]
    assert [joint.shortname() for joint in ours.joints] == turning
    assert list(ours.names) == list(theirs.names)
    assert list(ours.parents) == list(theirs.parents)
    described = ("name", "type", "parentJoint", "parentFrame", "placement")
    for one, two in zip(ours.frames, theirs.frames, strict=True):
        assert [getattr(one, x) for x in described] == [getattr(two, x) for x in described]
    for joint in range(ours.njoints):
        assert ours.jointPlacements[joint] == theirs.jointPlacements[joint]
        np.testing.assert_allclose(
            ours.inertias[joint].toDynamicParameters(),
            theirs.inertias[joint].toDynamicParameters(),
            rtol=1e-12, atol=1e-15,
        )  # fmt: skip
