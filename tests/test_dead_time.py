"""Dead time of valves against closed forms of the spool and scipy."""

import numpy as np
import pytest
from hydraulic_rig import AREA_A, AREA_B, ORIFICE, rig
from test_circuit_transients import VALVE, G, compare, cylinder, orifices

import crane
from crane.common.errors import CraneError
from crane.control import ValveCommand, ValveSignals
from crane.control.control_law import ControllerInputs
from crane.identification.excitation.exchange_algorithm import PulseSignals

W = 40.0  # of a critically damped spool [rad/s]
LATE = 0.01337  # [s], no multiple of anything
QUICK = {"bandwidth": W, "damping": 1.0}
GAINS = {"kp": 20.0, "kd": 0.5}


def step(t):
    """What such a spool does t after a step of 1."""
    t = np.maximum(t, 0.0)
    return 1.0 - (1.0 + W * t) * np.exp(-W * t)


def ramp(t):
    """What it does t after the signal begins to rise by 1 per second."""
    t = np.maximum(t, 0.0)
    return t - 2.0 / W + (t + 2.0 / W) * np.exp(-W * t)


@pytest.mark.parametrize("late", [0.0, 0.01, LATE, 0.0005, 0.2])
def test_a_spool_follows_signals_that_are_given_in_time(tmp_path, late):
    """Polygons: a sum of ramps, each late by as much."""
    machine = rig(tmp_path, ORIFICE | QUICK | {"delay": late})
    times, values = [0.05, 0.1, 0.2, 0.25], [0.1, 0.1, 0.6, -0.3]
    run = crane.simulate(machine, ValveSignals(machine, times, {"x": values}), duration=0.4)
    slopes = np.concatenate([[0.0], np.diff(values) / np.diff(times), [0.0]])
    wanted = 0.1 + sum(
        turn * ramp(run.time - at - late)
        for at, turn in zip(times, np.diff(slopes), strict=True)
    )  # fmt: skip
    np.testing.assert_allclose(run.channels["spool_x"], wanted, atol=1e-7)
    commanded = np.interp(run.time, times, values)  # which a log has
    np.testing.assert_allclose(run.channels["voltage_x"], commanded, atol=1e-14)


@pytest.mark.parametrize("late", [0.003, LATE, 0.02])
def test_a_spool_follows_a_log_whose_samples_are_close(tmp_path, late):
    """No sample falls on a step: straight lines between these all the same."""
    machine = rig(tmp_path, ORIFICE | QUICK | {"delay": late})
    times = np.arange(0.0, 0.4, 0.005)
    values = 0.4 * np.sin(20.0 * times) + 0.1 * np.random.default_rng(3).uniform(-1, 1, len(times))
    run = crane.simulate(machine, ValveSignals(machine, times, {"x": values}), duration=0.35)
    slopes = np.concatenate([[0.0], np.diff(values) / np.diff(times), [0.0]])
    wanted = values[0] + sum(
        turn * ramp(run.time - at - late)
        for at, turn in zip(times, np.diff(slopes), strict=True)
    )  # fmt: skip
    np.testing.assert_allclose(run.channels["spool_x"], wanted, atol=1e-7)


@pytest.mark.parametrize("late", [0.0, 0.004, LATE, 0.02, 0.0231])
def test_a_spool_follows_a_program_that_holds_its_signals(tmp_path, late):
    """A sum of steps, of the period 10 ms; one after the other, with the first one before them."""
    machine = rig(tmp_path, ORIFICE | QUICK | {"delay": late})
    signals = 0.6 * np.sin(np.arange(31))
    program = crane.control.SampledCommand(
        lambda t, q, v, p: [signals[round(t / 0.01)]], machine, period=0.01
    )
    for _ in range(2):  # nothing is remembered of the first run
        run = crane.simulate(machine, program, duration=0.3)
        wanted = signals[0] * step(run.time)
        for k in range(1, 31):
            wanted += (signals[k] - signals[k - 1]) * step(run.time - 0.01 * k - late)
        np.testing.assert_allclose(run.channels["spool_x"], wanted, atol=1e-7)
        held = signals[((run.time + 1e-9) / 0.01).astype(int)]
        np.testing.assert_array_equal(run.channels["voltage_x"][:-1], held[:-1])


def test_a_cylinder_with_dead_time_beside_scipy(tmp_path):
    machine = rig(tmp_path, VALVE | {"delay": 0.0377, "bandwidth": 60.0})
    times, u = [0.0, 0.2, 0.3, 0.7, 0.8, 1.2], [0.0, 0.0, 0.5, 0.5, -0.3, -0.3]
    late = [t + 0.0377 for t in times]

    def rates(t, y):
        x, v, a, b, s, s1 = y
        q_a, q_b = orifices(s, 9.25e6, a, b)
        pull = 60.0**2 * (np.interp(t, late, u) - s) - 2 * 60.0 * s1
        return [*cylinder(x, v, a, b, q_a, q_b, weight=2000 * G), s1, pull]

    names = ["x", "x.v", "pressure_x_a", "pressure_x_b", "spool_x", "ds"]
    compare(
        machine, {"x": u}, rates, names, 1.2, times, start={"ds": 0.0}.items(), corners=late,
    )  # fmt: skip


def test_a_law_is_asked_each_millisecond_and_held(tmp_path):
    """PD over dead time is the program that a control unit runs, written out."""
    machine = rig(tmp_path, ORIFICE | QUICK | {"delay": LATE}, control=GAINS)
    reference = crane.via_points([0.0, 0.4], [[0.2], [0.25]])
    one = crane.simulate(machine, crane.ValvePD(machine, reference))

    def unit(t, q, v, pressures):
        q_ref, v_ref, _ = reference(t)
        return 20.0 * (q_ref - q) + 0.5 * (v_ref - v)

    program = crane.control.SampledCommand(unit, machine, period=1e-3)
    two = crane.simulate(machine, program, duration=0.4)
    np.testing.assert_allclose(one.q, two.q, atol=1e-9)
    np.testing.assert_allclose(one.channels["voltage_x"], two.channels["voltage_x"], atol=1e-6)
    with pytest.raises(CraneError, match="period 0.001 s of the sampled program is no whole num"):
        crane.simulate(machine, crane.ValvePD(machine, reference), step=2e-3)


@pytest.mark.slow
def test_a_loop_with_too_much_dead_time_swings(tmp_path):
    """x' = k e(t - d) is stable for k d < pi / 2 alone: a quick valve, a rigid drive."""
    swings = {}
    loops = [200.0 * 4e-7 * np.sqrt(7e5) / area for area in (AREA_A, AREA_B)]  # out, in [1/s]
    assert max(loops) * 0.05 < np.pi / 2 < min(loops) * 0.35
    for late in (0.05, 0.35):
        machine = rig(
            tmp_path, VALVE | {"type": "compensated", "margin": 7e5, "delay": late},
            axis="1 0 0", mass=20.0, friction={"viscous": 3e4}, control={"kp": 200.0, "kd": 0.0},
        )  # fmt: skip
        reference = crane.via_points([0.0, 4.0], [[0.25], [0.27]])
        run = crane.simulate(machine, crane.ValvePD(machine, reference), [0.25], 4.0)
        swings[late] = np.ptp((run.q[:, 0] - run.channels["reference_x"])[-1000:])
    assert swings[0.05] < 2e-3
    assert swings[0.35] > 2e-2


def test_a_recording_is_replayed_with_its_dead_time(tmp_path):
    machine = rig(tmp_path, ORIFICE | QUICK | {"delay": LATE})
    signals = ValveSignals(machine, [0.1, 0.2, 0.4], {"x": [0.0, 0.5, -0.5]})
    run = crane.simulate(machine, signals, duration=0.6)
    run.to_csv(tmp_path / "run.csv")
    again, _ = crane.replay(machine, tmp_path / "run.csv")
    np.testing.assert_allclose(again.q, run.q, atol=1e-5 * np.ptp(run.q))
    account = crane.power_balance(machine, run)
    shafts = account.powers["supply.shaft"]
    others = sum(x for name, x in account.powers.items() if not name.endswith("shaft"))
    np.testing.assert_allclose(others, shafts, atol=1e-9 * np.abs(shafts).max())


def test_how_a_motion_changes_with_dead_time(tmp_path):
    """Sensitivities are differences of simulations; a gradient leaves it to them."""
    machine = rig(tmp_path, ORIFICE | QUICK | {"delay": LATE})
    time = np.linspace(0.0, 0.5, 51)

    def control(machine):
        return ValveSignals(machine, time, {"x": 0.4 * np.sin(10 * time)})

    found = crane.sensitivities(
        machine, control(machine), duration=0.5, parameters=["valve.x.delay"], outputs=["x"]
    )
    ends = []
    for late in (LATE - 1e-4, LATE + 1e-4):
        other = crane.load(tmp_path / "rig.yaml", {"valve.x.delay": late})
        ends.append(crane.simulate(other, control(other), duration=0.5, tolerance=1e-10).q[:, 0])
    slope = (ends[1] - ends[0]) / 2e-4
    np.testing.assert_allclose(found.derivatives[:, 0, 0], slope, atol=2e-3 * np.abs(slope).max())
    weights = np.ones((501, 1))
    with pytest.raises(CraneError, match="changes when signals arrive, which a gradient takes"):
        crane.simulation.gradient(machine, control(machine), functional=weights, duration=0.5,
                       parameters=["valve.x.delay"], outputs=["x"])  # fmt: skip


def test_what_cannot_be_is_refused_in_one_line(tmp_path):
    with pytest.raises(CraneError, match=r"rig.yaml:\d+: .*'delay' .* -0.1"):
        rig(tmp_path, ORIFICE | {"delay": -0.1})
    with pytest.warns(crane.CraneWarning, match="'delay' .* is 20 s, .*looks like ms"):
        rig(tmp_path, ORIFICE | {"delay": 20})
    machine = rig(tmp_path, ORIFICE | {"delay": 0.02}, control=GAINS)
    reference = crane.via_points([0.0, 0.4], [[0.2], [0.25]])
    with pytest.raises(CraneError, match="a controller in Python has no formulas"):
        crane.sensitivities(machine, crane.ValvePD(machine, reference), parameters=["valve.x.c1"])
    with pytest.raises(CraneError, match="runs on the compiled backend alone"):
        crane.simulate(machine, crane.ValvePD(machine, reference), backend="pinocchio")

    class Law(ValveCommand):
        has_measured_pressures = True

        def references(self, times):
            return np.full((len(times), 2), 1e6)

        def signals(self, at: ControllerInputs):
            return [0.1 * at.q_a[0]]

    with pytest.raises(CraneError, match="Law has measured pressures and is no function of time"):
        crane.simulate(machine, Law(), duration=0.1)
    at_once = rig(tmp_path, ORIFICE, control=GAINS)
    with pytest.raises(CraneError, match="has no derivative at a delay of 0"):
        crane.sensitivities(
            at_once, crane.ValvePD(at_once, reference), parameters=["valve.x.delay"]
        )


def test_pulses_that_meet_the_machine_arrive_late(tmp_path):
    """The spool follows the signal of one delay ago, also for past periods."""
    machine = rig(tmp_path, ORIFICE | {"delay": 0.137})
    plan = np.array([[[0.6, 1.0]], [[-0.5, 0.7]], [[0.3, 1.0]]])
    pulses = PulseSignals(machine, plan, 0.2, 8.0, machine.lower, machine.upper, np.inf)
    run = crane.simulate(machine, pulses, duration=1.0)
    signal = run.channels["voltage_x"]
    assert signal.max() > 0.2 and signal.min() < -0.2
    late = np.interp(run.time - 0.137, run.time, signal)
    np.testing.assert_allclose(run.channels["spool_x"], late, atol=1e-6)
