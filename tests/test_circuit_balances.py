"""Oil and energy of whole circuits: bundled components, all methods, and random circuits."""

import numpy as np
import pytest
from full_circuit import SIGNALS, TIMES, everything, gaps
from hydraulic_rig import rig
from random_circuits import bounded

import crane
from crane.control import ValveSignals


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    machine = everything(tmp_path_factory.mktemp("whole"))
    signals = ValveSignals(machine, TIMES, SIGNALS)
    return machine, signals, crane.simulate(machine, signals, duration=3.0, tolerance=1e-10)


def test_oil_and_energy_balance(whole):
    machine, _, run = whole
    oil, energy = gaps(run, machine)
    assert oil < 1e-12
    assert energy < 1e-6
    c = run.channels
    assert np.ptp(run.q, axis=0).min() > 0.02
    for name in ("pressure_quick", "pressure_warm", "pressure_block", "pressure_return"):
        assert np.ptp(c[name]) > 1e4, name
    assert c["share_supply"].max() > 0.1 and np.ptp(c["share_second"]) > 0.5
    assert np.ptp(c["engine_speed"]) > 0.5


@pytest.mark.parametrize(
    ("method", "backend"),
    [
        pytest.param("Radau", "compiled", marks=(pytest.mark.slow, pytest.mark.long)),
        ("DOP853", "compiled"),
        pytest.param("LSODA", "pinocchio", marks=pytest.mark.slow),
    ],
)
def test_methods_agree_on_two_pumps_and_an_accumulator(tmp_path, method, backend):
    pump = {"control": "load-sensing", "pressure": 2e7, "flow": 6e-4, "margin": 2e6}
    machine = rig(
        tmp_path, supply=pump | {"response": 0.1}, supplies={"second": pump},
        joints=("x", "y"), valves={"y": {"supply": "second"}},
        accumulators={"gas": {
            "volume": 1e-3, "precharge": 2e6, "pressure": 3e6, "time_constant": 2.0,
        }},
        elements={"throttle": {
            "from": "x.a", "to": "gas", "type": "orifice", "coefficient": 1e-7,
        }},
    )  # fmt: skip
    signals = ValveSignals(machine, [0.0, 0.05, 0.1], {"x": [0.0, 0.0, 0.4], "y": [0.0, 0.5, 0.5]})
    one, other = (
        crane.simulate(machine, signals, duration=0.16, tolerance=1e-10, **options)
        for options in ({}, {"method": method, "backend": backend})
    )
    assert np.abs(one.q - other.q).max() < 1e-6 * np.ptp(one.q)
    for name in ("x_a", "x_b", "y_a", "y_b", "supply", "second", "gas"):
        two = other.channels[f"pressure_{name}"]
        assert np.abs(one.channels[f"pressure_{name}"] - two).max() < 1e-6 * two.max(), name


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "backend", "tolerance"),
    [("Radau", "compiled", 1e-10), ("DOP853", "compiled", 1e-12), ("LSODA", "pinocchio", 1e-10)],
)
def test_other_methods_agree(whole, method, backend, tolerance):
    machine, signals, run = whole
    other = crane.simulate(
        machine, signals, duration=0.6, method=method, backend=backend, tolerance=tolerance
    )
    n = len(other.time)
    np.testing.assert_allclose(other.q, run.q[:n], atol=1e-6 * np.abs(run.q).max())
    for name in ("x_a", "x_b", "y_a", "z_a", "w_b", "supply", "second", "warm", "quick"):
        one, two = other.channels[f"pressure_{name}"], run.channels[f"pressure_{name}"][:n]
        assert np.abs(one - two).max() < 1e-6 * np.abs(two).max(), name


# --- random circuits ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "first", [0, *(pytest.param(x, marks=pytest.mark.long) for x in (10, 20, 30))]
)
def test_random_circuits_balance(first):
    """Oil and energy to 1e-6 of what went through, within a minute each."""
    found = [bounded(seed) for seed in range(first, first + 10)]
    assert not [one for one in found if one.bad]
    assert sum(one.what == "runs" for one in found) > 5
