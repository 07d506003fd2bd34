"""Transients of circuits against the same equations integrated by scipy to 1e-10."""

import numpy as np
import pytest
from hydraulic_rig import AREA_A, AREA_B, HOSE, STROKE, rig
from scipy.integrate import solve_ivp
from warned import quiet

import crane
from crane.control import ValveSignals
from crane.control.valve_commands import lever_signals

BULK, TANK, G = 1.2e9, 1e5, 9.81
C = 4e-7
VALVE = {"type": "orifice", "c1": C, "c2": C, "c3": C, "c4": C}
LINE = 2e-3 / BULK


def test_rounding_does_not_grow_from_step_to_step():
    """Chambers at the pressure of the tank, voids and levers that jump over dead bands."""
    machine, generator = crane.load("patu655"), np.random.default_rng(1)
    time, signals = np.arange(801) * 0.01, {}
    for name, spool in machine.hydraulics.spools.items():
        wanted = np.repeat(generator.choice([-1.0, -0.5, 0.0, 0.5, 1.0], 41), 50)[:801]
        lever = np.zeros(801)
        for i in range(1, 801):
            lever[i] = lever[i - 1] + np.clip(wanted[i] - lever[i - 1], -1 / 15, 1 / 15)
        signals[name] = lever_signals(spool, lever)
    start, command = machine.home[machine.closure.active], ValveSignals(machine, time, signals)
    runs = [
        quiet(crane.simulate, machine, command, initial=start * factor, duration=8.0, step=0.01).q
        for factor in (1.0, 1.0 + 1e-15, 1.0 - 1e-15)
    ]
    assert np.ptp(runs[0], axis=0).max() > 0.5
    for other in runs[1:]:  # 2e-10 with step sizes by the error alone and a kink in check valves
        np.testing.assert_allclose(other, runs[0], rtol=0, atol=1e-12)


def root(d):
    """sqrt beyond 1e4 Pa, an odd cubic of equal value and slope within."""
    s = min(max(d / 1e4, -1.0), 1.0)
    return 25 * s * (5 - s * s) if abs(s) < 1 else np.sign(d) * np.sqrt(abs(d))


def clip(x, low=0.0, high=1.0):
    return min(max(x, low), high)


def cylinder(
    x, v, a, b, q_a, q_b, mass=2000.0, viscous=300.0, weight=0.0, area_a=AREA_A, area_b=AREA_B
):  # noqa: E501
    """x', v', p_A', p_B'."""
    return [
        v,
        (area_a * a - area_b * b - viscous * v - weight) / mass,
        BULK / (HOSE + area_a * x) * (q_a - area_a * v),
        BULK / (HOSE + area_b * (STROKE - x)) * (q_b + area_b * v),
    ]


def orifices(u, p, a, b):
    """Flows into A and B."""
    if u >= 0:
        return C * u * root(p - a), -C * u * root(b - TANK)
    return C * u * root(a - TANK), -C * u * root(p - b)


def functions(joints):
    """Names of the states of cylinders."""
    return [
        name.format(joint)
        for joint in joints
        for name in ("{}", "{}.v", "pressure_{}_a", "pressure_{}_b")
    ]


def compare(
    machine, signals, rates, names, duration, times=None, initial=None, start=(), corners=None
):
    """Simulate both, and see that pressures and strokes agree to 1e-6.

    Args:
        machine: The machine.
        signals: Of the valves by joint, over times.
        rates: (t, y) -> y'.
        names: Of y: joints, JOINT.v, channels.
        duration: [s].
        times: Of the signals.
        initial: Of the machine.
        start: What of y at the start is no channel, by name.
        corners: Where signals turn as they arrive, if not at times.
    """
    control = ValveSignals(machine, times, signals)
    run = crane.simulate(machine, control, initial, duration, tolerance=1e-10)
    found = {}
    for i, joint in enumerate(machine.active):
        found[joint], found[f"{joint}.v"] = run.q[:, i], run.v[:, i]
    found |= run.channels
    begin = [dict(start)[name] if name in dict(start) else found[name][0] for name in names]
    edges = [0.0, *[t for t in corners or times if 0 < t < duration], duration]
    rows = []
    for one, two in zip(edges, edges[1:], strict=False):  # signals have corners there
        inside = run.time[(run.time >= one) & (run.time < two)]
        solved = solve_ivp(
            rates, (one, two), begin, "Radau", [*inside, two], rtol=1e-10, atol=1e-12
        )
        assert solved.success
        rows.append(solved.y[:, :-1] if two < duration else solved.y[:, :])
        begin = solved.y[:, -1]
    y = np.hstack(rows)[:, : len(run.time)]
    worst = {}
    for name, row in zip(names, y, strict=True):
        if name in found:
            here = found[name][: len(row)]
            worst[name] = np.abs(here - row).max() / np.abs(row).max()
            if name.startswith("pressure") or name in machine.active:
                assert worst[name] < 1e-6, worst
                assert np.ptp(row) > 1e-3 * np.abs(row).max(), name  # it moved
            else:
                assert worst[name] < 1e-5, worst
    return run


@pytest.mark.slow
def test_engine_with_two_pumps_of_summed_power(tmp_path):
    engine = {"speed": 190.0, "torque": 40.0, "inertia": 0.5, "speed_droop": 12.0}
    pump = {
        "control": "positive", "pressure": 25e6, "relief": 28e6, "flow": 9e-4, "droop": 1e6,
        "friction": 0.04, "drag": 300.0, "summed": ["supply", "second"], "least": 0.05,
        "response": 0.1,
    }  # fmt: skip
    powers = 5e3, 4e3
    machine = rig(
        tmp_path, VALVE | {"centre": 4e-7}, joints=("x", "y"), supply=pump | {"power": powers[0]},
        supplies={"second": pump | {"power": powers[1]}}, engine=engine,
        valves={"y": {"supply": "second", "demand": 0.7}}, axis="1 0 0",
        friction={"viscous": 6e5},
    )  # fmt: skip
    times = [0.0, 0.2, 0.5, 1.0, 1.3, 2.2]
    u = {"x": [0.0, 0.0, 0.8, 0.8, -0.4, -0.4], "y": [0.0, 0.3, 0.3, 0.9, 0.9, 0.0]}

    def rates(t, y):
        out, shares, torque, n = [], y[10:12], 0.0, y[12]
        mean = np.dot(powers, y[8:10]) / sum(powers)
        slopes, moves = [], []
        for i, joint in enumerate("xy"):
            s, p = np.interp(t, times, u[joint]), y[8 + i]
            x, v, a, b = y[4 * i : 4 * i + 4]
            q_a, q_b = orifices(s, p, a, b)
            out += cylinder(x, v, a, b, q_a, q_b, viscous=6e5)
            asked = min((1.0, 0.7)[i] * abs(s), (25e6 - p) / 1e6)
            asked = clip(min(asked, powers[i] / (9e-4 * max(mean - TANK, 1e4))), 0.05, 1.0)
            moves.append((asked - shares[i]) / 0.1)
            centre = 4e-7 * (1 - abs(s)) * root(p - TANK)
            relief = 1e-8 * max(p - 28e6, 0)
            given = shares[i] * 9e-4 * n
            drawn = q_a if s >= 0 else q_b
            slopes.append((given - centre - relief - drawn) / LINE)
            torque += (given / n * (p - TANK) * 1.04 + 300 * n) / 190
        governor = 40 * clip((190 + 12 - 190 * n) / 12)
        return [*out, *slopes, *moves, (governor - torque) / 0.5 / 190]

    names = [
        *functions("xy"),
        "pressure_supply", "pressure_second", "share_supply", "share_second", "n",
    ]  # fmt: skip
    run = compare(machine, u, rates, names, 2.2, times, [0.1, 0.1], start={"n": 202 / 190}.items())
    assert run.channels["engine_speed"].min() < 190  # it was felt
    power = run.channels["shaft_supply"] + run.channels["shaft_second"]
    assert power.max() > 0.7 * sum(powers)
