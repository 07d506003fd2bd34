"""The full-size crane on its hydraulics: balances, convergence, control and output."""

import numpy as np
import pytest

import crane
from crane.control import SampledCommand, TipVelocity, ValveDrive, ValvePD, ValveSignals, joystick
from crane.hydraulics.circuit_states import BALANCE_UNITS
from crane.motion.task_trajectories import task_trajectory

LOAD = {"payload.mass": 211.4}
LIFT = 1  # column of X_lift


@pytest.fixture(scope="module")
def loaded():
    return crane.load("patu655", changes=LOAD)


def lifting(machine, volts=5.0):
    return ValveSignals(machine, [0.0, 1.0, 1.1], {"X_lift": [5.8, 5.8, volts]})


def change(recording, name):
    return recording.channels[name][-1] - recording.channels[name][0]


def swept(machine, recording):
    """What the cylinders' volumes have grown by [m3]."""
    total = 0.0
    for joint, cylinder in machine.hydraulics.cylinders.items():
        x = recording.q[:, recording.joints.index(joint)]
        total += (cylinder.area_a - cylinder.area_b) * (x[-1] - x[0])
    return total


def check_balances(machine, recording, energy=1e-4):
    """Oil to 1e-9, energy to 1e-4 of what went through."""
    channels = recording.channels
    assert all(np.isfinite(values).all() for values in channels.values())
    assert np.isfinite(recording.q).all()
    oil = change(recording, "oil_pumped") - change(recording, "oil_returned")
    oil -= change(recording, "oil_stored") + swept(machine, recording)
    through = np.ptp(channels["oil_pumped"]) + np.ptp(channels["oil_returned"]) + 1e-9
    assert abs(oil) < 1e-9 * through
    hydraulic = change(recording, "pump_work") - change(recording, "work")
    hydraulic -= change(recording, "hydraulic_loss") + change(recording, "oil_energy")
    mechanical = change(recording, "work") - change(recording, "dissipated")
    mechanical -= change(recording, "kinetic") + change(recording, "potential")
    work = max(np.ptp(channels[name]) for name in ("pump_work", "work", "potential")) + 1e-6
    assert abs(hydraulic) < energy * work
    assert abs(mechanical) < energy * work
    assert (np.diff(channels["hydraulic_loss"]) > -1e-6).all()


def test_steady_lifting_is_the_published_speed(patu, loaded):
    """14.1 mm/s at 5.0 V; the valve's law says 14.6 on the piston's area.

    The boom rings on its spring, and sits up as its weight gets less: the rod goes beside it.
    """
    law = 40 / 6e4 * ((0.8 / 3 - 0.1143) / 0.8857) / 7.853981633974483e-3
    assert law == pytest.approx(14.1e-3, rel=0.04)
    for machine in (patu, loaded):
        recording = crane.simulate(machine, lifting(machine), duration=8.0)
        cylinder, channels = machine.hydraulics.cylinders["X_lift"], recording.channels
        force = cylinder.area_a * channels["pressure_X_lift_a"]
        force -= cylinder.area_b * channels["pressure_X_lift_b"]
        rod = recording.q[:, LIFT] + force / cylinder.stiffness  # but for the damper
        speed = (rod[-1] - rod[3000]) / (recording.time[-1] - recording.time[3000])
        # what is missing leaks, and is pressed together
        assert speed == pytest.approx(law, rel=3e-3)
        assert speed <= law
        check_balances(machine, recording)


def test_holding_pressure_is_the_published_one(patu, loaded):
    """66 bar at rest near level with the load, about half of it without."""
    empty, full = (
        crane.simulate(machine, duration=0.5).channels["pressure_X_lift_a"][0]
        for machine in (patu, loaded)
    )
    assert full == pytest.approx(66e5, rel=0.12)
    assert empty == pytest.approx(full / 2, rel=0.12)


def test_closed_valves_leak_by_the_law(loaded):
    """The lift cylinder sinks by leakage alone: x' = -k (p_A - p_R) / A_A."""
    recording = crane.simulate(loaded, duration=20.0)
    late = recording.time > 10.0
    x = recording.q[late, LIFT]
    sinking = np.polyfit(recording.time[late], x, 1)[0]
    cylinder = loaded.hydraulics.cylinders["X_lift"]
    p = recording.channels["pressure_X_lift_a"][late].mean()
    law = -cylinder.leakage_a * (p - 1e5) / cylinder.area_a
    assert sinking == pytest.approx(law, rel=1e-2)
    check_balances(loaded, recording)


def test_without_leakage_closed_valves_hold():
    none = {
        f"cylinder.{joint}.leakage_{side}": 0.0
        for joint in ("slew", "X_lift", "X_tilt", "X_ext")
        for side in "ab"
    }
    machine = crane.load("patu655", changes=LOAD | none)
    recording = crane.simulate(machine, duration=20.0)
    assert np.abs(recording.q - recording.q[0]).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("task", ["reach", pytest.param("swing", marks=pytest.mark.long)])
def test_halving_the_step_changes_nothing(task):
    """Where friction does not fall with speed, two motions side by side stay so."""
    even = {f"friction.{joint}.stiction": 0.0 for joint in ("X_lift", "X_tilt", "X_ext")}
    machine = crane.load("patu655", changes=LOAD | even)
    control = ValvePD(machine, task_trajectory(machine, task))
    whole = crane.simulate(machine, control)
    half = crane.simulate(machine, control, step=5e-4)
    assert np.abs(half.q[::2] - whole.q).max() < 1e-7


@pytest.mark.slow
@pytest.mark.long
def test_machine_code_agrees_with_scipy_on_pinocchio(patu):
    """Another method, another path of the dynamics, formulas in floats."""
    opening = ValveSignals(patu, [0.0, 0.1, 0.2], {"X_lift": [5.8, 5.8, 4.6]})
    fast = crane.simulate(patu, opening, duration=0.4, step=1e-2)
    slow = crane.simulate(patu, opening, duration=0.4, step=1e-2, backend="pinocchio")
    assert np.ptp(fast.q[:, LIFT]) > 3e-3
    assert np.abs(fast.q - slow.q).max() < 1e-7
    for joint in fast.joints:
        name = f"pressure_{joint}_a"
        assert np.abs(fast.channels[name] - slow.channels[name]).max() < 2e3
    assert set(fast.channels) == set(slow.channels)


@pytest.mark.slow
def test_a_minute_of_work_balances(loaded):
    """Every function, both ways, over 60 s: oil to 1e-9, energy to 1e-4 of the throughput."""
    levers = {
        "slew": [(0, 0), (2, 0.2), (8, 0.2), (9, -0.2), (15, -0.2), (16, 0), (60, 0)],
        "X_lift": [(0, 0), (10, 0), (11, 0.25), (20, 0.25), (21, -0.1), (40, -0.1), (41, 0)],
        "X_tilt": [(0, 0), (25, 0), (26, 0.2), (32, 0.2), (33, -0.2), (38, -0.2), (39, 0)],
        "X_ext": [(0, 0), (45, 0), (46, 0.3), (50, 0.3), (52, -0.3), (56, -0.3), (57, 0)],
    }
    recording = crane.simulate(loaded, joystick(loaded, levers), duration=60.0)
    check_balances(loaded, recording)
    assert set(BALANCE_UNITS) <= set(recording.channels)
    assert np.ptp(recording.channels["pump_work"]) > 5e4


def test_tip_velocity_is_the_commanded_one(loaded):
    """Outwards, then upwards, then sideways; open loop."""

    def wanted(t):
        def pulse(start):
            return np.clip((t - start) / 0.5, 0, 1) * np.clip((start + 3 - t) / 0.5, 0, 1)

        return np.array([0.25 * pulse(0.5), 0.15 * pulse(8.0), 0.15 * pulse(4.0)])

    recording = crane.simulate(loaded, TipVelocity(loaded, wanted), duration=12.0)
    tip = np.column_stack([recording.channels[f"tip_{axis}"] for axis in "xyz"])
    speed = np.gradient(tip, recording.time, axis=0)
    for at in (2.5, 6.0, 10.0):
        near = np.abs(recording.time - at) < 0.25
        assert np.abs(speed[near].mean(axis=0) - wanted(at)).max() < 0.03


def test_a_path_of_the_tip_serves_as_velocity(loaded):
    """Out and up along a line; a valve that is not needed stays where it is."""
    control = TipVelocity(loaded, task_trajectory(loaded, "push"))
    recording = crane.simulate(loaded, control)
    channels = recording.channels
    assert channels["spool_slew"][0] == 0.0
    gaps = [
        np.abs(channels[f"tip_{axis}"] - channels[f"reference_tip_{axis}"]).max() for axis in "xyz"
    ]
    assert gaps[0] < 0.06  # open loop: it lags, and nobody brings it back
    assert gaps[1] < 1e-3
    assert gaps[2] < 0.06


def test_a_program_sees_what_the_machine_does(patu):
    """The user's own control unit, called once per period with posture and pressures."""
    calls = []

    def program(time, q_a, v_a, pressures):
        calls.append((time, q_a.copy(), pressures.copy()))
        return [5.8, 5.0 if q_a[LIFT] < 0.13 else 5.8, 5.8, 5.8]

    recording = crane.simulate(patu, SampledCommand(program, patu, period=0.02), duration=3.0)
    assert [t for t, _, _ in calls] == pytest.approx(0.02 * np.arange(150))
    t, q_a, pressures = calls[50]
    at = round(t * 1000)
    np.testing.assert_array_equal(q_a, recording.q[at])
    assert pressures[LIFT, 0] == recording.channels["pressure_X_lift_a"][at]
    assert recording.q[-1, LIFT] == pytest.approx(0.13, abs=2e-3)


def test_a_program_starts_anew_in_each_simulation(patu):
    """Spools start at neutral in every simulation."""
    program = SampledCommand(lambda *_: [5.8, 5.0, 5.8, 5.8], patu)
    first, again = (crane.simulate(patu, program, duration=0.2) for _ in range(2))
    np.testing.assert_array_equal(first.q, again.q)
    assert again.channels["spool_X_lift"][0] == 0.0


@pytest.mark.parametrize("method", ["rk4", "BDF"])
def test_methods_that_call_no_program_are_refused(patu, method):
    program = SampledCommand(lambda *_: [5.8, 5.0, 5.8, 5.8], patu)
    with pytest.raises(crane.CraneError, match=f"'{method}' does not call the sampled program"):
        crane.simulate(patu, program, duration=0.1, method=method)


def test_circuit_follows_the_active_joints(patu):
    """Cylinders, valves and gains of joints that lose their drive are removed together."""
    left = patu.with_active_joints(["slew", "q2", "X_tilt", "X_ext"]).hydraulics
    for parts in (left.cylinders, left.valves, left.control):
        assert list(parts) == ["slew", "X_tilt", "X_ext"]


# What goes wrong on real machines


def test_a_pump_that_rests(loaded):
    """Compensators let nothing back: the boom stays up, the cylinder does not extend."""
    machine = crane.load("patu655", changes=LOAD | {"supply.pressure": 1.001e5})
    recording = crane.simulate(machine, lifting(machine), duration=3.0)
    check_balances(machine, recording)
    assert np.abs(recording.q - recording.q[0]).max() < 1e-3
    lowering = ValveSignals(machine, [0, 1, 1.2], {"X_lift": [5.8, 5.8, 6.6]})
    recording = crane.simulate(machine, lowering, duration=3.0)
    check_balances(machine, recording)
    assert recording.q[-1, LIFT] < recording.q[0, LIFT] - 0.01  # by its weight


def test_valve_stuck_open_runs_into_the_end_stop(loaded):
    stuck = ValveSignals(loaded, [0.0], {"X_lift": [2.8]})
    recording = crane.simulate(loaded, stuck, duration=15.0)
    check_balances(loaded, recording)
    upper = loaded.upper[LIFT]
    assert recording.q[-1, LIFT] == pytest.approx(upper, abs=3e-4)
    assert abs(recording.v[-1, LIFT]) < 1e-4
    # the compensator lets nothing back: what the jolt pressed together stays, but for leakage
    assert recording.channels["pressure_X_lift_a"][-1] > 0.99 * 9.25e6


@pytest.mark.parametrize(("lever", "duration"), [(1.0, 14.0), (-1.0, 9.0)])
def test_a_tonne_on_the_stops_moves_them_as_steel_gives_way(lever, duration):
    """The stop carries what the oil presses beyond weight and inertia: k d, up to half a mm.

    Rods creep as oil leaks, and stick and slip at it: their accelerations, some 1e-4 m/s2, are
    some newtons at the lift cylinder.
    """
    machine = crane.load("patu655", changes={"payload.mass": 1000.0})
    levers = joystick(machine, {"X_lift": [(0, 0), (0.5, lever), (duration, lever)]})
    recording = crane.simulate(machine, levers, duration=duration)
    check_balances(machine, recording)
    q = recording.q[:, LIFT]
    beyond = np.maximum(machine.lower[LIFT] - q, q - machine.upper[LIFT])
    (stop,) = (stop for stop in machine.end_stops if stop.joint == "X_lift")
    dynamics = crane.Dynamics(machine, backend="pinocchio")
    at, v, channels = -2, recording.v, recording.channels  # the last with one on either side
    acceleration = (v[at + 1] - v[at - 1]) / (recording.time[at + 1] - recording.time[at - 1])
    carried = dynamics.gravity(recording.q[at]) + dynamics.mass_matrix(recording.q[at]) @ (
        acceleration
    )
    cylinder = machine.hydraulics.cylinders["X_lift"]
    pressed = cylinder.area_a * channels["pressure_X_lift_a"][at]
    pressed -= cylinder.area_b * channels["pressure_X_lift_b"][at]
    inwards = 1.0 if q[at] < machine.lower[LIFT] else -1.0
    sinking = 1.0 - stop.damping * inwards * v[at, LIFT]  # as the oil leaks
    pushed = inwards * stop.stiffness * beyond[at] * sinking
    assert abs(pressed + pushed - carried[LIFT] - channels["friction_X_lift"][at]) < 0.5
    assert abs(channels["friction_X_lift"][-1]) < 300.1
    assert 5e-5 < beyond[-1] < 6e-4 and beyond.max() < 1.5e-3
    assert np.abs(recording.v[-1]).max() < 1e-3


def test_pressures_at_the_start_are_checked(patu):
    with pytest.raises(crane.CraneError, match=r"cannot be negative: add 1e5"):
        ValveDrive(patu, lifting(patu), {"X_lift": (-1e5, 1e5)})
    with pytest.raises(crane.CraneError, match="finite"):
        ValveDrive(patu, lifting(patu), {"X_lift": (np.nan, 1e5)})
    with pytest.raises(crane.CraneError, match="no cylinder at 'X_lfit'.*X_lift"):
        ValveDrive(patu, lifting(patu), {"X_lfit": (1e5, 1e5)})


def test_numbers_too_small_to_divide_by_are_refused():
    with pytest.raises(crane.CraneError, match="must be at least 1e-50"):
        crane.load("patu655", changes={"cylinder.X_lift.cushion_coefficient": 1e-200})


def test_a_cylinder_needs_limits(patu, monkeypatch):
    endless, upper = patu.with_active_joints(patu.active), patu.coordinates.upper.copy()
    upper[patu.column("slew")] = np.inf
    monkeypatch.setitem(vars(endless.coordinates), "upper", upper)
    with pytest.raises(crane.CraneError, match="'slew' has no limits, a cylinder needs"):
        endless.replace(hydraulics=patu.hydraulics)


def test_signals_that_cannot_be_are_refused(patu):
    with pytest.raises(crane.CraneError, match="no valve for 'q2'"):
        ValveSignals(patu, [0.0, 1.0], {"q2": [5.8, 5.8]})
    with pytest.raises(crane.CraneError, match="does not increase"):
        ValveSignals(patu, [0.0, 0.0], {"X_lift": [5.8, 5.8]})
    with pytest.raises(crane.CraneError, match="finite"):
        ValveSignals(patu, [0.0, 1.0], {"X_lift": [5.8, np.nan]})
    with pytest.raises(crane.CraneError, match="-1 to 1"):
        joystick(patu, {"X_lift": [(0, 1.5)]})
    for pairs in ([], [(0, 0), (1,)], [("a", "b")]):
        with pytest.raises(crane.CraneError, match="give pairs of time and position"):
            joystick(patu, {"X_lift": pairs})
    for pairs in ([(-2, 0), (-1, 1)], [(0, 0), (1e9, 1)]):
        with pytest.raises(crane.CraneError, match="give times up to 4000 s"):
            joystick(patu, {"X_lift": pairs})
    with pytest.raises(crane.CraneError, match="real numbers"):
        ValveSignals(patu, ["a", "b"], {})
    with pytest.raises(crane.CraneError, match=r"pressure of the tank is -50000 Pa"):
        ValveSignals(patu, [0.0], {}, tank=[-5e4])
    with pytest.raises(crane.CraneError, match="period"):
        crane.simulate(patu, SampledCommand(lambda *_: [5.8] * 4, patu, 0.0015), duration=0.1)
    with pytest.raises(crane.CraneError, match="has no valves"):
        ValvePD(crane.load("mini_forwarder"), None)
