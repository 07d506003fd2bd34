"""Pumps with regulators, valves and components between nodes, each against a closed form."""

import numpy as np
import pytest
from circuit_state import flow, now
from full_circuit import gaps
from hydraulic_rig import AREA_A, AREA_B, HOSE, ORIFICE, rig
from scipy.optimize import brentq

import crane
from crane.control import ValveSignals
from crane.hydraulics.flow_equations import series_coefficient

TANK = 1e5
SENSING = {
    "control": "load-sensing", "pressure": 25e6, "flow": 2e-3, "margin": 2e6, "droop": 4e5,
    "standby": 2.5e6,
}  # fmt: skip
FIXED = {"control": "fixed", "pressure": 25e6, "flow": 1e-3, "relief": 20e6, "relief_gain": 1e-9}
SIMPLE = {**ORIFICE, "c1": 4e-7, "c2": 4e-7, "c3": 4e-7, "c4": 4e-7}
ENGINE = {"speed": 190.0, "torque": 400.0, "inertia": 2.0, "speed_droop": 10.0}


def moved(machine, signals, duration, initial=None, **options):
    """A recording with valves opened after 0.1 s, within a tenth of a second."""
    n = len(machine.active)
    initial = (
        [0.05 if np.isfinite(x) else 0.0 for x in machine.upper] if initial is None else initial
    )
    ramps = {joint: [0.0, 0.0, signal] for joint, signal in signals.items()}
    assert len(initial) == n
    return crane.simulate(
        machine, ValveSignals(machine, [0.0, 0.1, 0.2], ramps), initial, duration, **options
    )


# pumps


@pytest.mark.parametrize(
    ("u", "a", "b", "wanted"),
    [
        (0.5, 10e6, 1e6, 12e6), (-0.5, 10e6, 6e6, 8e6), (0.0, 10e6, 6e6, 2.5e6),
        (0.5, 24.5e6, 1e6, 25e6), (0.005, 10e6, 1e6, TANK + 0.5 * (10e6 - TANK) + 2e6),
    ],
)  # fmt: skip
def test_load_sensing_keeps_a_margin_above_the_open_valves(tmp_path, u, a, b, wanted):
    """(min(max(p_LS + margin, standby), cut-off) - p) / droop, within 0 and 1."""
    machine = rig(tmp_path, SIMPLE, supply=SENSING)
    for short, share in ((-1e5, 0.0), (1e5, 0.25), (3e5, 0.75), (5e5, 1.0)):
        at, _ = now(machine, [u], pressure_x_a=a, pressure_x_b=b, pressure_supply=wanted - short)
        assert at.pumps["supply"].share == pytest.approx(share, rel=1e-12, abs=1e-15)
        assert flow(at, "pump") == pytest.approx(2e-3 * share, rel=1e-12, abs=1e-18)


def test_load_sensing_while_a_cylinder_moves(tmp_path):
    """p_P = p_LS + margin - droop e where nothing changes any more; the pump rests at standby."""
    machine = rig(tmp_path, SIMPLE, supply=SENSING, axis="1 0 0", friction={"viscous": 2e5})
    run = moved(machine, {"x": 0.3}, 4.0)
    c, v = run.channels, run.v[-1, 0]
    assert c["pressure_supply"][0] == pytest.approx(2.5e6, rel=1e-4)
    share = AREA_A * v / 2e-3
    assert c["share_supply"][-1] == pytest.approx(share, rel=1e-6)
    p_a = c["pressure_x_a"][-1]
    assert c["pressure_supply"][-1] == pytest.approx(p_a + 2e6 - 4e5 * share, rel=1e-6)
    assert v == pytest.approx(0.3 * 4e-7 * np.sqrt(2e6 - 4e5 * share) / AREA_A, rel=1e-6)


def test_pressure_control_and_its_least_flow(tmp_path):
    supply = {"pressure": 20e6, "flow": 1e-3, "droop": 5e5, "least": 0.1}
    machine = rig(tmp_path, SIMPLE, supply=supply)
    for p, share in ((21e6, 0.1), (19.8e6, 0.4), (19e6, 1.0)):
        at, _ = now(machine, pressure_supply=p)
        assert at.pumps["supply"].share == pytest.approx(share, rel=1e-12)


def test_negative_control_by_open_centres_in_series(tmp_path):
    """1 / c^2 adds up, p_N - p_T is the last one's part of the drop, e = 1 - (p_N - p_T) / s."""
    supply = {
        "control": "negative", "pressure": 30e6, "flow": 4e-3, "signal": 3e6, "throttle": 2e-6,
        "relief": 32e6,
    }  # fmt: skip
    valve = {**SIMPLE, "centre": 6e-6}
    machine = rig(tmp_path, valve, supply=supply, joints=("x", "y"))
    for one, two, p in ((0.0, 0.0, 3e6), (0.4, 0.0, 5e6), (0.7, -0.5, 8e6), (1.0, 0.0, 20e6)):
        at, _ = now(machine, [one, two], pressure_supply=p)
        centres = [6e-6 * (1 - abs(u)) for u in (one, two)]
        q = 0.0
        if min(centres) > 0:
            q = np.sqrt((p - TANK) / (1 / 2e-6**2 + sum(1 / c**2 for c in centres)))
        assert flow(at, "bypass") == pytest.approx(q, rel=1e-9, abs=1e-16)
        share = np.clip(1 - (q / 2e-6) ** 2 / 3e6, 0, 1)
        assert at.pumps["supply"].share == pytest.approx(share, rel=1e-9, abs=1e-12)
    at, _ = now(machine, pressure_supply=29.97e6, pressure_x_a=1e6, signals=[1.0, 0.0])
    assert at.pumps["supply"].share == pytest.approx(0.15, rel=1e-9)  # cut off


def test_negative_control_with_all_valves_locked_sees_its_throttle(tmp_path):
    supply = {
        "control": "negative", "pressure": 30e6, "flow": 4e-3, "signal": 3e6, "throttle": 2e-6,
        "relief": 32e6,
    }  # fmt: skip
    valves = {"x": {"centre": 6e-6}, "y": {"supply": "second"}}
    machine = rig(
        tmp_path, SIMPLE, supply=supply, joints=("x", "y"), valves=valves,
        supplies={"second": {"pressure": 2e7}}, locked={"x": 0.1},
    )  # fmt: skip
    at, _ = now(machine, pressure_supply=2.1e6)
    assert flow(at, "bypass") == pytest.approx(2e-6 * np.sqrt(2e6), rel=1e-12)
    assert at.pumps["supply"].share == pytest.approx(1 / 3, rel=1e-12)


def test_centre_by_a_curve(tmp_path):
    valve = {**SIMPLE, "centre": [[0.0, 5e-6], [0.2, 4e-6], [0.6, 1e-6], [0.8, 0.0]]}
    machine = rig(tmp_path, valve, supply=FIXED)
    for u, c in ((0.0, 5e-6), (-0.1, 4.5e-6), (0.4, 2.5e-6), (-0.7, 5e-7), (0.9, 0.0)):
        at, _ = now(machine, [u], pressure_supply=9e6)
        expected = c * np.sqrt(9e6 - TANK)
        assert flow(at, "bypass") == pytest.approx(expected, rel=1e-9, abs=1e-16)


def test_positive_control_adds_demands_up(tmp_path):
    supply = {"control": "positive", "pressure": 30e6, "flow": 4e-3, "relief": 32e6, "least": 0.02}
    valves = {"x": {"demand": 0.8, "dead_band": 0.1}, "y": {"demand": 0.6}}
    machine = rig(tmp_path, SIMPLE, supply=supply, joints=("x", "y"), valves=valves)
    for one, two, share in ((0, 0, 0.02), (0.55, 0, 0.4), (-0.55, 0.5, 0.7), (1, 1, 1)):
        at, _ = now(machine, [one, two], pressure_supply=9e6)
        assert at.pumps["supply"].share == pytest.approx(share, rel=1e-12)


def test_fixed_pump_goes_over_its_relief(tmp_path):
    """p = relief + Q / gain at rest, and its line fills by B Q / V until then."""
    machine = rig(tmp_path, SIMPLE, supply=FIXED, axis="1 0 0")
    run = crane.simulate(machine, duration=1.0)
    p = run.channels["pressure_supply"]
    assert p[0] == pytest.approx(TANK, rel=1e-3)
    assert p[5] - p[0] == pytest.approx(1.2e9 * 1e-3 / 2e-3 * 5e-3, rel=1e-6)
    assert p[-1] == pytest.approx(20e6 + 1e-3 / 1e-9, rel=1e-9)


def test_power_is_a_hyperbola_with_a_corner(tmp_path):
    supply = SENSING | {"power": 2e4, "pressure": 40e6}
    machine = rig(tmp_path, SIMPLE, supply=supply)
    for above in (5e6, 9.9e6, 1e7, 1.01e7, 2e7, 3e7):
        p = TANK + above
        at, _ = now(machine, [1.0], pressure_x_a=p, pressure_supply=p)
        expected = min(1.0, 2e4 / (2e-3 * above))
        assert at.pumps["supply"].share == pytest.approx(expected, rel=1e-12)
        if above >= 1e7:
            assert at.pumps["supply"].shaft_power == pytest.approx(2e4, rel=1e-12)


@pytest.mark.parametrize("powers", [(3e4, 3e4), (4e4, 1e4)])
def test_summed_power_of_two_pumps_is_never_exceeded(tmp_path, powers):
    own = SENSING | {"pressure": 60e6, "summed": ["supply", "second"]}
    valves = {"y": {"supply": "second"}}
    machine = rig(
        tmp_path, SIMPLE, supply=own | {"power": powers[0]}, joints=("x", "y"), valves=valves,
        supplies={"second": own | {"power": powers[1], "flow": 3e-3}},
    )  # fmt: skip
    rng, at_limit, most = np.random.default_rng(1), 0, sum(powers)
    for one, two in TANK + rng.uniform(0, 35e6, (300, 2)):
        at, _ = now(
            machine, [1.0, 1.0], pressure_supply=one, pressure_second=two, pressure_x_a=one,
            pressure_y_a=two,
        )  # fmt: skip
        taken = at.pumps["supply"].shaft_power + at.pumps["second"].shaft_power
        assert taken <= most * (1 + 1e-12)
        if max(pump.share for pump in at.pumps.values()) < 1:
            assert taken == pytest.approx(most, rel=1e-12)
            at_limit += 1
    assert at_limit > 50


def test_displacement_follows_within_its_response(tmp_path):
    machine = rig(tmp_path, SIMPLE, supply=FIXED | {"response": 0.15}, axis="1 0 0")
    run = crane.simulate(machine, duration=1.0)
    expected = 1 - np.exp(-run.time / 0.15)
    np.testing.assert_allclose(run.channels["share_supply"], expected, atol=1e-6)


def test_slip_friction_and_drag_of_a_pump(tmp_path):
    losses = {"slip": 2e-12, "friction": 0.06, "drag": 800.0}
    machine = rig(tmp_path, SIMPLE, supply=FIXED | losses, engine=ENGINE)
    at, rates = now(machine, pressure_supply=15e6, engine=0.97)
    above, n = 15e6 - TANK, 0.97
    assert flow(at, "slip") == pytest.approx(2e-12 * above, rel=1e-12)
    line = 1.2e9 / 2e-3 * (1e-3 * n - 2e-12 * above)
    assert rates["pressure_supply"] == pytest.approx(line, rel=1e-12)
    shaft = 1e-3 * n * above * 1.06 + 800 * n**2
    assert at.pumps["supply"].shaft_power == pytest.approx(shaft, rel=1e-12)
    torque = min(400.0, 400 * (1 + 10 / 190 - n) * 190 / 10)
    slower = (torque - shaft / (n * 190)) / (2.0 * 190)
    assert rates["engine"] == pytest.approx(slower, rel=1e-12)


def test_engine_gives_way_under_load(tmp_path):
    """Its governor's line meets the pump's torque; it starts from speed + droop."""
    supply = FIXED | {"friction": 0.05, "drag": 500.0, "slip": 1e-12}
    machine = rig(tmp_path, SIMPLE, supply=supply, engine=ENGINE, axis="1 0 0")
    run = crane.simulate(machine, duration=6.0)
    w = run.channels["engine_speed"]

    def left(speed):
        n = speed / 190
        p = (1e-3 * n + 1e-9 * 20e6 + 1e-12 * TANK) / (1e-9 + 1e-12)
        return 400 * (200 - speed) / 10 - (1e-3 * (p - TANK) * 1.05 + 500 * n) / 190

    assert w[0] == pytest.approx(200, rel=1e-12)
    assert w[-1] == pytest.approx(brentq(left, 150, 200), rel=1e-8)
    assert 196 < w[-1] < 198


# valves


def test_flow_sharing_slows_all_by_one_share(tmp_path):
    """A pump that has too little: sharing keeps the ratio of flows, compensation does not."""
    flows = {}
    for kind in ("sharing", "compensated"):
        for most in (3e-3, 5e-4):
            valve = {
                "type": kind, "c1": 5e-7, "c2": 4e-7, "c3": 4e-7, "c4": 5e-7,
                "margin": 2e6 if kind == "compensated" else None,
            }  # fmt: skip
            machine = rig(
                tmp_path, {k: x for k, x in valve.items() if x is not None},
                supply=SENSING | {"flow": most, "margin": 2.5e6}, joints=("x", "y"),
                cylinders={"y": {"area_a": 2e-3, "area_b": 1e-3}}, axis="1 0 0",
                friction={"viscous": 2e5},
            )  # fmt: skip
            run = moved(machine, {"x": 0.6, "y": 0.3}, 3.0)
            c = run.channels
            flows[kind, most] = c["flow_x_a"][-1], c["flow_y_a"][-1]
            assert abs(c["pressure_x_a"][-1] - c["pressure_y_a"][-1]) > 1e6
    (x, y), (less_x, less_y) = flows["sharing", 3e-3], flows["sharing", 5e-4]
    assert x / y == pytest.approx(2.0, rel=1e-6)
    assert less_x / x == pytest.approx(less_y / y, rel=1e-6)
    assert less_x + less_y == pytest.approx(5e-4, rel=1e-6)
    assert less_x / x < 0.75
    (x, y), (less_x, less_y) = flows["compensated", 3e-3], flows["compensated", 5e-4]
    assert x == pytest.approx(0.6 * 5e-7 * np.sqrt(2e6), rel=1e-6)
    assert y == pytest.approx(0.3 * 5e-7 * np.sqrt(2e6), rel=1e-6)
    assert abs(less_x / x - less_y / y) > 0.3


def test_sharing_meters_by_the_pump_above_the_highest_load(tmp_path):
    valve = {**SIMPLE, "type": "sharing"}
    machine = rig(tmp_path, valve, supply=SENSING, joints=("x", "y"))
    at, _ = now(
        machine, [0.5, -0.25], pressure_x_a=12e6, pressure_y_b=4e6, pressure_supply=13e6
    )  # fmt: skip
    q = 4e-7 * np.sqrt(1e6)
    assert flow(at, "inlet", target="x.a") == pytest.approx(0.5 * q, rel=1e-12)
    assert flow(at, "inlet", target="y.b") == pytest.approx(0.25 * q, rel=1e-12)
    at, _ = now(machine, [0.5, 0.0], pressure_x_a=14e6, pressure_supply=13e6)
    assert flow(at, "inlet") == 0.0  # nothing comes back


POINTS = [[0.1, 0.0], [0.4, 1e-7], [1.0, 6e-7]]


@pytest.mark.parametrize("form", ["points", "flow", "area", "csv", "shape"])
def test_edges_by_curves(tmp_path, form):
    c1 = {
        "points": POINTS,
        "flow": {"flow": [[u, float(c * np.sqrt(5e5))] for u, c in POINTS], "drop": 5e5},
        "area": {"area": [[u, float(c / (0.7 * np.sqrt(2 / 870)))] for u, c in POINTS]},
        "csv": {"file": "edge.csv", "drop": 7e5},
        "shape": {"coefficient": 6e-7, "shape": [[u, c / 6e-7] for u, c in POINTS]},
    }[form]
    rows = "".join(f"{u}, {float(c * np.sqrt(7e5))!r}\n" for u, c in POINTS)
    (tmp_path / "edge.csv").write_text("u, flow\n" + rows)
    machine = rig(tmp_path, {**SIMPLE, "c1": c1, "c4": [[0.25, 0.0], [1.0, 4e-7]]})
    for u, c in ((0.05, 0), (0.1, 0), (0.25, 5e-8), (0.4, 1e-7), (0.7, 3.5e-7), (1, 6e-7)):
        at, _ = now(machine, [u], pressure_x_a=3e6)
        expected = c * np.sqrt(9.25e6 - 3e6)
        assert flow(at, "inlet", target="x.a") == pytest.approx(expected, rel=1e-12, abs=1e-22)
        assert flow(at, "inlet", target="x.b") == 0
    for u, c in ((-0.2, 0.0), (-0.5, 4e-7 / 3), (-1.0, 4e-7)):  # another dead band that way
        at, _ = now(machine, [u], pressure_x_b=3e6)
        expected = c * np.sqrt(9.25e6 - 3e6)
        assert flow(at, "inlet", target="x.b") == pytest.approx(expected, rel=1e-12, abs=1e-22)


def test_regeneration_outward_is_as_fast_as_the_rods_area(tmp_path):
    """v = Q / (A_a - A_b) when all that leaves B goes to A."""
    valve = {
        "type": "compensated", "margin": 7e5, "c1": 1e-4 / 7e5**0.5, "c2": 1e-12, "c3": 4e-7,
        "c4": 4e-7, "regeneration": 2e-6,
    }  # fmt: skip
    machine = rig(tmp_path, valve, axis="1 0 0", friction={"viscous": 2e4})
    run = moved(machine, {"x": 1.0}, 4.0)
    lost = 1e-12 * np.sqrt(run.channels["pressure_x_b"][-1] - TANK)
    expected = (1e-4 - lost) / (AREA_A - AREA_B)
    assert run.v[-1, 0] == pytest.approx(expected, rel=1e-6)
    a, b = (run.channels[f"pressure_x_{side}"][-1] for side in "ab")
    assert 2e-6 * np.sqrt(b - a) == pytest.approx(AREA_B * run.v[-1, 0], rel=1e-4)


def test_float_joins_both_chambers_to_the_tank(tmp_path):
    machine = rig(tmp_path, {**SIMPLE, "float_from": 0.8, "float_coefficient": 3e-6})
    for u, floats in ((-0.8, 0.0), (-0.9, 0.5), (-1.0, 1.0)):
        at, _ = now(machine, [u], pressure_x_a=2e6, pressure_x_b=6e4)
        a = (4e-7 * -u + 3e-6 * floats) * np.sqrt(2e6 - TANK)
        assert flow(at, "outlet", source="x.a") == pytest.approx(a, rel=1e-12)
        b = -3e-6 * floats * np.sqrt(TANK - 6e4)
        assert flow(at, "outlet", source="x.b") == pytest.approx(b, rel=1e-12, abs=1e-18)
        fed = 4e-7 * -u * (1 - floats) * np.sqrt(9.25e6 - 6e4)
        assert flow(at, "inlet") == pytest.approx(fed, rel=1e-12, abs=1e-18)
    at, _ = now(machine, [1.0], pressure_x_a=2e6, pressure_x_b=6e4)
    assert flow(at, "outlet", source="x.a") == 0


def test_a_floating_load_that_lands_is_followed(tmp_path):
    """A load that bounces on two empty chambers needs few steps per recorded row."""
    machine = rig(tmp_path, {**SIMPLE, "float_from": 0.8, "float_coefficient": 3e-6})
    with pytest.warns(crane.CraneWarning, match="beyond its stroke"):
        run = moved(machine, {"x": -1.0}, 1.2, initial=[0.5])
    oil, energy = gaps(run, machine)
    assert oil < 1e-12 and energy < 1e-6
    voids = run.channels["pressure_x_a"] <= 1e3
    assert voids.any() and not voids[-1000:].all()


def test_hysteresis_is_as_wide_as_it_says(tmp_path):
    """Signals up and down in 20 s each: the loop is h wide, and as much as its follower lags."""
    machine = rig(tmp_path, {**SIMPLE, "hysteresis": 0.06}, axis="1 0 0", supply={"pressure": 2e5})
    times = np.array([0.0, 10.0, 30.0, 50.0])
    wanted = np.array([0.0, 0.8, -0.8, 0.8])
    run = crane.simulate(
        machine, ValveSignals(machine, times, {"x": wanted}), duration=50.0, step=0.01
    )
    u, t = run.channels["spool_x"], run.time
    signal = np.interp(t, times, wanted)
    down, up = (t > 14) & (t < 29), (t > 34) & (t < 49)
    half = 0.03 + 0.08 / 500
    np.testing.assert_allclose(u[down], signal[down] + half, atol=1e-6)
    np.testing.assert_allclose(u[up], signal[up] - half, atol=1e-6)


def test_reliefs_across_and_hose_rupture_valves(tmp_path):
    machine = rig(
        tmp_path, SIMPLE,
        cylinder={"cross_relief": 5e6, "relief_gain": 1e-9, "rupture_a": 1e-4, "rupture_b": 2e-4},
    )  # fmt: skip
    for a, b, q in ((9e6, 3e6, 1e-3), (3e6, 9e6, -1e-3), (9e6, 4.1e6, 0.0)):
        at, _ = now(machine, pressure_x_a=a, pressure_x_b=b)
        both = flow(at, "cross", "x.a") - flow(at, "cross", "x.b")
        assert both == pytest.approx(q, rel=1e-9, abs=1e-18)
    at, _ = now(machine, [-1.0], pressure_x_a=9e6)
    assert flow(at, "outlet", "x.a") == 1e-4
    at, _ = now(machine, [-0.05], pressure_x_a=9e6)
    expected = 0.05 * 4e-7 * np.sqrt(9e6 - TANK)
    assert flow(at, "outlet", "x.a") == pytest.approx(expected, rel=1e-12)
    at, _ = now(machine, [1.0], pressure_x_a=3e7)  # back into the supply
    assert flow(at, "inlet", target="x.a") == -1e-4
    at, _ = now(machine, [1.0], pressure_x_a=3e6)  # inward it is no obstacle
    assert flow(at, "inlet", target="x.a") == pytest.approx(4e-7 * np.sqrt(6.25e6), rel=1e-12)


def test_load_holding_stands_in_the_way_of_float_and_regeneration(tmp_path):
    holding = {"pressure": 1.2e7, "pilot_ratio": 4.0, "range": 2e6, "coefficient": 3e-7}
    valve = {**SIMPLE, "float_from": 0.8, "float_coefficient": 3e-6, "regeneration": 1e-6}
    machine = rig(
        tmp_path, valve, cylinder={"counterbalance_a": holding, "counterbalance_b": holding}
    )
    at, _ = now(machine, [-1.0], pressure_x_a=5e6)
    assert flow(at, "outlet", "x.a") == 0.0
    at, _ = now(machine, [-1.0], pressure_x_a=12e6)
    opening = (12e6 + 4 * TANK - 1.2e7) / 2e6
    c = series_coefficient(3.4e-6, 3e-7 * opening, 0.0)
    assert flow(at, "outlet", "x.a") == pytest.approx(c * np.sqrt(12e6 - TANK), rel=1e-12)
    at, _ = now(machine, [1.0], pressure_x_a=2e5, pressure_x_b=5e6)
    assert flow(at, "regeneration") == 0.0
    at, _ = now(machine, [1.0], pressure_x_a=2.5e6, pressure_x_b=5e6)
    c = series_coefficient(1e-6, 3e-7, 0.0)
    assert flow(at, "regeneration") == 0.0 or flow(at, "regeneration") == pytest.approx(
        c * min(1.0, (5e6 + 1e7 - 1.2e7) / 2e6) * np.sqrt(2.5e6), rel=1e-12
    )


# elements and nodes


@pytest.mark.parametrize(
    ("element", "one", "two", "q"),
    [
        ({"type": "orifice", "coefficient": 2e-7}, 5e6, 1e6, 2e-7 * 2e3),
        ({"type": "orifice", "coefficient": 2e-7}, 1e6, 5e6, -2e-7 * 2e3),
        ({"type": "check", "coefficient": 2e-7, "pressure": 5e5}, 5e6, 1e6, 2e-7 * np.sqrt(3.5e6)),
        ({"type": "check", "coefficient": 2e-7, "pressure": 5e5}, 1.4e6, 1e6, 0.0),
        ({"type": "check", "coefficient": 2e-7}, 1e6, 5e6, 0.0),
        ({"type": "relief", "gain": 1e-9, "pressure": 3e6}, 5e6, 1e6, 1e-3),
        ({"type": "relief", "gain": 1e-9, "pressure": 3e6}, 3.9e6, 1e6, 0.0),
        ({"type": "leak", "gain": 1e-12}, 5e6, 1e6, 4e-6),
        ({"type": "leak", "gain": 1e-12}, 1e6, 5e6, -4e-6),
    ],
)
def test_elements_between_nodes(tmp_path, element, one, two, q):
    machine = rig(
        tmp_path, SIMPLE, lines={"m": {"volume": 1e-3}},
        elements={"e": {"from": "m", "to": "x.a"} | element},
    )  # fmt: skip
    at, rates = now(machine, pressure_m=one, pressure_x_a=two)
    assert flow(at, "e") == pytest.approx(q, rel=1e-12, abs=1e-20)
    assert rates["pressure_m"] == pytest.approx(-1.2e9 / 1e-3 * q, rel=1e-12, abs=1e-9)
    expected = 1.2e9 / (HOSE + AREA_A * 0.2) * q
    assert rates["pressure_x_a"] == pytest.approx(expected, rel=1e-12, abs=1e-6)


def test_elements_that_valves_open(tmp_path):
    element = {"from": "supply", "to": "tank", "type": "orifice", "coefficient": 1e-7}
    for side, shares in (("both", (0.5, 0.5)), ("out", (0.5, 0.25)), ("back", (0.0, 0.5))):
        machine = rig(
            tmp_path, SIMPLE, joints=("x", "y"),
            elements={"e": element | {"joints": ["x", "y"], "side": side}},
        )  # fmt: skip
        for signals, share in zip(((0.5, 0.25), (-0.5, 0.25)), shares, strict=True):
            at, _ = now(machine, signals)
            expected = 1e-7 * share * np.sqrt(9.25e6 - TANK)
            assert flow(at, "e") == pytest.approx(expected, rel=1e-12, abs=1e-20)


@pytest.mark.parametrize("first", [None, "x", "y"])
def test_a_valve_of_priority_is_served_first(tmp_path, first):
    """Two functions ask for twice what the pump has; x has the lower load."""
    valve = {"type": "compensated", "flow": 6e-4, "margin": 1e6, "dead_band": 0.0}
    valves = {first: {"priority": True}} if first else {}
    machine = rig(
        tmp_path, valve, supply={"pressure": 20e6, "flow": 6e-4, "droop": 2e5}, joints=("x", "y"),
        axis="1 0 0", friction={"viscous": 1e5}, valves=valves,
    )  # fmt: skip
    assert [x.priority for x in machine.hydraulics.valves.values()] == [first == x for x in "xy"]
    assert (
        crane.load(crane.write_machine(machine, tmp_path / "written")).hydraulics
        == machine.hydraulics
    )
    loads = [crane.Wrench("load_y", (-3e4, 0, 0))]
    signals = crane.control.ValveSignals(machine, [0.0, 4.0], {"x": [1.0, 1.0], "y": [1.0, 1.0]})
    run = crane.simulate(machine, signals, [0.05, 0.05], duration=2.0, step=5e-3, loads=loads)
    flows = np.array([run.channels[f"flow_{joint}_a"][-1] for joint in "xy"])
    assert flows.sum() == pytest.approx(6e-4, rel=1e-3)
    supply = run.channels["pressure_supply"][-1]
    if first is None:
        assert flows[0] > 1.5 * flows[1]
        return
    own, other = flows if first == "x" else flows[::-1]
    load = run.channels[f"pressure_{first}_a"][-1]
    assert own == pytest.approx(6e-4 * np.sqrt(min((supply - load) / 1e6, 1.0)), rel=1e-6)
    assert own > 0.88 * 6e-4 and other < 0.12 * 6e-4


def test_a_second_pump_doubles_the_speed(tmp_path):
    """Confluence, a check valve that the boom's spool opens."""
    speeds = []
    both = {"from": "second", "to": "supply", "type": "check", "coefficient": 1e-6,
            "joints": ["x"]}  # fmt: skip
    for more in ({"both": both | {"side": "back"}}, {"both": both | {"side": "out"}}):
        pump = {"pressure": 20e6, "flow": 2e-4}
        valve = {**SIMPLE, "c1": 2e-6, "c2": 2e-6}
        machine = rig(
            tmp_path, valve, supply=pump, supplies={"second": pump}, elements=more, axis="1 0 0",
            friction={"viscous": 1e5},
        )  # fmt: skip
        run = moved(machine, {"x": 1.0}, 5.0)
        speeds.append(run.v[-1, 0])
    assert speeds[0] == pytest.approx(2e-4 / AREA_A, rel=1e-6)
    assert speeds[1] == pytest.approx(4e-4 / AREA_A, rel=1e-6)


GAS = {"volume": 1e-3, "precharge": 5e6, "line": 1e-5}
FILL = {"from": "supply", "to": "gas", "type": "orifice", "coefficient": 1e-7}


@pytest.mark.parametrize("exponent", [1.0, 1.25, 1.4])
def test_accumulator_without_heat_is_polytropic(tmp_path, exponent):
    machine = rig(
        tmp_path, SIMPLE, supply={"pressure": 20e6}, elements={"fill": FILL}, axis="1 0 0",
        accumulators={"gas": GAS | {"exponent": exponent}},
    )  # fmt: skip
    run = crane.simulate(machine, duration=3.0, tolerance=1e-10)
    p, oil = run.channels["pressure_gas"], run.channels["oil_pumped"]
    volume = 1e-3 - (oil - 1e-5 * (p - p[0]) / 1.2e9)
    np.testing.assert_allclose(p * volume**exponent, 5e6 * 1e-3**exponent, rtol=1e-7)
    assert p[-1] > 15e6


def test_accumulator_gives_its_heat_away(tmp_path):
    """Filled fast it is adiabatic; then its pressure decays to p0 V0 / V within T."""
    gas = GAS | {"time_constant": 4.0, "line": 1e-9}
    machine = rig(
        tmp_path, SIMPLE, supply={"pressure": 16e6}, axis="1 0 0", accumulators={"gas": gas},
        elements={"fill": FILL | {"coefficient": 3e-5, "joints": ["x"]}},
    )  # fmt: skip
    times = [0.0, 0.1, 0.11, 0.13, 0.14]
    signals = ValveSignals(machine, times, {"x": [0, 0, 1.0, 1.0, 0.0]})
    run = crane.simulate(machine, signals, duration=30.0, step=0.01)
    p, t, pumped = run.channels["pressure_gas"], run.time, run.channels["oil_pumped"]
    begun = np.searchsorted(t, 0.2)
    adiabatic = 1e-3 * (5e6 / p[begun]) ** (1 / 1.4)
    isothermal = p[-1]
    decay = np.exp(-(t[begun:] - t[begun]) / 4.0)
    expected = isothermal + (p[begun] - isothermal) * (decay - decay[-1]) / (1 - decay[-1])
    np.testing.assert_allclose(p[begun:], expected, rtol=1e-6)
    assert 5e6 * 1e-3 / isothermal == pytest.approx(adiabatic, rel=1e-2)
    assert np.ptp(pumped[begun:]) == 0 and p[begun] > 1.2 * isothermal


@pytest.mark.parametrize("more", [{}, {"time_constant": 2.0}])
def test_accumulator_runs_empty_and_fills_again(tmp_path, more):
    """Below its precharge only its port's oil gives way, and the gas is what it was."""
    machine = rig(
        tmp_path, SIMPLE, supply={"pressure": 16e6}, axis="1 0 0",
        accumulators={"gas": GAS | {"pressure": 7e6, "line": 1e-3} | more},
        elements={
            "fill": FILL | {"coefficient": 1e-6, "joints": ["x"], "side": "out"},
            "leak": {"from": "gas", "to": "tank", "type": "leak", "gain": 4e-11},
        },
    )  # fmt: skip
    signals = ValveSignals(machine, [0.0, 2.5, 2.6, 3.5], {"x": [0.0, 0.0, 1.0, 1.0]})
    run = crane.simulate(machine, signals, duration=3.5)
    p = run.channels["pressure_gas"]
    assert p.min() < 2e5 and p[-1] > 10e6
    c = run.channels
    gap = c["oil_pumped"] - c["oil_returned"] - c["oil_stored"]
    swept = (AREA_A - AREA_B) * (run.q[:, 0] - run.q[0, 0])
    assert np.abs(gap - swept).max() < 1e-12 * c["oil_pumped"][-1]
    # empty: p' = -gain (p - p_T) B / line
    low = np.flatnonzero((p < 3.5e6) & (run.time < 2.5))
    decay = np.exp(-4e-11 * 1.2e9 / 1e-3 * (run.time[low] - run.time[low[0]]))
    expected = TANK + (p[low[0]] - TANK) * decay
    np.testing.assert_allclose(p[low], expected, rtol=1e-5)


@pytest.mark.parametrize("p", [1e5, 1e6, 5e6, 2e7])
def test_free_air_softens_the_oil(tmp_path, p):
    """1 / K = 1 / B + x / (n p0) (p0 / p)^(1 + 1/n), in chambers, lines and the pump's line."""
    machine = rig(
        tmp_path, SIMPLE, oil={"air": 0.02, "steel_modulus": 2e11}, supply=FIXED,
        lines={"m": {"volume": 1e-3}},
        elements={"leak": {"from": "m", "to": "tank", "type": "leak", "gain": 1e-12}},
    )  # fmt: skip
    at, rates = now(machine, v=0.1, pressure_x_a=p, pressure_m=p, pressure_supply=p)
    soft = 1 / 1.2e9 + 0.02 / (1.4 * 1e5) * (1e5 / p) ** (1 + 1 / 1.4)
    pump = 1e-3 - 0.0
    expected = pump / (2e-3 * soft)
    assert rates["pressure_supply"] == pytest.approx(expected, rel=1e-12)
    q = -flow(at, "leak", source="m")
    assert rates["pressure_m"] == pytest.approx(q / (1e-3 * soft), rel=1e-12, abs=1e-9)
    volume = HOSE + AREA_A * 0.2
    wall = AREA_A * 0.2 / volume / 2e11
    expected = -AREA_A * 0.1 / (volume * (soft + wall))
    assert rates["pressure_x_a"] == pytest.approx(expected, rel=1e-12)


# motors


def test_motor_turns_by_its_flow_and_pulls_by_its_pressure(tmp_path):
    """w = Q / (D gear), M = (p_A - p_B) D gear, on and on."""
    motors = {"x": {"displacement": 2e-5, "gear": 20.0, "volume": 2e-4}}
    valve = {"type": "compensated", "flow": 6e-4, "margin": 7e5}
    machine = rig(tmp_path, valve, motors=motors, friction={"viscous": 900.0}, inertia=100.0)
    run = moved(machine, {"x": 1.0}, 8.0)
    w = 6e-4 / (2e-5 * 20)
    assert run.v[-1, 0] == pytest.approx(w, rel=1e-6)
    assert run.q[-1, 0] > 2 * np.pi
    c = run.channels
    across = c["pressure_x_a"][-1] - c["pressure_x_b"][-1]
    assert across * 2e-5 * 20 == pytest.approx(900 * w, rel=1e-6)
    assert c["flow_x_a"][-1] == pytest.approx(-c["flow_x_b"][-1], rel=1e-6)
