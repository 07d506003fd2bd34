"""Underlapped spools, whose four edges are open around the middle."""

import numpy as np
import pytest
from full_circuit import gaps
from hydraulic_rig import COMPENSATED, HOSE, ORIFICE, STROKE, rig
from test_hydraulics import instant

import crane
from crane.common.errors import CraneError
from crane.control import ValveSignals
from crane.control.valve_commands import lever_signals
from crane.hydraulics.circuit_equations import CircuitEquations

D = 0.05  # underlap
SUPPLY, TANK, C = 9.25e6, 2e5, 5e-7
EQUAL = {"type": "orifice", "c1": C, "c2": C, "c3": C, "c4": C, "dead_band": -D}
SYMMETRIC = {"area_a": 5e-3, "area_b": 5e-3}


@pytest.mark.parametrize("u", [-1.0, -0.3, -0.04, 0.0, 0.02, D, 0.2])
def test_each_edge_opens_by_itself(tmp_path, u):
    """Bridge of four orifices of areas w (U +- x), w = c / (1 + U), as in Merritt's chapter 5."""
    machine = rig(tmp_path, ORIFICE | {"dead_band": -D}, supply={"tank": TANK})
    p_a, p_b = 6e6, 2.5e6
    _, now = instant(machine, (p_a, p_b), u)

    def area(x):
        return min(max((D + x) / (1 + D), 0.0), 1.0)

    c1, c2, c3, c4 = (ORIFICE[f"c{i}"] for i in (1, 2, 3, 4))
    q_a = c1 * area(u) * (SUPPLY - p_a) ** 0.5 - c3 * area(-u) * (p_a - TANK) ** 0.5
    q_b = c4 * area(-u) * (SUPPLY - p_b) ** 0.5 - c2 * area(u) * (p_b - TANK) ** 0.5
    found = [side.hose_flow for side in now.chambers[0]]
    np.testing.assert_allclose(found, [q_a, q_b], rtol=1e-12, atol=1e-18)
    drawn = sum(x.rate for x in now.flows if x.source == "supply")
    returned = sum(x.rate for x in now.flows if x.target == "tank" and x.path == "outlet")
    assert drawn - returned == pytest.approx(q_a + q_b, rel=1e-12, abs=1e-18)


@pytest.mark.parametrize("u", [-0.3, -0.04, 0.0, 0.02, 0.2])
def test_curves_may_begin_before_the_middle(tmp_path, u):
    """Straight curves from -U to 1 are the edges of the dead band -U."""
    curves = {f"c{i}": [[-D, 0.0], [1.0, ORIFICE[f"c{i}"]]] for i in (1, 2, 3, 4)}
    flows = []
    for name, valve in (("curves", curves), ("underlap", {"dead_band": -D})):
        (tmp_path / name).mkdir()
        machine = rig(tmp_path / name, ORIFICE | valve, supply={"tank": TANK})
        assert machine.hydraulics.valves["x"].is_underlapped
        _, now = instant(machine, (6e6, 2.5e6), u)
        flows.append([x.rate for x in now.flows if x.path in ("inlet", "outlet")])
    np.testing.assert_allclose(*flows, rtol=1e-12, atol=1e-18)


def test_in_the_middle_oil_leaks_from_the_supply_to_the_tank(tmp_path):
    """A piston at rest on equal edges: half of the pressure in each chamber, and the central flow
    2 c U / (1 + U) sqrt((p_S - p_T) / 2); all of its power is lost in the edges."""
    machine = rig(
        tmp_path, EQUAL, SYMMETRIC, {"tank": TANK}, axis="1 0 0", friction={"viscous": 3e4}
    )
    run = crane.simulate(machine, ValveSignals(machine, [0.0], {"x": [0.0]}), duration=2.5)
    for side in "ab":
        pressures = run.channels[f"pressure_x_{side}"]
        assert pressures[-1] == pytest.approx((SUPPLY + TANK) / 2, rel=1e-6)
    flow = np.gradient(run.channels["oil_pumped"], run.time)[-10]
    expected = 2 * C * D / (1 + D) * np.sqrt((SUPPLY - TANK) / 2)
    assert flow == pytest.approx(expected, rel=1e-6)
    losses = np.gradient(run.channels["hydraulic_loss"], run.time)[-10]
    assert losses == pytest.approx(expected * (SUPPLY - TANK), rel=1e-6)
    oil, energy = gaps(run, machine)
    assert oil < 1e-9 and energy < 1e-6


def test_the_pressure_gain_is_finite(tmp_path):
    """Merritt's null coefficients of an underlapped valve: pressure gain 2 (p_S - p_T) / U,
    flow gain 2 w sqrt((p_S - p_T) / 2), flow-pressure coefficient w U / sqrt(2 (p_S - p_T))."""
    machine = rig(tmp_path, EQUAL, SYMMETRIC, {"tank": TANK}, axis="1 0 0", mass=300.0)
    model = crane.linearize(machine)
    a, b = (model.states.index(f"pressure_x_{side}") for side in "ab")
    assert model.u[0] == pytest.approx(0.0, abs=1e-9)
    volume, modulus, w = HOSE + 5e-3 * 0.2, 1.2e9, C / (1 + D)
    drop = SUPPLY - TANK
    # V / B p_A' = K_q u - K_c p_A, with one chamber's share of the coefficients
    gain, loss = (model.B[a, 0], -model.A[a, a]) * np.array(volume / modulus)
    assert gain == pytest.approx(2 * w * np.sqrt(drop / 2), rel=1e-6)
    assert loss == pytest.approx(2 * w * D / np.sqrt(2 * drop), rel=1e-6)
    chambers = np.array([a, b])
    response = -np.linalg.solve(model.A[np.ix_(chambers, chambers)], model.B[chambers, 0])
    assert response[0] - response[1] == pytest.approx(2 * drop / D, rel=1e-6)


def test_a_load_is_trimmed_by_the_spool(tmp_path):
    """At rest the spool is off the middle by what the pressure gain asks for, not closed."""
    machine = rig(tmp_path, EQUAL, SYMMETRIC, {"tank": TANK}, mass=1000.0)
    model = crane.linearize(machine)
    p_a, p_b = (model.x[model.states.index(f"pressure_x_{side}")] for side in "ab")
    assert 5e-3 * (p_a - p_b) == pytest.approx(1000 * 9.81, rel=1e-9)
    u, drop = float(model.u[0]), SUPPLY - TANK
    share = (D + u) ** 2 / (2 * (D**2 + u**2))
    assert p_a == pytest.approx(TANK + drop * share, rel=1e-6)
    assert p_b == pytest.approx(TANK + drop * (1 - share), rel=1e-6)
    np.testing.assert_allclose(model.rate, 0.0, atol=1e-4)


def test_levers_brakes_and_centres_begin_in_the_middle(tmp_path):
    valve = ORIFICE | {"dead_band": -D, "centre": 2e-6}
    pump = {"control": "positive", "flow": 1e-3, "pressure": 2e7, "relief": 2.2e7}
    machine = rig(tmp_path, valve, {"brake": 5000.0, "brake_release": 0.1}, pump)
    part = machine.hydraulics.valves["x"]
    levers = np.array([-1.0, -0.1, 0.0, 0.1, 1.0])
    np.testing.assert_allclose(lever_signals(part, levers), levers)
    circuit = CircuitEquations(machine.hydraulics, [STROKE])
    for u, friction in ((0.0, 5000.0), (0.05, 2500.0), (-0.2, 0.0)):
        state = np.full(circuit.state_count, 1e6)
        now = circuit.evaluate(circuit.constants.tolist(), [0.2], [0.0], state.tolist(), [u], [])
        assert now.circuit_friction[0] == pytest.approx(friction)
        bypass = next(x.rate for x in now.flows if x.path == "bypass")
        assert bypass == pytest.approx(2e-6 * (1 - abs(u)) * np.sqrt(1e6 - TANK / 2), rel=0.2)


@pytest.mark.parametrize(
    "valve",
    [
        EQUAL | {"bandwidth": 60.0},
        COMPENSATED | {"dead_band": -D, "neutral": 0.0, "full": 1.0},
        EQUAL | {"type": "sharing"},
        EQUAL | {"spool_b": {"dead_band": 0.03}},
    ],
)
def test_oil_and_energy_balance(tmp_path, valve):
    pump = {"control": "load-sensing", "pressure": 2e7, "flow": 6e-4, "margin": 2e6, "tank": TANK}
    machine = rig(
        tmp_path, valve, supply=pump, joints=("x", "y"), valves={"y": {"dead_band": 0.1}}
    )
    signals = ValveSignals(
        machine, [0.0, 0.1, 0.3, 0.5], {"x": [0.0, 0.02, 0.3, -0.1], "y": [0.0, 0.0, 0.4, 0.0]}
    )
    run = crane.simulate(machine, signals, duration=0.6, step=2e-3, tolerance=1e-8)
    oil, energy = gaps(run, machine)
    assert oil < 1e-9 and energy < 1e-6


def test_what_is_no_underlap_is_refused(tmp_path):
    for value, message in (
        (-5.0, "dead_band.*-5.*at least -1"),
        (-1.0, "dead_band of the valve of 'x' is -1, it must be above -1"),
        (1.5, "it must be below 1: looks like percent, write 0.015"),
    ):
        with pytest.raises(CraneError, match=message):
            rig(tmp_path, EQUAL | {"dead_band": value})
