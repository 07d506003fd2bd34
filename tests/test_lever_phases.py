"""Phases of lever tasks that end when joints reach a value."""

import numpy as np
import pytest
import yaml
from command_line import typed
from hydraulic_rig import rig

import crane
from crane.formats import write_machine

SPRINGY = {"type": "orifice", "c1": 4e-7, "c2": 5e-7, "c3": 6e-7, "c4": 7e-7, "dead_band": 0.1}
OUT = {"name": "out", "levers": {"x": 0.6, "y": 0.3}, "until": {"x": 0.32, "y": 0.3}, "within": 5}
BACK = {"name": "back", "levers": {"x": -0.2}, "until": {"x": 0.22}, "within": 5}
LOOK, RAMP, EARTH = 0.01, 0.2, 2000.0


def task(*phases, **more):
    return {"description": "there and back", "ramp": RAMP, "phases": list(phases)} | more


def described(folder, **tasks):
    """The rig with two cylinders, and tasks."""
    rig(folder, SPRINGY, joints=("x", "y"), supply={"pressure": 1.2e7}, mass=500.0)
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"tasks": tasks}))
    return path


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    earth = {"frame": "load_x", "name": "earth", "phases": [0, 1, 1.5, 2],
             "force": [[0, 0, 0], [0, 0, -EARTH], [0, 0, -EARTH], [0, 0, 0]]}  # fmt: skip
    both = task(OUT, BACK, loads=[earth])
    return crane.load(described(tmp_path_factory.mktemp("phases"), both=both))


def run(machine, name="both", **options):
    under = machine.with_external_forces(*machine.tasks[name].loads)
    return crane.simulate(under, crane.joystick(under, name), **options)


@pytest.fixture(scope="module")
def found(machine):
    return run(machine, step=2e-3)


def levers_of(machine, recording):
    """Levers (N, 2) of recorded signals, the jump over the dead band taken out."""
    out = []
    for joint in ("x", "y"):
        valve = machine.hydraulics.valves[joint]
        u = (recording.channels[f"voltage_{joint}"] - valve.neutral) / (valve.full - valve.neutral)
        out.append(np.sign(u) * np.maximum(np.abs(u) - 0.1, 0.0) / 0.9)
    return np.stack(out, axis=1)


def crossing(time, q, end, sign, since=0.0):
    """When a recorded position first passes another."""
    past = (sign * (q - end) >= 0) & (time >= since)
    return time[past.argmax()]


def test_each_lever_is_held_until_its_position_and_taken_back(machine, found):
    """From the recorded positions alone: when each passes, and signals as a hand moves them."""
    time, (x, y) = found.time, found.q.T
    arrived = {"x": crossing(time, x, 0.32, 1), "y": crossing(time, y, 0.3, 1)}
    first = max(arrived.values())
    last = crossing(time, x, 0.22, -1, first + LOOK)
    assert min(arrived.values()) < first - 0.3 < last  # one waits for the other

    def hand(time, target):
        """A lever that goes to where it shall be as fast as a hand does, from one look on."""
        lever, now = 0.0, [0.0]
        for t in time[:-1]:
            most = LOOK / RAMP
            lever += np.clip(target(t) - lever, -most, most)
            now.append(lever)
        return np.array(now)

    looks = LOOK * np.arange(round(time[-1] / LOOK) + 1)
    levers = levers_of(machine, found)[:: round(LOOK / 2e-3)]
    wanted = {
        "x": lambda t: 0.6 if t < arrived["x"] else -0.2 if first <= t < last else 0.0,
        "y": lambda t: 0.3 if t < arrived["y"] else 0.0,
    }
    for column, joint in enumerate(("x", "y")):
        expected = hand(looks, wanted[joint])[: len(levers)]
        np.testing.assert_allclose(levers[:, column], expected, atol=1e-9, err_msg=joint)


def test_a_phase_ends_within_a_look_of_its_positions(found):
    """The task clock runs evenly and never backwards, one sample late."""
    time, clock = found.time, found.channels["phase"]
    assert (np.diff(clock) >= 0).all() and clock[-1] == 2
    ends = [time[np.searchsorted(clock, k - 1e-12)] - LOOK for k in (1, 2)]
    x, y = found.q.T
    for (end, joints), begins in zip(
        [(ends[0], [(x, 0.32, 1), (y, 0.3, 1)]), (ends[1], [(x, 0.22, -1)])], (0.0, ends[0]),
        strict=True,
    ):  # fmt: skip
        passed = max(crossing(time, q, at, sign, begins) for q, at, sign in joints)
        assert passed <= end + 1e-9 <= passed + LOOK
    assert found.time[-1] == pytest.approx(ends[1] + 0.2 * RAMP + LOOK, abs=LOOK)


def test_it_ends_when_the_levers_are_back_or_lasts_as_long_as_is_asked(machine, found):
    levers = levers_of(machine, found)
    assert not levers[-1].any() and levers[-20].any()
    longer = run(machine, step=2e-3, duration=6.0)
    assert longer.time[-1] == pytest.approx(6.0)
    n = len(found.time)
    np.testing.assert_array_equal(longer.q[:n], found.q)
    assert not levers_of(machine, longer)[n:].any()


def test_a_run_is_the_same_to_the_last_bit(machine, found):
    """Also of a command that was used before, and was cut in the middle."""
    under = machine.with_external_forces(*machine.tasks["both"].loads)
    command = crane.joystick(under, "both")
    crane.simulate(under, command, duration=0.5, step=1e-2)
    for _ in range(2):
        np.testing.assert_array_equal(crane.simulate(under, command, step=2e-3).q, found.q)


def test_recorded_signals_do_the_same_again(machine, found):
    seen = found.channels
    signals = {joint: seen[f"voltage_{joint}"] for joint in ("x", "y")}
    force = np.stack([seen[f"load_earth_force_{axis}"] for axis in "xyz"], axis=1)
    earth = crane.Wrench("load_x", force, times=found.time, name="earth")
    again = crane.simulate(
        machine.with_external_forces(earth),
        crane.control.ValveSignals(machine, found.time, signals),
        step=2e-3,
    )
    np.testing.assert_allclose(again.q, found.q, atol=1e-6)


def test_loads_by_phases(found):
    """Straight over the clock, and in the balance of energy."""
    seen = found.channels
    expected = np.interp(seen["phase"], [0, 1, 1.5, 2], [0, -EARTH, -EARTH, 0])
    np.testing.assert_allclose(seen["load_earth_force_z"], expected, atol=1e-9 * EARTH)
    assert expected.min() == -EARTH
    work = seen["work"] + seen["work_earth"]
    stored = seen["kinetic"] + seen["potential"]
    gap = work - (stored - stored[0]) - seen["dissipated"]
    assert np.abs(gap).max() < 1e-6 * np.ptp(stored)


def test_loads_by_phases_need_phases(machine):
    under = machine.with_external_forces(*machine.tasks["both"].loads)
    for controller in (None, crane.joystick(under, {"x": [(0, 0), (1, 0.1)]})):
        with pytest.raises(crane.CraneError, match="load 'earth' counts phases, simulate it with"):
            crane.simulate(under, controller, duration=0.1)


def test_a_batch_has_phases_of_its_own(machine):
    """Variants end at other times; with one duration they are stacked."""
    under = machine.with_external_forces(*machine.tasks["both"].loads)
    with_more = under.with_payload(crane.Payload("load_x", 300.0))
    both = [under, with_more]

    def levers(machine):
        return crane.control.ValveDrive(machine, crane.joystick(machine, "both"))

    with pytest.raises(crane.CraneError, match="give one duration for all"):
        crane.simulation.simulate_batch(both, levers, step=1e-2)
    batch = crane.simulation.simulate_batch(both, levers, duration=6.0, step=1e-2, threads=2)
    for i, one in enumerate(both):
        alone = crane.simulate(one, crane.joystick(one, "both"), duration=6.0, step=1e-2)
        np.testing.assert_array_equal(batch.q[i], alone.q)
    assert np.abs(batch.q[0] - batch.q[1]).max() > 1e-3


def test_a_phase_that_never_ends_is_named(tmp_path):
    slow = OUT | {"levers": {"x": 0.6, "y": 0.01}, "within": 1.5, "name": "wait for y"}
    path = described(tmp_path, slow=task(slow, BACK))
    done = typed("simulate", path, "--task", "slow", "--step", "0.01", "--out", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith(
        "error: at t = 1.51 s: phase 'wait for y' has not ended within 1.5 s, 'y' is at 0.2"
    )
    assert (
        " m on its way from 0.2 to 0.3 m: give it more time or lever, or a position that it "
        "reaches; results until t = 1.5 s are written to "
    ) in done.stderr
    part = crane.Recording.read(tmp_path / "out/recording.csv")
    assert part.time[-1] == pytest.approx(1.5) and part.stopped


def test_the_command_simulates_and_accounts_for_it(tmp_path):
    path = described(tmp_path, both=task(OUT, BACK))
    done = typed("simulate", path, "--task", "both", "--step", "0.01", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    machine, recording = crane.load(path), crane.Recording.read(tmp_path / "run/recording.csv")
    assert recording.controller == "joystick"
    assert recording.time[-1] == pytest.approx(run(machine, step=1e-2).time[-1])
    account = crane.power_balance(machine, recording)
    assert np.abs(account.residual).max() <= 1e-9 * np.abs(account.shaft_power).max()
    done = typed("simulate", path, "--task", "both", "--step", "0.003", "--out", tmp_path / "odd")
    assert done.returncode == 2 and "no whole number of steps" in done.stderr


def test_files_that_are_written_have_them(machine, tmp_path):
    write_machine(machine, tmp_path / "again")
    again = crane.load(next((tmp_path / "again").glob("*.yaml")))
    one, other = machine.tasks["both"], again.tasks["both"]
    assert (one.phases, one.ramp, one.duration) == (other.phases, other.ramp, other.duration)
    assert type(other.loads[0]) is crane.description.PhasedWrench
    np.testing.assert_array_equal(one.loads[0].times, other.loads[0].times)
    np.testing.assert_array_equal(run(again, step=1e-2).q, run(machine, step=1e-2).q)


def test_a_lock_takes_its_lever_out(machine):
    locked = crane.load(machine.path, lock={"y": 0.25})
    assert [dict(x.levers) for x in locked.tasks["both"].phases] == [{"x": 0.6}, {"x": -0.2}]
    only = crane.load(machine.path, lock={"x": 0.25})
    assert [x.name for x in only.tasks["both"].phases] == ["out"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"levers": {"z": 0.1}}, "no valve for 'z', known: x, y"),
        ({"levers": {"x": 1.5}}, "the lever of 'x' in phase 'out' is 1.5, give it -1 to 1"),
        ({"levers": {"x": 0}}, "the lever of 'x' in phase 'out' is 0, give it -1 to 1 and not 0"),
        ({"levers": {}}, "phase 'out' moves no lever, give it one"),
        ({"levers": {"x": "up"}}, "'x' of 'levers' of phase 'out' is 'up', give a number"),
        ({"until": {"x": 0.3}}, "the lever of 'y' in phase 'out' has no position that it is held"),
        ({"levers": {"x": 0.5}}, "phase 'out' moves no lever of 'y' and waits for it, known: x"),
        ({"until": {"x": 0.6, "y": 0.3}}, "phase 'out' waits for 'x' at 0.6, beyond its limits 0"),
        ({"until": {"x": 0.1, "y": 0.3}}, "away from which its lever moves it from 0.2: turn it"),
        ({"within": 0}, "phase 'out' may take 0 s, give it a time above 0"),
        ({"within": None}, "'within' of phase 'out' is empty, give its value"),
        ({"name": None}, "'name' of a phase is empty, give its value"),
        ({"lever": {"x": 1}}, "unknown key 'lever'"),
    ],
)  # fmt: skip
def test_bad_phases_are_refused_in_one_line(tmp_path, change, line):
    path = described(tmp_path, both=task(OUT | change))
    with pytest.raises(crane.CraneError) as error:
        crane.load(path)
    text = str(error.value)
    assert line in text and "\n" not in text and text.startswith("rig.yaml:"), text
    assert any(line in str(one) for one in crane.check(path).findings)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"phases": []}, "task 'both' has no phases, give one at least"),
        ({"phases": 3}, "'phases' is 3, give a list"),
        ({"duration": 3}, "task 'both' ends when its last phase does, leave 'duration' out"),
        ({"joystick": {"x": [0, 1]}}, "task 'both' has phases and 'joystick', give one of both"),
        ({"ramp": -1}, "'ramp' of task 'both' is -1, give at least 0"),
        ({"start": {"x": 0.4}}, "'x' at 0.32, away from which its lever moves it from 0.4: turn"),
        ({"loads": [{"frame": "load_x", "force": [[0, 0, 1]], "times": [0], "phases": [0]}]},
         "the load on 'load_x' has times and phases, give one of both"),
    ],
)  # fmt: skip
def test_bad_tasks_of_phases_are_refused_in_one_line(tmp_path, change, line):
    path = described(tmp_path, both=task(OUT) | change)
    with pytest.raises(crane.CraneError) as error:
        crane.load(path)
    assert line in str(error.value) and "\n" not in str(error.value)


def test_phases_belong_to_tasks_that_have_some(tmp_path):
    polygon = {"duration": 1, "joystick": {"x": [0, 0.1]}}
    load = {"frame": "load_x", "force": [0, 0, 1], "phases": [0]}
    wrong = {"ramp": 1}, {"loads": [load]}
    lines = "has no phases, leave 'ramp'", "unknown key 'phases'"
    for bad, line in zip(wrong, lines, strict=True):
        with pytest.raises(crane.CraneError, match=line):
            crane.load(described(tmp_path, both=polygon | bad))


def test_phases_in_python(machine):
    """As in files; bad ones are refused as there."""
    phases = [crane.description.Phase("out", {"x": 0.6}, {"x": 0.3}, 5.0)]
    recording = crane.simulate(
        machine, crane.control.LeverPhases(machine, phases, ramp=0.0), step=1e-2
    )
    assert 0.3 <= recording.q[-1, 0] < 0.33
    jump = recording.channels["voltage_x"]
    assert jump[1] == pytest.approx(0.1 + 0.9 * 0.6) and set(np.round(jump, 9)) <= {0.0, 0.64}
    with pytest.raises(crane.CraneError, match="no valve for 'z', known: x, y"):
        crane.control.LeverPhases(
            machine, [crane.description.Phase("out", {"z": 0.6}, {"z": 0.3}, 5.0)]
        )
    command, rest = crane.control.LeverPhases(machine, phases), np.zeros((2, 2))
    for time in (0.0, 0.01, 0.01):
        command.update(time, np.array([0.2, 0.2]), np.zeros(2), rest)
    with pytest.raises(crane.CraneError, match="levers by positions do not go back"):
        command.update(0.005, np.array([0.2, 0.2]), np.zeros(2), rest)
    with pytest.raises(crane.CraneError, match="there are no phases of levers"):
        crane.control.LeverPhases(machine, [])
    with pytest.raises(crane.CraneError, match="the ramp of the levers is -1 s, it must not"):
        crane.control.LeverPhases(machine, phases, ramp=-1.0)
