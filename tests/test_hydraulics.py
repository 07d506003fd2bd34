"""Laws of the hydraulic components, each against a closed form."""

import numpy as np
import pytest
from hydraulic_rig import AREA_A, AREA_B, COMPENSATED, HOSE, ORIFICE, STROKE, rig
from scipy.integrate import quad, solve_ivp

import crane
from crane.control import ValveDrive, ValveSignals
from crane.hydraulics.circuit_equations import CircuitEquations
from crane.hydraulics.flow_equations import (
    CHECK_VALVE_OPENING,
    LAMINAR_PRESSURE_DROP,
    forward_drop,
    series_coefficient,
    signed_square_root,
)

G = 9.81


def instant(machine, pressures, signal, x=0.2, v=0.0, extra=(), given=()):
    """The circuit of a one-cylinder machine at an instant."""
    hydraulics = machine.hydraulics
    circuit = CircuitEquations(hydraulics, [STROKE], bool(given))
    state = np.zeros(circuit.state_count)
    state[:2] = np.array(pressures) - hydraulics.oil.vapour_pressure
    state[2 : 2 + len(extra)] = extra
    found = circuit.evaluate(
        circuit.constants.tolist(), [x], [v], state.tolist(), [signal], list(given)
    )
    return circuit, found


def test_root_is_exact_beyond_laminar_flow_and_smooth_within():
    drops = np.concatenate([-np.logspace(4, 7, 40), np.logspace(4, 7, 40)])
    found = [signed_square_root(float(d)) for d in drops]
    np.testing.assert_allclose(found, np.sign(drops) * np.sqrt(np.abs(drops)), rtol=1e-14)
    h = 1e-4 * LAMINAR_PRESSURE_DROP
    inside = np.linspace(-1.2, 1.2, 97) * LAMINAR_PRESSURE_DROP
    slope = [
        (signed_square_root(float(d + h)) - signed_square_root(float(d - h))) / (2 * h)
        for d in inside
    ]
    assert min(slope) > 0
    assert max(slope) == pytest.approx(1.25 / np.sqrt(LAMINAR_PRESSURE_DROP), rel=1e-6)
    assert np.abs(np.diff(slope)).max() < 0.03 * max(slope)  # no kink
    assert signed_square_root(0.0) == 0.0


def test_check_valves_open_smoothly_within_ten_pascals():
    drops = np.linspace(-2.0, 2.0, 4001) * CHECK_VALVE_OPENING
    found = np.array([forward_drop(float(d)) for d in drops])
    outside = (drops <= 0) | (drops >= CHECK_VALVE_OPENING)
    np.testing.assert_allclose(found[outside], np.maximum(drops, 0.0)[outside], rtol=1e-14)
    slope = np.diff(found) / np.diff(drops)
    assert slope[drops[1:] > 0].min() > 0
    assert np.abs(np.diff(slope)).max() < 0.005 * slope.max()  # no kink


@pytest.mark.parametrize("seed", range(20))
def test_orifices_and_pressures_follow_21_to_23(tmp_path, seed):
    """Written out again from the paper, with u of both signs."""
    rng = np.random.default_rng(seed)
    machine = rig(tmp_path, ORIFICE, supply={"tank": 2e5})
    p_a, p_b = rng.uniform(3e5, 9e6, 2)
    u, x, v = rng.uniform(-1, 1), rng.uniform(0, STROKE), rng.uniform(-0.2, 0.2)
    _, now = instant(machine, (p_a, p_b), u, x, v)
    p_s, p_r, beta = 9.25e6, 2e5, 1.2e9
    if u >= 0:
        q_a, q_b = 4e-7 * u * np.sqrt(p_s - p_a), -5e-7 * u * np.sqrt(p_b - p_r)
    else:
        q_a, q_b = 6e-7 * u * np.sqrt(p_a - p_r), -7e-7 * u * np.sqrt(p_s - p_b)
    rate_a = beta / (HOSE + AREA_A * x) * (q_a - AREA_A * v)
    rate_b = beta / (HOSE + AREA_B * (STROKE - x)) * (q_b + AREA_B * v)
    np.testing.assert_allclose(now.state_rates[:2], [rate_a, rate_b], rtol=1e-12)
    assert now.forces[0] == pytest.approx(AREA_A * p_a - AREA_B * p_b, rel=1e-14)


def test_volumes_follow_the_stroke_not_the_coordinate(tmp_path):
    """A joint whose limits begin at 0.82, like a pin-to-pin length."""
    machine = rig(tmp_path, lower=0.82)
    recording = crane.simulate(machine, duration=0.01)
    x = recording.q[0, 0] - 0.82
    circuit = CircuitEquations(machine.hydraulics, [STROKE])
    state = np.zeros(circuit.state_count)
    now = circuit.evaluate(circuit.constants.tolist(), [x], [0.0], state.tolist(), [0.0], [])
    a, b = now.chambers[0]
    assert a.volume == pytest.approx(HOSE + AREA_A * 0.2, rel=1e-12)
    assert b.volume == pytest.approx(HOSE + AREA_B * (STROKE - 0.2), rel=1e-12)


@pytest.mark.parametrize(
    ("signal", "share"), [(5.0, (0.8 / 3 - 0.1143) / 0.8857), (2.8, 1.0), (1.0, 1.0)]
)
def test_compensated_flow_follows_the_spool_alone(tmp_path, signal, share):
    machine = rig(tmp_path, COMPENSATED)
    for p_a in (1e6, 5e6, 8.5e6):
        _, now = instant(machine, (p_a, 1e6), signal)
        assert now.chambers[0][0].hose_flow == pytest.approx(share * 40 / 6e4, rel=1e-12)


def test_compensation_is_lost_where_the_supply_falls_short(tmp_path):
    """15.119 l/min per root of bar at full stroke; nothing flows back into the supply."""
    machine = rig(tmp_path, COMPENSATED)
    for missing in (5e5, 1e5):
        _, now = instant(machine, (9.25e6 - missing, 1e6), 2.8)
        published = 15.119 / 6e4 * np.sqrt(missing / 1e5)
        assert now.chambers[0][0].hose_flow == pytest.approx(published, rel=1e-4)
    _, now = instant(machine, (1.5e7, 1e6), 2.8)
    assert now.chambers[0][0].hose_flow == 0.0


def test_nothing_flows_within_the_dead_band(tmp_path):
    machine = rig(tmp_path, COMPENSATED)
    for u in (-0.1142, -0.05, 0.0, 0.1142):
        _, now = instant(machine, (5e6, 1e6), 5.8 - 3 * u)
        assert [side.hose_flow for side in now.chambers[0]] == [0.0, 0.0]


def test_modulus_of_oil_hoses_and_steel(tmp_path):
    """1/K = 1/B_oil + (A s / V) / B_steel + (V_h / V) / B_hose."""
    oil = {"bulk_modulus": 1.65e9, "hose_modulus": 0.7e9, "steel_modulus": 2.1e11}
    machine = rig(tmp_path, oil=oil)
    for x in (0.01, 0.3, 0.5):
        _, now = instant(machine, (5e6, 1e6), 0.0, x, 0.1)
        volume = HOSE + AREA_A * x
        modulus = 1 / (1 / 1.65e9 + AREA_A * x / volume / 2.1e11 + HOSE / volume / 0.7e9)
        assert now.state_rates[0] == pytest.approx(-modulus / volume * AREA_A * 0.1, rel=1e-12)


def test_entrapped_gas_is_polytropic(tmp_path):
    """Volume taken from a chamber from p1 to p2: oil's and the bubble's."""
    machine = rig(tmp_path, cylinder={"gas_a": 2e-5})
    circuit = CircuitEquations(machine.hydraulics, [STROKE])

    def softness(p):
        _, now = instant(machine, (p, 1e6), 0.0, 0.2, 0.1)
        return -AREA_A * 0.1 / now.state_rates[0]

    volume = quad(softness, 2e5, 6e6, epsabs=0, epsrel=1e-10, limit=200)[0]
    bubble = 2e-5 * ((1e5 / 2e5) ** (1 / 1.4) - (1e5 / 6e6) ** (1 / 1.4))
    oil = (HOSE + AREA_A * 0.2) * (6e6 - 2e5) / 1.2e9
    assert volume == pytest.approx(bubble + oil, rel=1e-9)
    assert circuit.stiff_state_count == 2


def test_leaks_relief_and_suction_are_what_they_say(tmp_path):
    machine = rig(
        tmp_path,
        cylinder={
            "leakage": 1e-13, "leakage_a": 2e-13, "leakage_b": 3e-13,
            "relief": 8e6, "relief_gain": 1e-9, "refill": 2e-6,
        },
    )  # fmt: skip
    tank = 1e5
    _, now = instant(machine, (9e6, 4e6), 0.0)
    a, b = now.chambers[0]
    assert a.net_inflow == pytest.approx(
        -1e-13 * 5e6 - 2e-13 * (9e6 - tank) - 1e-9 * 1e6, rel=1e-12
    )
    assert b.net_inflow == pytest.approx(1e-13 * 5e6 - 3e-13 * (4e6 - tank), rel=1e-12)
    _, now = instant(machine, (5e4, tank), 0.0)
    leak = 1e-13 * (tank - 5e4) + 2e-13 * (tank - 5e4)
    assert now.chambers[0][0].net_inflow == pytest.approx(leak + 2e-6 * np.sqrt(5e4), rel=1e-12)


def test_series_of_throttles_adds_pressure_drops():
    for flow in (1e-5, 3e-4):
        coefficients = 4e-7, 9e-8, 2e-7
        drop = sum((flow / c) ** 2 for c in coefficients)
        total = series_coefficient(coefficients[0], coefficients[1], coefficients[2] ** -2)
        assert total * np.sqrt(drop) == pytest.approx(flow, rel=1e-12)
    assert series_coefficient(0.0, 0.0, 1e12) == 0.0


def test_counterbalance_holds_until_it_is_piloted(tmp_path):
    """Outflow only from p + ratio p_other = pressure on; inflow always."""
    holding = {"pressure": 1.2e7, "pilot_ratio": 4.0, "range": 2e6, "coefficient": 3e-7}
    machine = rig(tmp_path, cylinder={"counterbalance_a": holding})
    free = rig(tmp_path)
    for p_b, opening in ((1e6, 0.0), (1.75e6, 0.0), (2.0e6, 0.5), (2.25e6, 1.0), (5e6, 1.0)):
        _, now = instant(machine, (5e6, p_b), -0.5)
        c = series_coefficient(0.5 * 6e-7, 3e-7 * opening, 0.0)
        expected = -c * np.sqrt(5e6 - 1e5)
        assert now.chambers[0][0].hose_flow == pytest.approx(expected, rel=1e-9, abs=1e-18)
    _, inward = instant(machine, (5e6, 1e6), 0.5)
    _, plain = instant(free, (5e6, 1e6), 0.5)
    assert inward.chambers[0][0].hose_flow == plain.chambers[0][0].hose_flow


def test_spool_is_a_second_order_system(tmp_path):
    """A ramp of 0.4 in 1 ms against the closed form, critically damped and underdamped."""
    w = 40.0

    def ramp(t, damping):
        t = np.maximum(t, 0.0)
        if damping == 1.0:
            return t - 2 / w + (t + 2 / w) * np.exp(-w * t)
        fast = w * np.sqrt(1 - damping**2)
        swing = 2 * damping / w * np.cos(fast * t)
        swing += (2 * damping**2 - 1) / fast * np.sin(fast * t)
        return t - 2 * damping / w + np.exp(-damping * w * t) * swing

    for damping in (1.0, 0.4):
        machine = rig(tmp_path, {**ORIFICE, "bandwidth": 40.0, "damping": damping})
        signals = ValveSignals(machine, [0.0, 0.1, 0.101, 1.0], {"x": [0.0, 0.0, 0.4, 0.4]})
        recording = crane.simulate(machine, signals, duration=0.5)
        t = recording.time - 0.1
        expected = 0.4 * (ramp(t, damping) - ramp(t - 1e-3, damping)) / 1e-3
        assert np.abs(recording.channels["spool_x"] - expected).max() < 1e-6


def test_spool_moves_no_faster_than_its_rate(tmp_path):
    machine = rig(tmp_path, {**ORIFICE, "bandwidth": 80.0, "rate": 2.0})
    signals = ValveSignals(machine, [0.0, 0.1, 0.1001, 1.0], {"x": [0.0, 0.0, 0.9, 0.9]})
    recording = crane.simulate(machine, signals, duration=1.0)
    spool = recording.channels["spool_x"]
    assert np.diff(spool).max() / 1e-3 == pytest.approx(2.0, rel=1e-6)
    assert spool.max() < 0.9 * 1.01
    assert spool[-1] == pytest.approx(0.9, abs=1e-6)


def test_closed_chambers_keep_their_oil(tmp_path):
    """With no flow (23) integrates to V e^(p / beta) = const, whatever the load does."""
    machine = rig(tmp_path)
    machine = machine.replace(friction={"x": crane.description.Friction(viscous=3000.0)})
    start = {"x": ((2000 * G + AREA_B * 4e6) / AREA_A, 4e6)}
    drive = ValveDrive(machine, ValveSignals(machine, [0.0], {}), start)
    recording = crane.simulate(machine, drive, ([0.25], [0.05]), duration=1.0)
    x = recording.q[:, 0]
    for side, volume in (("a", HOSE + AREA_A * x), ("b", HOSE + AREA_B * (STROKE - x))):
        mass = np.log(volume) + recording.channels[f"pressure_x_{side}"] / 1.2e9
        assert np.ptp(mass) < 1e-9
    assert np.ptp(x) > 1e-4  # it did swing


def test_a_void_is_as_large_as_what_was_pulled_and_fills_again(tmp_path):
    """A closed cylinder pulled out of itself: vapour, and back to where the void began."""
    machine = rig(tmp_path, mass=50.0, axis="1 0 0", supply={"tank": 2e5})
    pull = 9e3

    def force(t):
        return pull * np.sin(np.pi * np.clip(t, 0, 1)) ** 2

    machine = machine.replace(friction={"x": crane.description.Friction(viscous=2e4)})

    class Pulled(ValveDrive):
        """The load is pulled from outside."""

        def references(self, times):
            return np.column_stack([super().references(times), force(np.asarray(times))])

        def law(self, at):
            forces, rates = super().law(at)
            return [forces[0] + at.reference[-1]], rates

    drive = Pulled(machine, ValveSignals(machine, [0.0], {}), {"x": (2e5, 2e5 * AREA_A / AREA_B)})
    recording = crane.simulate(machine, drive, duration=3.0)
    p = recording.channels["pressure_x_a"]
    vapour = machine.hydraulics.oil.vapour_pressure
    assert p.min() == vapour
    gone = p <= vapour
    assert gone.sum() > 100
    first, last = np.flatnonzero(gone)[[0, -1]]
    # it comes out of the void where it went in: no oil was lost or made
    x = recording.q[:, 0]
    assert x[last] == pytest.approx(x[first], abs=5e-6)
    assert np.ptp(x[gone]) > 1e-4
    assert p[-1] == pytest.approx(p[0], rel=2e-2)


def test_cushion_brakes_before_the_end(tmp_path):
    """At full flow into the stop, with and without: the speed at the end."""
    speeds = {}
    for name, cushion in (("none", {}), ("some", {"cushion": 0.04, "cushion_coefficient": 5e-8})):
        machine = rig(tmp_path, COMPENSATED, cylinder=cushion, axis="1 0 0", supply={"flow": 1e-3})
        signals = ValveSignals(machine, [0.0, 0.1, 0.2], {"x": [5.8, 5.8, 2.8]})
        recording = crane.simulate(machine, signals, initial=[0.35], duration=4.0)
        x, v = recording.q[:, 0], recording.v[:, 0]
        at = np.argmax(x > STROKE - 5e-4)
        speeds[name] = v[at]
        assert v.max() == pytest.approx(40 / 6e4 / AREA_A, rel=0.15)
        assert x.max() < STROKE + 5e-3
        assert abs(v[-1]) < 1e-3
    assert speeds["some"] < 0.5 * speeds["none"]


def test_series_spring_gives_way_by_force_over_stiffness(tmp_path):
    machine = rig(tmp_path, cylinder={"stiffness": 5e6, "damping": 2e4})
    recording = crane.simulate(machine, duration=1.0)
    stiff = rig(tmp_path)
    assert crane.simulate(stiff, duration=1.0).q[-1] == pytest.approx(0.2, abs=1e-9)
    # at rest: the chamber's volume is that of the stroke and of what the spring gives way
    circuit = CircuitEquations(machine.hydraulics, [STROKE])
    weight = 2000 * G
    start = circuit.initial_state(np.array([weight]), {}, np.array([0.0]), 1e5)
    assert start[2] == pytest.approx(weight / 5e6, rel=1e-12)
    assert recording.q[-1] == pytest.approx(0.2, abs=1e-9)


def test_oil_balances_over_a_series_spring(tmp_path):
    """What the spring gives way is stored: the documented balance holds to rounding."""
    machine = rig(tmp_path, cylinder={"stiffness": 5e6, "damping": 2e4})
    signals = ValveSignals(machine, [0.0, 0.5, 1.0], {"x": [0.0, 0.8, 0.0]})
    recording = crane.simulate(machine, signals, duration=1.5)
    channels, x = recording.channels, recording.q[:, 0]
    swept = (AREA_A - AREA_B) * (x - x[0])
    gap = channels["oil_pumped"] - channels["oil_returned"] - channels["oil_stored"] - swept
    assert np.abs(gap).max() < 1e-12 * channels["oil_pumped"][-1]
    assert np.ptp(x) > 0.04


def test_no_void_is_measured(tmp_path):
    """A measured pressure below that of vapour is vapour's, as one at it is."""
    machine = rig(tmp_path)
    circuit = CircuitEquations(machine.hydraulics, [STROKE])
    none = np.array([0.0])
    start = circuit.initial_state(none, {"x": (0.0, 1e3)}, none, 1e5)
    np.testing.assert_array_equal(start[:2], [0.0, 0.0])


def test_a_machine_too_large_to_compile_is_integrated_by_scipy(tmp_path, monkeypatch):
    machine = rig(tmp_path, COMPENSATED)
    signals = ValveSignals(machine, [0.0, 0.01, 0.02], {"x": [5.8, 5.8, 5.0]})
    with monkeypatch.context() as patch:
        patch.setattr("crane.codegen.program.MAX_OPERATIONS", 300)
        large = crane.simulate(rig(tmp_path, COMPENSATED), signals, duration=0.1)
    whole = crane.simulate(machine, signals, duration=0.1)
    assert np.abs(large.q - whole.q).max() < 1e-7
    assert np.ptp(whole.q) > 5e-4


def test_against_an_independent_simulation(tmp_path):
    """The equations written out again and integrated by scipy to 1e-10."""
    machine = rig(tmp_path, ORIFICE, friction={"viscous": 800.0})
    times = np.linspace(0, 3, 31)
    wanted = 0.6 * np.sin(2 * np.pi * times / 1.5) * np.minimum(times, 1)
    recording = crane.simulate(machine, ValveSignals(machine, times, {"x": wanted}), duration=3.0)

    def rates(t, y):
        x, v, p_a, p_b = y
        u = np.interp(t, times, wanted)
        if u >= 0:
            q_a = 4e-7 * u * signed_square_root(9.25e6 - p_a)
            q_b = -5e-7 * u * signed_square_root(p_b - 1e5)
        else:
            q_a = 6e-7 * u * signed_square_root(p_a - 1e5)
            q_b = -7e-7 * u * signed_square_root(9.25e6 - p_b)
        force = AREA_A * p_a - AREA_B * p_b - 800 * v - 2000 * G
        return [
            v,
            force / 2000,
            1.2e9 / (HOSE + AREA_A * x) * (q_a - AREA_A * v),
            1.2e9 / (HOSE + AREA_B * (STROKE - x)) * (q_b + AREA_B * v),
        ]

    p_a = (2000 * G + AREA_B * 1e5) / AREA_A
    solution = solve_ivp(
        rates, (0, 3), [0.2, 0, p_a, 1e5], method="LSODA", t_eval=recording.time,
        rtol=1e-10, atol=1e-12, max_step=1e-2,
    )  # fmt: skip
    assert np.abs(recording.q[:, 0] - solution.y[0]).max() < 1e-7
    assert np.abs(recording.v[:, 0] - solution.y[1]).max() < 1e-5
    assert np.abs(recording.channels["pressure_x_a"] - solution.y[2]).max() < 1e3
    assert np.ptp(recording.q[:, 0]) > 0.03
