"""Valves with one spool per chamber against closed forms, scipy and their balances."""

import dataclasses

import numpy as np
import pytest
from circuit_state import circuit_of, flow, now
from full_circuit import gaps
from hydraulic_rig import AREA_A, AREA_B, ORIFICE, rig
from scipy.optimize import brentq
from test_circuit_transients import VALVE, C, G, clip, compare, cylinder, root

import crane
from crane.common.errors import CraneError
from crane.control import ValveSignals
from crane.view.result_files import plot_result

TANK, SUPPLY = 1e5, 9.25e6
C1, C2, C3, C4 = (ORIFICE[name] for name in ("c1", "c2", "c3", "c4"))
APART = ORIFICE | {"spool_b": {}}
OTHER = {"neutral": 1.0, "full": 5.0, "dead_band": 0.1, "bandwidth": 25.0, "damping": 0.7}


def test_each_chamber_has_its_own_edges(tmp_path):
    """c1, c3 of A by its spool, c2, c4 of B by the other: nine states of two spools."""
    machine = rig(tmp_path, APART)
    a, b = 4e6, 2e6
    for u in (0.6, 0.0, -0.6):
        for w in (0.3, 0.0, -0.3):
            at, _ = now(machine, [u, w], pressure_x_a=a, pressure_x_b=b)
            into_a = C1 * max(u, 0) * np.sqrt(SUPPLY - a)
            into_b = C4 * max(-w, 0) * np.sqrt(SUPPLY - b)
            out_a = C3 * max(-u, 0) * np.sqrt(a - TANK)
            out_b = C2 * max(w, 0) * np.sqrt(b - TANK)
            assert flow(at, "inlet", target="x.a") == pytest.approx(into_a, rel=1e-12)
            assert flow(at, "inlet", target="x.b") == pytest.approx(into_b, rel=1e-12)
            assert flow(at, "outlet", source="x.a") == pytest.approx(out_a, rel=1e-12)
            assert flow(at, "outlet", source="x.b") == pytest.approx(out_b, rel=1e-12)


@pytest.mark.parametrize(("u", "w"), [(0.5, 0.2), (0.3, 0.9), (0.5, -0.4)])
def test_steady_motion_metered_in_and_out_apart(tmp_path, u, w):
    """A v = Q_A = .., B v = Q_B through the two spools, A p_A - B p_B = d v; also regenerating."""
    machine = rig(tmp_path, APART, axis="1 0 0", friction={"viscous": 8e4})
    control = ValveSignals(machine, [0.0], {"x": [u], "x_b": [w]})
    run = crane.simulate(machine, control, [0.05], 3.0, tolerance=1e-10)

    def left(v):
        a = SUPPLY - (AREA_A * v / (C1 * u)) ** 2
        b = TANK + (AREA_B * v / (C2 * w)) ** 2
        if w < 0:  # what leaves B goes back to the pump, and from there into A
            b = SUPPLY + (AREA_B * v / (C4 * w)) ** 2
        return AREA_A * a - AREA_B * b - 8e4 * v

    v = brentq(left, 1e-4, 1.0, xtol=1e-15)
    assert 0.01 < v * 3.0 < 0.45
    assert run.v[-1, 0] == pytest.approx(v, rel=1e-7)


def test_two_spools_with_laws_of_their_own_beside_scipy(tmp_path):
    """A lowered load, held back by the second spool, then regenerated: 1e-6."""
    valve = VALVE | {"bandwidth": 60.0, "spool_b": OTHER | {"rate": 0.0}}
    machine = rig(tmp_path, valve)
    times = [0.0, 0.2, 0.4, 1.0, 1.2, 1.6]
    one = [0.0, 0.0, 0.6, 0.6, -0.2, -0.2]
    two = [1.0, 1.0, 2.2, 1.5, 0.4, -2.0]

    def follow(s, u, rate, w, d):
        return [rate, w * w * (clip(s, -1.0) - u) - 2 * d * w * rate]

    def rates(t, y):
        x, v, a, b, u, u1, w, w1 = y
        s, r = np.interp(t, times, one), (np.interp(t, times, two) - 1.0) / 4.0
        q_a = C * (u * root(9.25e6 - a) if u >= 0 else u * root(a - TANK))
        z = np.sign(w) * clip((abs(w) - 0.1) / 0.9)
        q_b = -C * (z * root(b - TANK) if z >= 0 else z * root(9.25e6 - b))
        return [
            *cylinder(x, v, a, b, q_a, q_b, weight=2000 * G),
            *follow(s, u, u1, 60.0, 1.0), *follow(r, w, w1, 25.0, 0.7),
        ]  # fmt: skip

    names = ["x", "x.v", "pressure_x_a", "pressure_x_b", "spool_x", "du", "spool_x_b", "dw"]
    run = compare(
        machine, {"x": one, "x_b": two}, rates, names, 1.6, times,
        start={"du": 0.0, "dw": 0.0}.items(),
    )  # fmt: skip
    assert run.channels["spool_x_b"].min() < -0.2 and run.channels["spool_x_b"].max() > 0.2
    np.testing.assert_allclose(run.channels["voltage_x_b"], np.interp(run.time, times, two))


def everything_apart(folder, **more):
    """Two cylinders on a pump of limited flow, one compensated and apart, one that shares."""
    pump = {
        "control": "load-sensing",
        "pressure": 2e7,
        "flow": 8e-4,
        "margin": 2e6,
        "relief": 22e6,
    }
    return rig(
        folder, VALVE | {"bandwidth": 50.0}, joints=("x", "y"), supply=pump | {"response": 0.05},
        valves={
            "x": {"spool_b": {"bandwidth": 30.0, "hysteresis": 0.02, "delay": 0.013}},
            "y": {"type": "compensated", "margin": 8e5, "spool_b": {"dead_band": 0.05}},
        },
        cylinders={"x": {"stiffness": 2e7, "damping": 5e4, "relief": 26e6, "refill": 1e-6}},
        friction={"viscous": 2e4}, **more,
    )  # fmt: skip


LEVERS = {
    "x": [0.0, 0.0, 0.7, 0.7, -0.2, -0.6], "x_b": [0.0, 0.0, 0.3, -0.4, -0.4, -0.1],
    "y": [0.0, 0.5, 0.5, -0.3, 0.0, 0.3], "y_b": [0.0, 0.8, 0.2, -0.6, 0.4, -0.3],
}  # fmt: skip
AT = [0.0, 0.2, 0.5, 0.9, 1.2, 1.5]


def test_balances_and_powers_close(tmp_path):
    machine = everything_apart(tmp_path)
    run = crane.simulate(machine, ValveSignals(machine, AT, LEVERS), duration=1.5, tolerance=1e-10)
    oil, energy = gaps(run, machine)
    assert oil < 1e-12
    assert energy < 1e-6
    assert np.ptp(run.q, axis=0).min() > 0.01
    account = crane.power_balance(machine, run)
    shafts = sum(x for name, x in account.powers.items() if name.endswith(".shaft"))
    others = sum(x for name, x in account.powers.items() if not name.endswith(".shaft"))
    np.testing.assert_allclose(others, shafts, atol=1e-9 * np.abs(shafts).max())


@pytest.mark.parametrize("own", [{}, {"dead_band": 0.1, "bandwidth": 40.0, "hysteresis": 0.02}])
def test_commanded_alike_they_are_one(tmp_path, own):
    """Whatever commands: signals, levers, PD; to 1e-7 of what moves."""
    (tmp_path / "one").mkdir(), (tmp_path / "two").mkdir()
    gains = {"kp": 20.0, "kd": 0.5}
    one = rig(tmp_path / "one", ORIFICE | own, control=gains)
    two = rig(tmp_path / "two", APART | own, control=gains)
    for command in (
        lambda machine: ValveSignals(machine, [0.0, 0.3, 0.5], {"x": [0.0, 0.6, -0.4]}),
        lambda machine: crane.joystick(machine, {"x": [(0.0, 0.0), (0.2, 0.5), (0.5, -0.5)]}),
        lambda machine: crane.ValvePD(machine, crane.via_points([0.0, 0.6], [[0.2], [0.3]])),
    ):
        a, b = (crane.simulate(x, command(x), duration=0.6, tolerance=1e-9) for x in (one, two))
        for name in ("pressure_x_a", "pressure_x_b", "spool_x"):
            scale = np.abs(a.channels[name]).max()
            np.testing.assert_allclose(a.channels[name], b.channels[name], atol=1e-6 * scale)
        np.testing.assert_allclose(b.channels["spool_x"], b.channels["spool_x_b"], atol=1e-9)


def test_levers_and_programs_move_the_second_spool_alone(tmp_path):
    machine = rig(tmp_path, ORIFICE | {"spool_b": OTHER})
    lever = {"x": [(0.0, 0.0), (0.2, 0.5)], "x_b": [(0.0, 0.0), (0.2, -0.25)]}
    run = crane.simulate(machine, crane.joystick(machine, lever), duration=0.3)
    assert run.channels["voltage_x"][-1] == pytest.approx(0.5)
    assert run.channels["voltage_x_b"][-1] == pytest.approx(1.0 - 4.0 * (0.1 + 0.9 * 0.25))
    alike = crane.simulate(machine, crane.joystick(machine, {"x": lever["x"]}), duration=0.3)
    assert alike.channels["voltage_x_b"][-1] == pytest.approx(1.0 + 4.0 * (0.1 + 0.9 * 0.5))
    program = crane.control.SampledCommand(lambda t, q, v, p: [0.3, 2.0], machine, period=0.01)
    run = crane.simulate(machine, program, duration=0.1)
    assert (run.channels["voltage_x"][-1], run.channels["voltage_x_b"][-1]) == (0.3, 2.0)
    short = crane.control.SampledCommand(lambda t, q, v, p: [0.3], machine, period=0.01)
    with pytest.raises(CraneError, match=r"the sample at t = 0 s .*x_b"):
        crane.simulate(machine, short, duration=0.1)


def test_a_task_of_levers_goes_with_its_joints(tmp_path):
    machine = everything_apart(tmp_path)
    text = (tmp_path / "rig.yaml").read_text()
    levers = "x: [0, 0, 1, 0.5], x_b: [0, 0, 1, 0.2], y: [0, 0, 1, -0.3]"
    text += f"\ntasks: {{lower: {{duration: 1, joystick: {{{levers}}}}}}}\n"
    (tmp_path / "rig.yaml").write_text(text)
    machine = crane.load(tmp_path / "rig.yaml")
    assert crane.joystick(machine, "lower").references(np.array([1.0]))[0, 1] == pytest.approx(0.2)
    locked = crane.load(tmp_path / "rig.yaml", lock={"x": 0.2})
    assert set(locked.tasks["lower"].levers) == {"y"}
    crane.simulate(locked, crane.joystick(locked, "lower"), duration=0.05)
    for path, what in ((tmp_path / "machine.png", "sketch"), (tmp_path / "run.png", "plot")):
        if what == "sketch":
            crane.view.sketch_circuit(machine, path)
        else:
            run = crane.simulate(machine, crane.joystick(machine, "lower"), duration=0.05)
            plot_result(run, path)
        assert path.stat().st_size > 1000


def test_a_recording_of_two_signals_is_replayed(tmp_path):
    machine = everything_apart(tmp_path)
    run = crane.simulate(machine, ValveSignals(machine, AT, LEVERS), duration=1.5)
    run.to_csv(tmp_path / "run.csv")
    again, _ = crane.replay(machine, tmp_path / "run.csv")
    np.testing.assert_allclose(again.q, run.q, atol=2e-4 * np.ptp(run.q))


def test_the_brake_lets_go_by_the_spool_that_goes_farther(tmp_path):
    machine = rig(tmp_path, APART, cylinder={"brake": 1e4, "brake_release": 0.2})
    for u, w, held in ((0.0, 0.0, 1e4), (0.1, 0.0, 5e3), (0.0, -0.15, 2.5e3), (0.1, 0.3, 0.0)):
        at, _ = now(machine, [u, w])
        assert at.circuit_friction[0] == pytest.approx(held, abs=1e-9)


def test_numbers_are_named_changed_written_and_read(tmp_path):
    given = ORIFICE | {"dead_band": 0.07, "delay": 0.02, "spool_b": OTHER}
    machine = rig(tmp_path, given)
    second = machine.hydraulics.valves["x"].spool_b
    assert second.delay == 0.02 and second.dead_band == 0.1  # as the first, unless it says so
    usual = circuit_of(machine).constants
    for name, value in OTHER.items():
        other = crane.load(tmp_path / "rig.yaml", {f"valve.x.spool_b.{name}": value + 0.1})
        changed = other.hydraulics.valves["x"].spool_b
        assert changed == dataclasses.replace(second, **{name: value + 0.1})
        assert 1 <= np.sum(circuit_of(other).constants != usual) <= 2, name
    notes = {"valve.x.spool_b.dead_band": "as measured"}
    path = crane.write_machine(machine, tmp_path / "written", notes=notes)
    assert "as measured" in path.read_text()
    assert crane.load(path).hydraulics == machine.hydraulics
    model = crane.linearize(machine, velocity={"x": 0.05})
    assert model.inputs == ("voltage_x", "voltage_x_b")
    assert np.abs(model.B[:, 1]).max() > 0


@pytest.mark.parametrize(
    ("valve", "joints", "said"),
    [
        ({"centre": 1e-6, "spool_b": {}}, ("x",), r"two spools and 'centre', which goes with one"),
        ({"regeneration": 1e-6, "spool_b": {}}, ("x",), "two spools and 'regeneration'"),
        (
            {"float_from": 0.8, "float_coefficient": 1e-6, "spool_b": {}}, ("x",),
            "two spools and 'float_from'",
        ),
        ({"spool_b": {"dead_band": 5}}, ("x",), "dead_band of the second spool of 'x' is 5, it "),
        ({"spool_b": {"full": 0.0}}, ("x",), "full and neutral of the second spool of 'x' are"),
        ({"spool_b": {"delay": -1.0}}, ("x",), r"'delay' .*-1"),
        ({"spool_b": {"c1": 1e-7}}, ("x",), "'c1'"),
        ({"spool_b": {}}, ("x", "x_b"), "is called as the joint 'x_b', give that another name"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(tmp_path, valve, joints, said):
    with pytest.raises(CraneError, match=said) as caught:
        rig(tmp_path, ORIFICE | valve, joints=joints)
    assert "rig.yaml:" in str(caught.value) and "\n" not in str(caught.value)


def test_what_knows_one_spool_alone_says_so(tmp_path):
    machine = rig(tmp_path, APART, control={"kp": 20.0, "kd": 0.5})
    reference = crane.via_points([0.0, 1.0], [[0.2], [0.3]])
    with pytest.raises(CraneError, match="'x' has a valve with two spools: take valve-pd"):
        crane.control.ValveFeedforward(machine, reference)
    run = crane.simulate(machine, crane.ValvePD(machine, reference), duration=0.1)
    with pytest.raises(CraneError, match="two spools, which this method does not separate"):
        crane.identification.identify_orifices(machine, [run], "x")
    with pytest.raises(CraneError, match="no valve for 'x_c'"):
        ValveSignals(machine, [0.0], {"x_c": [0.0]})
