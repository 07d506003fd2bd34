"""The bundled excavator against data sheets of its class, and the energy balance of its cycle."""

import numpy as np
import pytest
from scipy.optimize import minimize
from warned import without_a_word

import crane
from crane.studies.task_tipping_load import tipping_load

PRESSURE, BUCKET, ARM = 3.5e7, 1.1309734e-2, 1.5393804e-2  # [Pa], areas of the pistons [m2]
RADIUS = 1.47  # of the bucket's tip about its pin [m]


@pytest.fixture(scope="module")
def machine():
    return crane.load("excavator")


def farthest(machine, what):
    """The largest value of a function of the tip's place over all strokes."""
    ends = machine.model.upperPositionLimit[machine.closure.active][1:]
    kinematics, random = crane.Kinematics(machine), np.random.default_rng(0)

    def least(shares):
        return -what(kinematics.position(np.r_[0.0, np.clip(shares, 0, 1) * ends]))

    found = [
        minimize(least, random.uniform(0.2, 0.8, 3), method="Nelder-Mead", options={"xatol": 1e-6})
        for _ in range(6)
    ]
    return -min(one.fun for one in found)


@pytest.mark.parametrize(
    ("printed", "share", "what"),
    [
        (9.86, 0.01, lambda tip: tip[0] - 1e3 * tip[2] ** 2),  # reach at the ground
        (6.72, 0.02, lambda tip: -tip[2]),  # depth
        (9.37, 0.05, lambda tip: tip[2]),  # height
    ],
)
def test_it_reaches_as_far_as_data_sheets_say(machine, printed, share, what):
    assert farthest(machine, what) == pytest.approx(printed, rel=share)


def test_it_weighs_and_digs_as_data_sheets_say(machine):
    """Forces of full pressure in one cylinder at the tip, across its radius; without weights."""
    assert sum(x.mass for x in machine.model.inertias) == pytest.approx(21600, rel=0.02)
    strokes = np.linspace(0.001, 1.103, 400)
    home = machine.home[machine.closure.active]
    across = np.tile(home, (400, 1))
    across[:, 3] = strokes
    turn = machine.closure.gamma(machine.closure.solve(across))[:, machine.column("bucket"), 3]
    force = PRESSURE * BUCKET / (RADIUS * np.abs(turn))
    assert force.max() == pytest.approx(150e3, rel=0.07)
    best = home.copy()
    best[3] = strokes[force.argmax()]  # where the arm's force is defined, too
    tip, pin = (crane.Kinematics(machine, frame).position(best) for frame in (machine.tip, "arm"))
    radius = np.linalg.norm(tip - pin)
    along = np.tile(best, (400, 1))
    along[:, 2] = np.linspace(0.001, 1.503, 400)
    turn = machine.closure.gamma(machine.closure.solve(along))[:, machine.column("arm"), 2]
    assert (PRESSURE * ARM / (radius * np.abs(turn))).max() == pytest.approx(106e3, rel=0.02)


def test_a_cycle_ends_where_it_began_and_keeps_the_balance(machine):
    task = machine.tasks["dig"]
    under = machine.with_external_forces(*task.loads)
    levers = crane.joystick(machine, "dig")
    run = crane.simulate(under, levers, duration=task.duration, step=1e-2)
    seen = run.channels
    assert np.abs(run.q[-1] - run.q[0]).max() < 0.1
    assert np.ptp(run.q[:, 0]) == pytest.approx(np.pi / 2, abs=0.05)
    assert seen["depth_teeth"].max() > 0.1 and seen["stability"].min() > 0
    outside = [name for name in seen if name.startswith("work_")]
    assert {"work_teeth", "work_earth"} <= set(outside) and seen["work_teeth"][-1] < -1e4
    work = seen["work"] + sum(seen[name] for name in outside)
    stored = seen["kinetic"] + seen["potential"]
    gap = work - (stored - stored[0]) - seen["dissipated"]
    assert np.abs(gap).max() < 1e-6 * np.ptp(stored)


@pytest.mark.slow
def test_levers_tip_it_with_the_load_that_is_said(machine):
    """2 % less load leaves it on its tracks, 2 % more tips it; no warning is given."""
    found = without_a_word(tipping_load, machine, "dig")
    least = []
    for share in (0.98, 1.02):
        loaded = crane.load("excavator", {"payload.mass": share * found.mass})
        under = loaded.with_external_forces(*loaded.tasks["dig"].loads)
        run = crane.simulate(under, crane.joystick(loaded, "dig"), duration=16.0, step=5e-3)
        least.append(run.channels["stability"].min())
    assert least[0] > 0 > least[1] and 0 < found.mass < found.static_mass


@pytest.fixture(scope="module")
def cycles():
    """Cycles of digging: with the pump's pressure kept, with load sensing, with two pumps."""
    found = {}
    for name, changes in (
        ("excavator", {"supply.droop": 2e5}), ("excavator_ls", {}), ("excavator_two_pumps", {}),
    ):  # fmt: skip
        machine = crane.load(name, changes=changes)
        task = machine.tasks["dig"]
        found[name] = (
            machine,
            crane.simulate(
                machine.with_external_forces(*task.loads),
                crane.joystick(machine, "dig"),
                duration=16.0,
                step=1e-2,
            ),
        )
    return found


def shaft(run):
    return sum(run.channels[name] for name in run.channels if name.startswith("shaft_"))


def test_regulated_pumps_dig_with_less(cycles):
    """The same motion takes less work than with a constant supply pressure."""
    (_, kept), *others = cycles.values()
    work = np.trapezoid(shaft(kept), kept.time)
    assert shaft(kept).max() > 200e3  # [W], no engine of the class has that
    for _, run in others:
        assert np.abs(run.q - kept.q)[:, 1:].max() < 0.06
        assert np.trapezoid(shaft(run), run.time) < 0.85 * work
        assert shaft(run).max() < 140e3 and run.channels["engine_speed"].min() > 0.97 * 188.5


def test_regulated_circuits_balance(cycles):
    for machine, run in cycles.values():
        seen = run.channels
        gap = seen["pump_work"] - seen["work"] - seen["hydraulic_loss"] - seen["oil_energy"]
        assert np.abs(gap).max() < 1e-9 * seen["pump_work"][-1]
        swept = sum(
            (x.area_a - x.area_b) * (run.q[:, i] - run.q[0, i])
            for i, x in enumerate(machine.hydraulics.cylinders.values())
        )
        gap = seen["oil_pumped"] - seen["oil_returned"] - seen["oil_stored"] - swept
        assert np.abs(gap).max() < 1e-9 * seen["oil_pumped"][-1]


@pytest.fixture(scope="module")
def trucks():
    """Trucks loaded by hand and eye: every lever is held until its joint is there."""
    found = {}
    for name, changes in (
        ("excavator", {"supply.droop": 2e5}), ("excavator_ls", {}), ("excavator_two_pumps", {}),
    ):  # fmt: skip
        machine = crane.load(name, changes=changes)
        under = machine.with_external_forces(*machine.tasks["load_truck"].loads)
        levers = crane.joystick(under, "load_truck")
        found[name] = machine, crane.simulate(under, levers, step=1e-2)
    return found


@pytest.mark.slow
def test_trucks_are_loaded_by_positions(trucks):
    """Each phase ends at the sample at which the last of its joints passes; the cycle closes."""
    for machine, run in trucks.values():
        first, clock = 0, run.channels["phase"]
        for k, phase in enumerate(machine.tasks["load_truck"].phases):
            passed = []
            for joint, end in phase.until.items():
                q = run.q[first:, machine.active.index(joint)]
                passed.append(first + int((phase.levers[joint] * (q - end) >= 0).argmax()))
            # the clock is a look late
            assert clock[max(passed)] < k + 1 and clock[max(passed) + 1] >= k + 1, phase.name
            first = max(passed)
        assert np.abs(run.q[-1] - run.q[0]).max() < 0.1
        assert run.channels["depth_teeth"].max() > 0.3 and run.channels["stability"].min() > 0
        assert np.ptp(run.q[:, 0]) == pytest.approx(np.pi / 2, abs=0.15)


@pytest.mark.slow
def test_trucks_take_time_or_power(trucks):
    """A pump without a limit is the fastest one, by far more work; the account holds in all."""
    times, works = [], []
    for machine, run in trucks.values():
        account = crane.power_balance(machine, run)
        largest = max(np.abs(power).max() for power in account.powers.values())
        assert np.abs(account.residual).max() <= 1e-9 * largest
        seen = run.channels
        outside = sum(seen[name] for name in seen if name.startswith("work_"))
        stored = seen["kinetic"] + seen["potential"]
        gap = seen["work"] + outside - (stored - stored[0]) - seen["dissipated"]
        assert np.abs(gap).max() < 1e-6 * np.ptp(stored)
        times.append(run.time[-1])
        works.append(account.totals["shaft"])
    assert times[0] < min(times[1:]) - 0.3 and max(times) < 16.5
    assert works[0] > 1.5 * max(works[1:]) and works[1] > works[2]


SAVING = """extends: {base}
name: saving
hydraulics:
  accumulators:
    saver: {{volume: 0.02, precharge: 5.0e+6, exponent: 1.3}}
  elements:
    port: {{type: leak, from: saver, to: tank, gain: 1.0e-14}}
  valves:
    X_boom: {{return_a: saver}}
"""


def test_a_boom_that_is_lowered_fills_an_accumulator(tmp_path):
    """Up to what statics leaves: its pressure is below the cylinder's at every stroke."""
    path = tmp_path / "saving.yaml"
    path.write_text(SAVING.format(base=crane.load("excavator_ls").path))
    machine = crane.load(path)
    start = machine.home[machine.closure.active] + [0.0, 0.4, 0.0, 0.0]
    levers = {"X_boom": [(0, 0), (0.5, 0), (0.8, -0.5), (3.5, -0.5), (3.8, 0)]}
    run = crane.simulate(machine, crane.joystick(machine, levers), start, 5.0, step=5e-3)
    seen, gas = run.channels, machine.hydraulics.accumulators["saver"]
    ratio = seen["pressure_saver"] / gas.precharge
    n = gas.exponent
    energy = gas.precharge * gas.volume / (n - 1) * (ratio ** ((n - 1) / n) - 1)
    freed = -(seen["potential"][-1] - seen["potential"][0])
    moved = -(run.q[:, 1] - run.q[0, 1]) * machine.hydraulics.cylinders["X_boom"].area_a
    # oil that went in is oil that the pistons pressed out, but for what leaks and is pressed
    assert gas.volume * (1 - ratio[-1] ** (-1 / n)) == pytest.approx(moved[-1], rel=0.02)
    dynamics = crane.Dynamics(machine)
    hold = dynamics.gravity(run.q[[0, -1]])[:, 1]
    bound = hold.min() / machine.hydraulics.cylinders["X_boom"].area_a * moved[-1] / freed
    assert 0.3 < energy[-1] / freed < 1.1 * bound < 1.1
