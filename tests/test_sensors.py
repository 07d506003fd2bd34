"""Sensors of a machine: corrections, redundancy, and logs that name them."""

import dataclasses
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import warned
from command_line import typed

import crane
from crane.common.errors import CraneError, CraneWarning, InputError, RecordingError
from crane.description.sensors import Sensor
from crane.formats.machine_loading import MachineVariants
from crane.recordings import table_reader, timeseries
from crane.recordings.measured_recordings import dead_length
from crane.recordings.recording import Recording
from crane.recordings.recording_reader import correct_readings, read_quantities, select_time_span
from crane.recordings.sensor_kinematics import ideal_readings, pin_derivatives
from crane.recordings.timeseries import Table

LIFTING = Path(__file__).parents[2] / "shared" / "data" / "patu655" / "lifting_first_half.csv"
COLUMNS = """# machine: patu655
time [s] = t_s
voltage_X_lift [V] = U1_V
voltage_X_tilt [V] = U2_V
X_lift [mm] = s1_mm - 820
X_tilt [mm] = s2_mm - 1050
pressure_X_lift_a [Pa] = p1_Pa
pressure_X_lift_b [Pa] = p2_Pa
pressure_X_tilt_a [Pa] = p3_Pa
pressure_X_tilt_b [Pa] = p4_Pa
pressure_supply [Pa] = pP_Pa
pressure_tank [Pa] = pT_Pa
inclination_lift_boom [deg] = z1_deg
inclination_tilt_boom [deg] = z2_deg
"""
LOCKS = ["--lock", "slew=0", "--lock", "X_ext=0"]
recorded = pytest.mark.skipif(
    not LIFTING.exists(), reason="the recordings, ../shared/data, are not there"
)


@pytest.fixture(scope="module")
def machine():
    return crane.load("patu655", lock={"slew": 0.0, "X_ext": 0.0})


@pytest.fixture(scope="module")
def motion(machine):
    """Both cylinders over much of their stroke, 50 Hz: what ideal sensors say, and units."""
    time = np.arange(0.0, 12.0, 0.02)
    phase = 2 * np.pi * time / 12.0
    q_a = np.column_stack([0.25 - 0.12 * np.cos(phase), 0.30 + 0.10 * np.sin(2 * phase)])
    w = 2 * np.pi / 12.0
    v_a = np.column_stack([0.12 * w * np.sin(phase), 0.20 * w * np.cos(2 * phase)])
    q = machine.closure.solve(q_a)
    v = np.einsum("nij,nj->ni", machine.closure.gamma(q), v_a)
    names = ["q2", "q3", "inclination_lift_boom", "inclination_tilt_boom"]
    names += [f"{name}_velocity" for name in names]
    said = ideal_readings(machine, q, v, names)
    columns = {"time": time, "X_lift": q_a[:, 0], "X_tilt": q_a[:, 1], **said}
    columns |= {"X_lift_force": 1e4 + 0 * time, "X_tilt_force": 1e4 + 0 * time}
    units = {"time": "s", "X_lift": "m", "X_tilt": "m", "X_lift_force": "N", "X_tilt_force": "N"}
    return columns, {x: units.get(x, "rad/s" if "_velocity" in x else "rad") for x in columns}


def written(folder, motion, names=None, notes=None, **off):
    """A recording of some columns, some of which are off by a function of them."""
    columns, units = motion
    names = list(columns) if names is None else ["time", "X_lift", "X_tilt", *names]
    names += [x for x in ("X_lift_force", "X_tilt_force") if x not in names]
    values = [off[x](columns[x]) if x in off else columns[x] for x in names]
    path = folder / "run.csv"
    table = Table({x: units[x] for x in names}, np.column_stack(values), notes or {})
    timeseries.write_table(path, table)
    return path


def told(machine, path, **options):
    """What is said of sensors while a recording is read."""
    _, lines = warned.told(crane.recordings.read_measured, machine, path, **options)
    return [line for line in lines if "sensors disagree" in line]


def number(line, name):
    return float(re.search(rf"{re.escape(name)} = (\S+?)(?:[,);:]|$| or)", line + " or")[1])


# --- What is known -------------------------------------------------------------------------------


def test_a_sensor_reads_late_scaled_and_off_and_is_corrected():
    """Against closed forms: a parabola is delayed, scaled and shifted, and comes back."""
    sensor = Sensor(zero=0.3, scale=-2.0, delay=0.1)
    time = np.linspace(0.0, 4.0, 401)
    reading = -2.0 * (time - 0.1) ** 2 + 0.3
    table = Table({"time": "s", "q": "rad"}, np.column_stack([time, reading]), {})
    found = correct_readings(table, {"q": sensor})
    assert found.values[-1, 0] == pytest.approx(3.9)  # what comes later it has not told
    np.testing.assert_allclose(found.values[:, 1], found.values[:, 0] ** 2, atol=1e-12)
    signal = Table({"time": "s", "voltage_q": "V"}, np.column_stack([time, time**2]), {})
    at_valve = correct_readings(signal, {"voltage_q": Sensor(zero=0.3, scale=2.0)}).values[:, 1]
    np.testing.assert_allclose(at_valve, 2.0 * time**2 + 0.3, atol=1e-12)
    for late in (
        lambda: correct_readings(signal, {"voltage_q": Sensor(delay=0.1)}),
        lambda: crane.load("patu655", changes={"sensor.voltage_q.delay": 0.1}),
    ):
        with pytest.raises(InputError, match=r"its valve is: give 'valve.q.delay'$"):
            late()


def test_what_a_machine_knows_of_its_sensors_corrects_a_recording(machine, motion, tmp_path):
    path = written(tmp_path, motion, ["q2"], X_lift=lambda x: 1.02 * x + 0.005)
    columns, _ = motion
    numbers = {"sensor.X_lift.zero": 0.005, "sensor.X_lift.scale": 1.02}
    knowing = crane.load("patu655", changes=numbers, lock=dict(machine.locked_joints))
    assert told(machine, path) and not told(knowing, path)
    found = crane.recordings.read_measured(knowing, path)
    np.testing.assert_allclose(found.q[:, 0], columns["X_lift"], atol=1e-15)
    # notes of the file say the same, and count before the machine's own
    noted = written(
        tmp_path, motion, ["q2"], {f"{name}": str(value) for name, value in numbers.items()},
        X_lift=lambda x: 1.02 * x + 0.005,
    )  # fmt: skip
    for one in (machine, crane.load("patu655", changes={"sensor.X_lift.zero": 1.0}, lock=LOCKED)):
        again, lines = warned.told(crane.recordings.read_measured, one, noted)
        assert np.array_equal(again.q, found.q)
        assert any("notes of the recording count" in x for x in lines) == bool(one.sensors)


LOCKED = {"slew": 0.0, "X_ext": 0.0}


def test_quantities_are_corrected_once(machine, motion, tmp_path):
    """A recording that was corrected says so, and so does a simulated one."""
    path = written(tmp_path, motion, [], X_lift=lambda x: x + 0.005)
    knowing = crane.load("patu655", changes={"sensor.X_lift.zero": 0.005}, lock=LOCKED)
    found = crane.recordings.read_measured(knowing, path)
    found.to_csv(tmp_path / "again.csv")
    assert "# sensors: ideal" in (tmp_path / "again.csv").read_text()
    assert np.array_equal(
        crane.recordings.read_measured(knowing, tmp_path / "again.csv").q, found.q
    )
    assert not crane.recordings.read_measured(machine, path).ideal  # nothing was known of them
    assert crane.simulate(machine, duration=0.01).ideal


def test_machine_files_keep_sensors(machine, tmp_path):
    """What is written is read again; a machine file says what is wrong with its own, by line."""
    sensors = {
        "time": Sensor("t_s", "s"),
        "q2": Sensor("z1 - 90", "deg", 0.02, 0.98, 0.03, 1e-3),
        "inclination_tilt_boom_velocity": Sensor(zero=-0.01),
        "pressure_X_lift_a": Sensor("p1", "bar"),
    }
    path = crane.write_machine(machine.replace(sensors=sensors), tmp_path / "machine")
    assert dict(crane.load(path).sensors) == sensors
    values = crane.load(path, changes={"sensor.q2.delay": 0.0}).sensors
    assert values["q2"] == dataclasses.replace(sensors["q2"], delay=0.0)
    text = path.read_text()
    line = next(i for i, row in enumerate(text.splitlines(), 1) if row.startswith("  q2: {col"))
    for old, new, said in (
        ("q2: {col", "q22: {col", f":{line}: 'q22' is no quantity of this machine, did you mean"),
        ("unit: deg", "unit: mm", f":{line}: 'q2' is in [mm], give rad or deg"),
        (
            "delay: 0.03",
            "delay: -1",
            f":{line}: 'q2': delay of a sensor is -1, it must not be neg",
        ),
        ("scale: 0.98", "scale: 0", f":{line}: 'q2': scale of a sensor is 0"),
        ("delay: 0.03", "dely: 0.03", f":{line}: unknown key 'dely' in sensor 'q2', did you mean"),
        ("unit: s}", "unit: s, zero: 1.0}", "time has a column and a unit, and no numbers"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(CraneError) as error:
            crane.load(path)
        assert said in str(error.value)


@pytest.mark.parametrize(
    ("notes", "said"),
    [
        ({"sensor.q2.zero": "much"}, "the note 'sensor.q2.zero' is 'much', give a number"),
        ({"sensor.q2.zer": "1"}, "the note 'sensor.q2.zer': a sensor has no 'zer', did you mean"),
        (
            {"sensor.q22.zero": "1"},
            "the note 'sensor.q22.zero' is of no column, did you mean 'q2'",
        ),
        ({"sensor.q2.scale": "0"}, "the note 'sensor.q2.scale': scale of a sensor is 0"),
        ({"sensor.q2.delay": "99"}, "is shorter than the delay of a sensor, 99 s, record more"),
    ],
)
def test_notes_that_are_none(machine, motion, tmp_path, notes, said):
    path = written(tmp_path, motion, ["q2"], notes)
    with pytest.raises(RecordingError) as error:
        crane.recordings.read_measured(machine, path)
    assert said in str(error.value) and str(error.value).startswith(str(path))


def test_changes_of_sensors_that_are_none():
    for name, said in (
        (
            "sensor.q22.zero",
            "'sensor.q22.zero' is of no quantity of 'patu655', did you mean 'q2'?",
        ),
        ("sensor.q2.gain", "'sensor.q2.gain': a sensor has no 'gain', known: delay, noise, scale"),
    ):
        with pytest.raises(InputError) as error:
            crane.load("patu655", changes={name: 1.0})
        assert said in str(error.value)


# --- Disagreement --------------------------------------------------------------------------------


def test_sensors_that_agree_say_nothing(machine, motion, tmp_path):
    """Noisy recordings cause no warning, whichever columns they have."""
    assert told(machine, written(tmp_path, motion)) == []
    random = np.random.default_rng(1)
    off = {
        name: lambda x, size=size: x + size * random.normal(size=len(x))
        for name, size in (
            ("X_lift", 1e-3), ("q2", 5e-3), ("q3", 5e-3), ("inclination_tilt_boom", 0.02),
            ("inclination_lift_boom_velocity", 0.08), ("q3_velocity", 0.05),
        )
    }  # fmt: skip
    for _ in range(5):
        assert told(machine, written(tmp_path, motion, **off)) == []


# Their sensors are those of other bundled machines.
SIMILAR = ("excavator_ls", "excavator_two_pumps", "patu655_ls", "tx40")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(x, marks=pytest.mark.long) if x in SIMILAR else x
        for x in crane.description.bundled_machines()
    ],
)
def test_simulations_of_bundled_machines_agree_with_themselves(name, tmp_path):
    machine = crane.load(name)
    active = [x for x in machine.active if x not in machine.free]
    path = tmp_path / "run.csv"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        crane.simulate(machine, duration=0.3, step=2e-3).to_csv(path)
    assert active and told(machine, path) == []


@pytest.mark.parametrize(
    ("name", "off", "within"),
    [
        ("q2", 0.03, np.deg2rad(0.1)),
        ("q3", -0.05, np.deg2rad(0.1)),
        ("inclination_lift_boom", -0.024, np.deg2rad(0.1)),
        ("inclination_tilt_boom", 0.08, np.deg2rad(0.1)),
        ("X_lift", 0.008, 1e-4),
        ("X_tilt", -0.012, 1e-4),
        ("inclination_tilt_boom_velocity", 0.01, 1e-3),
        ("q2_velocity", -0.02, 1e-3),
    ],
)
def test_a_zero_is_named_with_its_value(machine, motion, tmp_path, name, off, within):
    """Also that of a stroke which the posture is taken from, by how the linkage bends it."""
    random = np.random.default_rng(2)
    noise = {"q2": 1e-3, "q3": 1e-3, "inclination_lift_boom": 2e-3, "inclination_tilt_boom": 2e-3}
    moved = {x: lambda y, s=s: y + s * random.normal(size=len(y)) for x, s in noise.items()}
    before = moved.get(name, lambda y: y)
    lines = told(machine, written(tmp_path, motion, **moved | {name: lambda y: before(y) + off}))
    assert lines
    for line in lines:
        assert re.search(r"; residual \S+ \S+ with a constant offset \([^()]*\)$", line), line
        assert number(line, f"sensor.{name}.zero") == pytest.approx(off, abs=within), line
    if not name.startswith("X"):
        assert len(lines) == 1 and f"'{name}'" in lines[0]


def test_how_far_apart_is_told(machine, motion, tmp_path):
    """Mean and range in degrees, and the joints that tell."""
    columns, _ = motion
    bend = 0.02 * np.sin(7 * columns["time"])
    (line,) = told(machine, written(tmp_path, motion, ["q2"], q2=lambda x: x + 0.04 + bend))
    found = re.search(
        r"'q2' deviates from the value computed from X_lift by (\S+) deg on average "
        r"\((\S+) to (\S+)\);",
        line,
    )
    wanted = np.rad2deg([0.04 + bend.mean(), 0.04 + bend.min(), 0.04 + bend.max()])
    np.testing.assert_allclose([float(x) for x in found.groups()], wanted, rtol=5e-3)
    assert "residual 0.81 deg with a constant offset (sensor.q2.zero = 0.04" in line
    assert line.endswith("; no delay, scale or pin position explains the rest")


def test_delays_and_scales_are_told_apart(machine, motion, tmp_path):
    columns, _ = motion
    late = lambda x: np.interp(columns["time"] - 0.3, columns["time"], x)  # noqa: E731
    (line,) = told(machine, written(tmp_path, motion, ["q3"], q3=late))
    assert "an offset and a delay" in line
    assert number(line.split("and a delay")[1], "sensor.q3.delay") == pytest.approx(0.3, abs=1e-3)
    (line,) = told(machine, written(tmp_path, motion, ["q2"], q2=lambda x: 1.1 * x + 0.02))
    assert "an offset and a scale" in line
    line = line.split("an offset and a scale")[1]
    assert number(line, "sensor.q2.scale") == pytest.approx(1.1, abs=1e-3)
    assert number(line, "sensor.q2.zero") == pytest.approx(0.02, abs=1e-3)
    (line,) = told(machine, written(tmp_path, motion, ["q2"], q2=lambda x: 0 * x))
    assert line.endswith("; its reading does not change")


@pytest.mark.parametrize(
    ("name", "at"), [("lift_boom_rod.x", 0.3225), ("lift_boom_rod.y", -0.145)]
)
def test_a_pin_elsewhere_is_named(machine, motion, tmp_path, name, at):
    """The recording of a crane that differs from its drawing by 20 or 40 mm in one pin."""
    other = crane.load("patu655", changes={name: at}, lock=LOCKED)
    columns, units = motion
    q = other.closure.solve(np.column_stack([columns["X_lift"], columns["X_tilt"]]))
    moved = columns | {x: q[:, other.column(x)] for x in ("q2", "q3")}
    (line,) = told(machine, written(tmp_path, (moved, units), ["q2", "q3"]))
    assert told(other, tmp_path / "run.csv") == []
    assert "'q2'" in line and "deg with a constant offset" in line
    assert "another pin position" in line
    drawn = MachineVariants(machine).values[name]  # found to first order of how far it is off
    assert number(line, name) == pytest.approx(at, abs=0.06 * abs(at - drawn))


def test_an_absolute_angle_in_the_place_of_a_joint_s_is_suspected(machine, motion, tmp_path):
    columns, _ = motion
    absolute = columns["inclination_tilt_boom"]
    (line,) = told(machine, written(tmp_path, motion, ["q3"], q3=lambda x: absolute + 0.01))
    suspected = "'q3' follows the inclination of 'tilt_boom' against the horizon within"
    assert suspected in line
    assert line.endswith("measures an absolute angle, name the column 'inclination_tilt_boom'")
    # and where it is what the posture is taken from, beside the inclinometer itself
    units = motion[1]
    names = ["time", "q2", "q3", "inclination_tilt_boom", "X_lift_force", "X_tilt_force"]
    values = [absolute + 0.01 if x == "q3" else columns[x] for x in names]
    table = Table({x: units[x] for x in names}, np.column_stack(values), {})
    timeseries.write_table(tmp_path / "run.csv", table)
    (line,) = told(machine, tmp_path / "run.csv")
    assert "'inclination_tilt_boom' deviates" in line and suspected in line


def test_numbers_add_to_what_is_known(machine, motion, tmp_path):
    """What is told is the whole zero, to be written as it is."""
    path = written(tmp_path, motion, ["q2"], q2=lambda x: x + 0.05)
    half = crane.load("patu655", changes={"sensor.q2.zero": 0.03}, lock=LOCKED)
    (line,) = told(half, path)
    assert number(line, "sensor.q2.zero") == pytest.approx(0.05, abs=1e-4)
    whole = crane.load("patu655", changes={"sensor.q2.zero": 0.05}, lock=LOCKED)
    assert told(whole, path) == []


# --- Postures ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given",
    [
        ["inclination_lift_boom", "inclination_tilt_boom"],
        ["X_lift", "inclination_tilt_boom"],
        ["inclination_lift_boom", "q3"],
        ["inclination_tilt_boom", "X_tilt"],
    ],
)
def test_inclinometers_tell_the_posture(machine, motion, tmp_path, given):
    """Alone and beside lengths and angles, over all of the motion."""
    columns, units = motion
    names = ["time", *given, "X_lift_force", "X_tilt_force"]
    table = Table({x: units[x] for x in names}, np.column_stack([columns[x] for x in names]), {})
    timeseries.write_table(tmp_path / "run.csv", table)
    found = crane.recordings.read_measured(machine, tmp_path / "run.csv")
    for i, joint in enumerate(("X_lift", "X_tilt")):
        np.testing.assert_allclose(found.q[:, i], columns[joint], atol=1e-9)
    assert told(machine, tmp_path / "run.csv") == []


def test_what_is_not_finite_is_named(machine, motion, tmp_path):
    """By its column, also where another one is computed from it."""
    columns, units = motion
    boom = columns["inclination_lift_boom"].copy()
    boom[5] = np.nan
    names = ["time", "inclination_lift_boom", "inclination_tilt_boom", "X_lift_force"]
    names += ["X_tilt_force", "X_lift", "X_tilt"]
    for some in (names, names[:-2]):
        held = {f"{x} [{units[x]}]": columns[x] for x in some} | {
            "inclination_lift_boom [rad]": boom
        }
        np.savez(tmp_path / "run.npz", **held)
        with pytest.raises(RecordingError, match="'inclination_lift_boom' is nan at sample 5"):
            crane.recordings.read_measured(machine, tmp_path / "run.npz")


def test_one_sample_is_compared_and_its_rates_are_not(machine, motion, tmp_path):
    columns, units = motion
    names = ["q2", "q2_velocity", "X_lift", "X_tilt", "time", "X_lift_force", "X_tilt_force"]
    values = np.array([[columns[x][0] + 0.1 * x.startswith("q2") for x in names]])
    timeseries.write_table(tmp_path / "run.csv", Table({x: units[x] for x in names}, values, {}))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        (line,) = told(machine, tmp_path / "run.csv")
    assert "'q2' deviates from the value computed from X_lift by +5.73 deg on average" in line


def test_inclinations_that_do_not_tell(machine, motion, tmp_path):
    """One for two freedoms, and one that no posture has."""
    columns, units = motion
    for name, off, said in (
        ("inclination_lift_boom", 0.0, "'X_lift', 'X_tilt' are not determined"),
        ("inclination_tilt_boom", 1.6, "see that zero and sign of inclination_tilt_boom are"),
    ):
        names = ["time", name, "X_lift_force", "X_tilt_force"] + ["X_lift"] * bool(off)
        values = [columns[x] + off * (x == name) for x in names]
        table = Table({x: units[x] for x in names}, np.column_stack(values), {})
        timeseries.write_table(tmp_path / "run.csv", table)
        with pytest.raises(RecordingError) as error:
            crane.recordings.read_measured(machine, tmp_path / "run.csv")
        assert said in str(error.value)


# --- Logs and windows ----------------------------------------------------------------------------


def test_a_window_is_what_was_recorded_in_it(machine, motion, tmp_path):
    path = written(tmp_path, motion, [])
    whole = crane.recordings.read_measured(machine, path)
    part = crane.recordings.read_measured(machine, path, span=(3.0, 5.0))
    some = (whole.time >= 3.0) & (whole.time <= 5.0)
    assert part.time[0] == 3.0 and part.time[-1] == pytest.approx(5.0)
    assert np.array_equal(part.q, whole.q[some])
    for span, error, said in (
        (
            (20.0, 30.0),
            RecordingError,
            "no sample lies from 20 to 30 s, it is recorded from 0 to 11",
        ),
        ((5.0, 3.0), InputError, "nothing lies from 5 to 3 s, give a later end"),
    ):
        with pytest.raises(error, match=re.escape(said)):
            crane.recordings.read_measured(machine, path, span=span)


def test_a_delay_reads_beyond_the_window(machine, motion, tmp_path):
    """A window contains the samples that a delayed sensor gives after its end."""
    path = written(tmp_path, motion, [])
    table = table_reader.read_table(path)
    late = {"X_lift": Sensor(delay=0.1)}
    cut = select_time_span(correct_readings(table, late), (3.0, 5.0), path)
    assert cut.values[-1, 1] == pytest.approx(
        np.interp(5.1, table.values[:, 0], table.values[:, 1])
    )


def test_commands_take_windows(tmp_path, motion, machine):
    path = written(tmp_path, motion, ["q2"], q2=lambda x: x + 0.05)
    out = tmp_path / "part.png"
    done = typed(
        "plot", path, "--machine", "patu655", *LOCKS, "--from", "2", "--until", "4", "--out", out
    )
    assert done.returncode == 0 and out.exists()
    assert (
        done.stderr.count("sensors disagree: 'q2' deviates")
        == done.stderr.count(" by +2.86 deg on average ")
        == 1
    )
    for words, said in (
        (("plot", path, "--from", "4", "--until", "2"), "nothing lies from 4 to 2 s"),
        (("view", "patu655", "--from", "1"), "--from is for runs, and 'patu655' is none"),
        (("plot", path, "--lock", "slew=0"), "--lock is for a machine, name it by --machine"),
        (("live", "patu655", "--from", "1"), "--from is for runs, name one by --run"),
        (
            ("simulate", "patu655", "--until", "1", "--out", tmp_path / "x"),
            "--until is for --inputs",
        ),
        (("payload", "patu655", path, *LOCKS, "--from", "99"), "it is recorded from 0 to 11.98 s"),
    ):
        done = typed(*words)
        assert done.returncode == 2 and said in done.stderr, done.stderr


def test_configurations_by_positions_of_pins():
    """Beside the closed loops of machines with pins elsewhere."""
    mini = crane.load("mini_forwarder")
    found, variants = pin_derivatives(mini, mini.home[None]), MachineVariants(mini)
    active = mini.home[mini.closure.active]
    for name in ("A1_eye.x", "link3_G.x", "link5_J.x"):
        more, less = (
            variants.machine({name: variants.values[name] + step}).closure.solve(active)
            for step in (1e-6, -1e-6)
        )
        np.testing.assert_allclose(found[name][0], (more - less) / 2e-6, rtol=0, atol=1e-6)


def test_lengths_from_pin_to_pin_are_not_strokes(machine, motion, tmp_path):
    """The published pin-to-pin lengths with the rods in are 0.820 and 1.050 m."""
    assert dead_length(machine, "X_lift") == pytest.approx(0.820, abs=1e-9)
    assert dead_length(machine, "X_tilt") == pytest.approx(1.050, abs=1e-9)
    assert dead_length(crane.load("patu655"), "X_ext") is None  # it has no pins on its axis
    lengths = {"X_lift": lambda x: x + 0.82, "X_tilt": lambda x: x + 1.05}
    with pytest.raises(RecordingError) as error:
        crane.recordings.read_measured(machine, written(tmp_path, motion, [], **lengths))
    line = str(error.value)
    assert "from pin to pin it is 0.82 m longer, subtract that (sensor.X_lift.zero = 0.82)" in line
    assert "(sensor.X_tilt.zero = 1.05)" in line
    numbers = {"sensor.X_lift.zero": 0.82, "sensor.X_tilt.zero": 1.05}
    knowing = crane.load("patu655", changes=numbers, lock=LOCKED)
    found = crane.recordings.read_measured(knowing, tmp_path / "run.csv")
    np.testing.assert_allclose(found.q[:, 0], motion[0]["X_lift"], atol=1e-12)


@recorded
def test_a_raw_log_is_read_by_the_sensors_of_its_machine(machine, tmp_path):
    """With columns and numbers in the machine, as with a file of columns and notes."""
    columns = tmp_path / "columns.txt"
    columns.write_text("# sensor.inclination_tilt_boom.zero: -0.085\n" + COLUMNS)
    known = {}
    for row in COLUMNS.splitlines()[1:]:
        heading, _, column = row.partition(" = ")
        name, _, unit = heading.removesuffix("]").partition(" [")
        known[name] = Sensor(column, unit)
    known["inclination_tilt_boom"] = Sensor("z2_deg", "deg", zero=-0.085)
    known["spool_X_lift"] = Sensor("spool")
    path = crane.write_machine(machine.replace(sensors=known), tmp_path / "machine")
    with pytest.warns(CraneWarning, match="'spool_X_lift' \\(no 'spool'\\)"):
        one = read_quantities(LIFTING, crane.load(path))
    del known["time"], known["spool_X_lift"]
    with pytest.raises(
        RecordingError, match="yaml: does not say which column of .* is 'time', kn"
    ):
        read_quantities(LIFTING, machine.replace(sensors=known))
    two = read_quantities(LIFTING, machine, columns)
    assert one.units == two.units and np.array_equal(one.values, two.values)
    raw = table_reader.read_log_arrays(LIFTING, ["z2_deg"])
    at = list(one.units).index("inclination_tilt_boom")
    np.testing.assert_allclose(one.values[:, at], np.deg2rad(raw["z2_deg"]) + 0.085, atol=1e-12)
    # what crane wrote is no log
    Recording.from_table(
        Table(one.units | {"X_lift_force": "N"}, np.column_stack([one.values, one.values[:, 0]]),
              {"sensors": "ideal"}), "x",
    ).to_csv(tmp_path / "run.csv")  # fmt: skip
    assert np.array_equal(
        read_quantities(tmp_path / "run.csv", crane.load(path)).values[:, 0], one.values[:, 0]
    )


@recorded
def test_a_raw_log_s_disagreement_is_told(machine, tmp_path):
    """The inclinometers are some -1.4 and -4.9 degrees off what the strokes say, and swing."""
    columns = tmp_path / "columns.txt"
    columns.write_text(COLUMNS)
    lift, tilt = told(machine, LIFTING, columns=columns)
    assert "'inclination_lift_boom' deviates" in lift
    assert "by -1.37 deg on average (-2.69 to +0.201)" in lift
    assert (
        "'inclination_tilt_boom' deviates from the value computed from X_lift, X_tilt by" in tilt
    )
    assert "by -4.87 deg on average" in tilt
    places = [number(line, "lift_boom_rod.x") for line in (lift, tilt)]  # both say the same pin
    np.testing.assert_allclose(places, 0.316, atol=1e-3)
    window = "--from", "2", "--until", "3"
    done = typed("import", LIFTING, "--columns", columns, "--out", tmp_path / "part.csv", *window)
    assert done.stdout.startswith("101 samples of 13 columns")
    assert len(told(machine, tmp_path / "part.csv")) == 2
    columns.write_text(COLUMNS.replace(" - 820", "").replace(" - 1050", ""))
    done = typed("simulate", "patu655", *LOCKS, "--inputs", LIFTING, "--columns", columns,
                 "--out", tmp_path / "out")  # fmt: skip
    assert done.returncode == 2 and "sensor.X_lift.zero = 0.82" in done.stderr
    columns.write_text(COLUMNS.replace("= U1_V", "= U1").replace("= t_s", "= t"))
    done = typed("import", LIFTING, "--columns", columns, "--out", tmp_path / "out.csv")
    assert done.returncode == 2 and not (tmp_path / "out.csv").exists()
    assert ":2: the log has no 't'; " in done.stderr and ":3: the log has no 'U1', " in done.stderr
    done = typed("plot", LIFTING, "--machine", "patu655", "--out", tmp_path / "out.png")
    assert done.returncode == 2 and "say by a file of columns (--columns)" in done.stderr


@recorded
def test_all_that_a_log_lacks_is_told_at_once(tmp_path):
    columns = tmp_path / "columns.txt"
    columns.write_text("\n".join(x for x in COLUMNS.splitlines() if "voltage" not in x))
    done = typed("simulate", "patu655", "--inputs", LIFTING, "--columns", columns,
                 "--out", tmp_path / "out")  # fmt: skip
    assert done.returncode == 2 and "no signal of a valve, give at least one of" in done.stderr
    assert "'slew', 'X_ext' are not determined, give 'slew [rad]', 'X_ext [m]'" in done.stderr
    assert "--lock slew=0 (home) --lock X_ext=0.1 (home)" in done.stderr
    few = [
        x for x in COLUMNS.splitlines() if not re.match("voltage|pressure_(supply|X_lift_b)", x)
    ]
    columns.write_text("\n".join(few))
    done = typed("circuit", "patu655", LIFTING, "--columns", columns, "--joint", "X_lift")
    for said in (
        "columns are missing: 'pressure_X_lift_b', 'pressure_supply', 'voltage_X_lift' or 'spool_",
        "'slew', 'X_ext' are not determined", "--lock slew=0 (home) --lock X_ext=0.1 (home)",
    ):  # fmt: skip
        assert done.returncode == 2 and said in done.stderr
