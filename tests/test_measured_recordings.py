"""Recordings of a real crane: strokes from angles, forces from pressures."""

import csv
import re
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import oracles
import pytest
from broken_machines import MINI, copy_machine, swap
from command_line import typed
from warned import quiet

import crane
from crane.common.errors import CraneError, CraneWarning, RecordingError
from crane.recordings import measured_configurations
from crane.recordings.measured_recordings import check_pressures, read_measured, read_run
from crane.recordings.recording import Recording
from crane.recordings.timeseries import Table

AREA_A, AREA_B = 3.14e-4, 2.01e-4  # [m2] of both cylinders

CIRCUIT = """hydraulics:
  supply: {pressure: 3.0e+6}
  cylinders:
    X1: {area_a: 3.14e-4, area_b: 2.01e-4, hose_a: 1.0e-5, hose_b: 1.0e-5}
    X2: {area_a: 3.14e-4, area_b: 2.01e-4, hose_a: 1.0e-5, hose_b: 1.0e-5}
  valves:
    X1: {type: compensated, flow: 1.0e-4, margin: 7.0e+5}
    X2: {type: compensated, flow: 1.0e-4, margin: 7.0e+5}
tip: link7_tip
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """The mini forwarder with cylinders in the place of its electric actuators."""
    folder = tmp_path_factory.mktemp("machine")
    file = copy_machine(MINI, folder)
    swap("tip: link7_tip\n", CIRCUIT, MINI).apply(folder)
    return file


@pytest.fixture(scope="module")
def machine(path):
    return quiet(crane.load, path)


@pytest.fixture(scope="module")
def truth():
    """A motion of all drives over most of their range, without loops: closed forms only."""
    t = np.linspace(0, 4, 401)
    x1, x2 = 0.016 + 0.012 * np.sin(1.7 * t), 0.014 - 0.010 * np.cos(2.3 * t)
    v1, v2 = 0.012 * 1.7 * np.cos(1.7 * t), 0.010 * 2.3 * np.sin(2.3 * t)
    joints, _ = oracles.mini_forwarder(x1, x2)
    slopes = oracles.mini_forwarder_gamma(x1, x2)
    return {
        "t": t,
        "q": np.column_stack([0.3 * np.sin(t), x1, x2]),
        "v": np.column_stack([0.3 * np.cos(t), v1, v2]),
        "tau": np.column_stack([0.2 * np.cos(t), 40 + 15 * np.sin(3 * t), -25 + 12 * np.cos(t)]),
        "angles": joints,
        "rates": {name: rows[:, 0] * v1 + rows[:, 1] * v2 for name, rows in slopes.items()},
    }


@pytest.fixture
def columns(truth):
    """What the sensors of a crane give: angles in degrees, pressures in bar."""
    out = {
        "time [ms]": 1e3 * truth["t"],
        "q1 [deg]": np.rad2deg(truth["q"][:, 0]),
        "q2 [deg]": np.rad2deg(truth["angles"]["q2"]),
        "q3 [deg]": np.rad2deg(truth["angles"]["q3"]),
        "q1_force [N m]": truth["tau"][:, 0],
    }
    for i, joint in enumerate(("X1", "X2"), start=1):
        p_b = 20e5 + 3e5 * np.sin((2 + i) * truth["t"])
        out[f"pressure_{joint}_a [bar]"] = (truth["tau"][:, i] + AREA_B * p_b) / AREA_A / 1e5
        out[f"pressure_{joint}_b [bar]"] = p_b / 1e5
        out[f"voltage_{joint} [mV]"] = 6000 + 100 * truth["v"][:, i]
    return out


def write(folder, columns, *notes):
    """As a CSV, in columns of numbers that are read as they were."""
    path = folder / "measured.csv"
    rows = [",".join(map(repr, row)) for row in np.column_stack(list(columns.values())).tolist()]
    path.write_text("\n".join([*notes, ",".join(columns), *rows]) + "\n")
    return path


def close(found, expected, tolerance=1e-9):
    return np.abs(found - expected).max() < tolerance * np.abs(expected).max()


def test_strokes_and_forces_come_back(machine, columns, truth, tmp_path):
    recording = read_measured(machine, write(tmp_path, columns))
    assert recording.joints == machine.active
    assert recording.units == {"q1": "rad", "X1": "m", "X2": "m"}
    assert np.abs(recording.time - truth["t"]).max() < 1e-12
    assert np.abs(recording.q - truth["q"]).max() < 1e-12
    for i in range(3):
        assert close(recording.tau[:, i], truth["tau"][:, i])
    # rates by differences of the angles: of second order in the step of 10 ms
    assert close(recording.v[1:-1], truth["v"][1:-1], 1e-3)


LIFTING = Path(__file__).parents[2] / "shared" / "data" / "patu655" / "lifting_first_half.csv"


def test_a_chamber_that_is_sucked_empty_may_read_less_by_noise(machine, columns, truth, tmp_path):
    noise = np.random.default_rng(0).normal(size=len(truth["t"]))
    columns["pressure_X1_b [bar]"] = 0.05 + 0.1 * noise
    below = f"{(columns['pressure_X1_b [bar]'] < 0).sum()} of 401 samples"
    with pytest.warns(CraneWarning, match=f"'pressure_X1_b' is below a vacuum in {below}, by up "):
        recording = read_measured(machine, write(tmp_path, columns))
    assert recording["pressure_X1_b"].min() < 0  # as read
    columns["pressure_X1_b [bar]"] = -0.9 + 0.1 * noise
    with pytest.raises(RecordingError, match="count from a vacuum: to gauge pressures add 1e5"):
        read_measured(machine, write(tmp_path, columns))


@pytest.mark.skipif(not LIFTING.is_file(), reason="the recordings, ../shared/data, are not there")
def test_real_gauge_pressures_are_not_taken_for_noise():
    with LIFTING.open() as file:
        names, *rows = csv.reader(file)
    measured = np.array(rows, dtype=float)
    machine = crane.load("patu655")
    for less, refused in ((0.0, False), (1e5, True)):
        empty = measured[:, names.index("p2_Pa")] - less
        table = Table({"pressure_X_lift_b": "Pa"}, empty[:, None], {})
        with pytest.raises(RecordingError) if refused else nullcontext():
            check_pressures(machine, table)


def test_channels_are_kept_in_si(machine, columns, truth, tmp_path):
    recording = read_measured(machine, write(tmp_path, columns))
    assert recording.channel_units == {
        "q2": "rad", "q3": "rad",
        "pressure_X1_a": "Pa", "pressure_X1_b": "Pa", "voltage_X1": "V",
        "pressure_X2_a": "Pa", "pressure_X2_b": "Pa", "voltage_X2": "V",
    }  # fmt: skip
    assert close(recording.channels["q3"], truth["angles"]["q3"])
    assert close(recording.channels["voltage_X1"], 6 + 0.1 * truth["v"][:, 1])
    assert recording.channels["pressure_X2_b"][0] == pytest.approx(20e5, rel=1e-12)


def test_what_was_read_is_a_full_recording(machine, path, columns, tmp_path):
    recording = read_measured(machine, write(tmp_path, columns, "# task: pile"))
    assert (recording.machine, recording.task) == (str(path), "pile")
    recording.to_csv(tmp_path / "full.csv")
    for again in (
        Recording.read(tmp_path / "full.csv"),
        read_run(tmp_path / "full.csv", machine),
        read_run(tmp_path / "full.csv"),
    ):
        assert again.joints == recording.joints
        for name in ("time", "q", "v", "tau"):
            assert np.array_equal(getattr(again, name), getattr(recording, name))
        assert again.channel_units == recording.channel_units


def test_rates_of_angles_are_mapped_to_the_strokes(machine, columns, truth, tmp_path):
    for joint in ("q2", "q3"):
        columns[f"{joint}_velocity [deg/s]"] = np.rad2deg(truth["rates"][joint])
    columns["q1_velocity [rad/s]"] = truth["v"][:, 0]
    recording = read_measured(machine, write(tmp_path, columns))
    assert close(recording.v, truth["v"])
    assert recording.channel_units["q2_velocity"] == "rad/s"


def test_a_recorded_rate_of_a_stroke_is_taken(machine, columns, truth, tmp_path):
    columns["X2_velocity [mm/s]"] = 1e3 * truth["v"][:, 2] + 1.0
    recording = read_measured(machine, write(tmp_path, columns))
    assert np.abs(recording.v[:, 2] - truth["v"][:, 2] - 1e-3).max() < 1e-12


@pytest.mark.parametrize(
    "measured",
    [("X1", "q3"), ("q9", "q10"), ("q2", "X2"), ("q11", "q2"), ("q4", "q7"), ("X1", "X2")],
)
def test_any_joints_that_tell_the_posture(machine, columns, truth, tmp_path, measured):
    """Strokes and angles mixed, in any order of the columns."""
    del columns["q2 [deg]"], columns["q3 [deg]"]
    known = truth["angles"] | {"X1": truth["q"][:, 1], "X2": truth["q"][:, 2]}
    unit = {"X1": "m", "X2": "m"}
    columns |= {f"{joint} [{unit.get(joint, 'rad')}]": known[joint] for joint in measured}
    recording = read_measured(machine, write(tmp_path, columns))
    assert np.abs(recording.q - truth["q"]).max() < 1e-9
    for i, joint in enumerate(("X1", "X2"), start=1):
        if joint in measured:
            assert np.array_equal(recording.q[:, i], known[joint])


def test_measured_strokes_are_taken_as_they_are(machine, columns, truth, tmp_path):
    """Beyond their limits even, here in q1, while X1 and X2 follow from angles."""
    columns["q1 [deg]"] = 200.0 + columns["q1 [deg]"]
    recording = read_measured(machine, write(tmp_path, columns))
    assert recording.q[:, 0].min() > machine.upper[0]
    assert np.abs(recording.q[:, 1:] - truth["q"][:, 1:]).max() < 1e-12


def test_strokes_win_over_angles(machine, columns, truth, tmp_path):
    """Angles beside measured strokes become channels, whatever their values and unit."""
    columns["X1 [mm]"] = 1e3 * truth["q"][:, 1]
    columns["X2 [cm]"] = 1e2 * truth["q"][:, 2]
    columns["q2 [gon]"] = columns.pop("q2 [deg]") + 7.0
    recording = read_measured(machine, write(tmp_path, columns))
    assert np.abs(recording.q - truth["q"]).max() < 1e-15
    assert recording.channel_units["q2"] == "gon"


def test_the_first_angles_that_tell_something_new_count(machine, columns, truth, tmp_path):
    """q9 and q4 move with X1 alone: the second of them tells nothing, and may be wrong."""
    del columns["q2 [deg]"]
    columns = {
        "time [s]": truth["t"], "q9 [rad]": truth["angles"]["q9"], "q4 [rad]": 0 * truth["t"],
    } | {name: values for name, values in columns.items() if name != "time [ms]"}  # fmt: skip
    recording = read_measured(machine, write(tmp_path, columns))
    assert np.abs(recording.q - truth["q"]).max() < 1e-12


def test_a_recorded_force_wins_over_pressures(machine, columns, tmp_path):
    columns["X1_force [kN]"] = np.full(401, 0.05)
    recording = read_measured(machine, write(tmp_path, columns))
    assert (recording.tau[:, 1] == 50).all()


def test_a_locked_joint_needs_no_columns(path, columns, truth, tmp_path):
    planar = crane.load(path, lock={"q1": 0.0})
    del columns["q1 [deg]"], columns["q1_force [N m]"]
    recording = read_measured(planar, write(tmp_path, columns))
    assert recording.joints == ("X1", "X2")
    assert np.abs(recording.q - truth["q"][:, 1:]).max() < 1e-12


def test_other_joints_with_forces_are_joints_too(path, columns, truth, tmp_path):
    """What was held may be recorded as well; identification takes the joints that it needs."""
    planar = crane.load(path, lock={"q1": 0.0})
    recording = read_measured(planar, write(tmp_path, columns))
    assert recording.joints == ("X1", "X2", "q1")
    assert close(recording.tau[:, 2], truth["tau"][:, 0])


def test_machines_without_a_circuit_take_forces(mini, columns, truth, tmp_path):
    """Angles and forces: the electric mini forwarder."""
    columns = {name: x for name, x in columns.items() if not name.startswith("pressure")}
    columns |= {"X1_force [N]": truth["tau"][:, 1], "X2_force [N]": truth["tau"][:, 2]}
    recording = read_measured(mini, write(tmp_path, columns))
    assert np.abs(recording.q - truth["q"]).max() < 1e-12
    assert np.array_equal(recording.tau, truth["tau"])


def without(*names):
    return lambda columns, truth: [columns.pop(name) for name in names]


def renamed(old, new):
    return lambda columns, truth: columns.update({new: columns.pop(old)})


def changed(name, sample, value):
    return lambda columns, truth: columns[name].__setitem__(sample, value)


PRESSURE = "pressure_X1_a [bar]"
PASCAL = "'pressure_X1_a [Pa]' or 'pressure_X1_a [kPa]' or 'pressure_X1_a [MPa]' or "

# What is done to the columns, and the line that the user sees after the name of the file.
BROKEN = {
    "no unit of a pressure": (
        renamed(PRESSURE, "pressure_X1_a"),
        f"column 'pressure_X1_a' has no unit, give {PASCAL}'pressure_X1_a [bar]'",
    ),
    "unknown unit of a pressure": (
        renamed(PRESSURE, "pressure_X1_a [Torr]"),
        f"column 'pressure_X1_a' is in [Torr], give {PASCAL}'pressure_X1_a [bar]'",
    ),
    "negative pressure": (
        changed(PRESSURE, 17, -0.25),
        "'pressure_X1_a' is -25000 Pa at sample 17, but pressures count from a vacuum: "
        "to gauge pressures add 1e5 Pa",
    ),
    "one pressure": (
        renamed(PRESSURE, "pressure_X1 [bar]"),
        "column 'pressure_X1' does not say in which chamber, give 'pressure_X1_a' and "
        "'pressure_X1_b'",
    ),
    "one chamber": (
        without("pressure_X2_a [bar]"),
        "column 'pressure_X2_a' is missing beside 'pressure_X2_b', give it, or 'X2_force [N]'",
    ),
    "no pressures": (
        without("pressure_X2_a [bar]", "pressure_X2_b [bar]"),
        "column 'X2_force' is missing, give it in [N], or 'pressure_X2_a [Pa]' and "
        "'pressure_X2_b [Pa]'; or lock what was held, where it was: --lock X2=0.0108 (home)",
    ),
    "no torque of the slewing motor": (
        without("q1_force [N m]"),
        ": column 'q1_force' is missing, give it in [N m]",
    ),
    "pressures without a cylinder": (
        lambda columns, truth: columns.update(
            {"pressure_q1_a [bar]": 30 + columns.pop("q1_force [N m]")}
        ),
        "'mini_forwarder' has no cylinder that makes 'pressure_q1_a' a force, describe it under "
        "'hydraulics' in the machine file, or give 'q1_force [N m]'",
    ),
    "force in another unit": (
        renamed("q1_force [N m]", "q1_force [N]"),
        "column 'q1_force' is in [N], give 'q1_force [N m]' or 'q1_force [Nm]' or "
        "'q1_force [kN m]'",
    ),
    "no slewing angle": (
        without("q1 [deg]"),
        "'q1' is not determined, give 'q1 [rad]'; or lock what was held, where it was: "
        "--lock q1=0 (home)",
    ),
    "one angle too few": (
        without("q2 [deg]"),
        "'X1' is not determined, give 'X1 [m]', or a joint that moves with it "
        "(q4, q9, q2); or lock what was held, where it was: --lock X1=0.0221 (home)",
    ),
    "angle without a unit": (
        renamed("q3 [deg]", "q3"),
        "column 'q3' has no unit, give 'q3 [rad]' or 'q3 [deg]'",
    ),
    "angle in a unit of length": (
        renamed("q3 [deg]", "q3 [mm]"),
        "column 'q3' is in [m], give 'q3 [rad]' or 'q3 [deg]'",
    ),
    "rate in another unit": (
        lambda columns, truth: columns.update({"q2_velocity [mm/s]": truth["t"]}),
        "column 'q2_velocity' is in [m/s], give 'q2_velocity [rad/s]' or 'q2_velocity [rpm]' or "
        "'q2_velocity [deg/s]'",
    ),
    "wrong zero": (
        lambda columns, truth: columns["q2 [deg]"].__iadd__(60.0),
        " m, its limits are 0 and 0.03: see that zero and sign of q2, q3 are the machine's, and "
        "that none of them counts from the horizon (inclination_LINK)",
    ),
    "angles that no posture has": (
        lambda columns, truth: columns.update({"q4 [rad]": columns.pop("q2 [deg]") / 57 - 1.0}),
        "; see that zero and sign of q3, q4 are the machine's, and that none of them counts "
        "from the horizon (inclination_LINK)",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("change", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_recordings(machine, columns, truth, tmp_path, change, message):
    change(columns, truth)
    file = write(tmp_path, columns)
    with pytest.raises(RecordingError) as caught:
        read_measured(machine, file)
    line = str(caught.value)
    assert line.startswith(f"{file}: ") and line.count(str(file)) == 1
    assert line.endswith(message) and line.isprintable()


def test_everything_that_is_missing_is_told_at_once(machine, columns, tmp_path):
    for name in ("q1 [deg]", "q1_force [N m]", "q3 [deg]", "pressure_X2_a [bar]"):
        del columns[name]
    with pytest.raises(RecordingError) as caught:
        read_measured(machine, write(tmp_path, columns))
    line = str(caught.value)
    assert "'q1', 'X1' are not determined, give 'q1 [rad]', 'X1 [m]', or a joint" in line
    assert "); column 'q1_force' is missing, give it in [N m]; column" in line
    assert (
        "'pressure_X2_a' is missing beside 'pressure_X2_b', give it, or 'X2_force [N]'; or lock"
        in line
    )
    assert line.endswith("where it was: --lock q1=0 (home) --lock X1=0.0221 (home)")


@pytest.mark.parametrize("full", [True, False])
def test_sensors_that_disagree_are_told(machine, columns, truth, tmp_path, full):
    """The angle q3 beside the strokes, 3 degrees off on the mean and more where it is late."""
    late = np.interp(truth["t"] - 0.1, truth["t"], truth["angles"]["q3"])
    columns["q3 [deg]"] = np.rad2deg(late) + 3.0
    columns |= {"X1 [mm]": 1e3 * truth["q"][:, 1], "X2 [mm]": 1e3 * truth["q"][:, 2]}
    if full:
        columns |= {f"X{i} _force [N]".replace(" ", "", 1): truth["tau"][:, i] for i in (1, 2)}
    off = np.rad2deg(late - truth["angles"]["q3"]) + 3.0
    with pytest.warns(CraneWarning) as caught:
        read_measured(machine, write(tmp_path, columns))
    (line,) = [str(one.message) for one in caught if "disagree" in str(one.message)]
    assert line.startswith(
        "sensors disagree: 'q3' deviates from the value computed from X2 by "
        f"{off.mean():+.3g} deg on average ({off.min():+.3g} to {off.max():+.3g}); residual "
    )
    (numbers,) = re.findall(r"an offset and a delay \((.*?)\)", line)
    told = dict(part.split(" = ") for part in numbers.split(", "))
    assert float(told["sensor.q3.zero"]) == pytest.approx(np.deg2rad(3.0), abs=np.deg2rad(0.1))
    assert float(told["sensor.q3.delay"]) == pytest.approx(0.1, abs=0.01)


def test_strokes_do_not_depend_on_the_blocks(machine, columns, truth, tmp_path, monkeypatch):
    """Sample numbers in errors count from the first sample of the recording."""
    file = write(tmp_path, columns)
    whole = read_measured(machine, file)
    monkeypatch.setattr(measured_configurations, "_BLOCK_SAMPLES", 50)
    blocks = read_measured(machine, file)
    for name in ("q", "v", "tau"):
        assert close(getattr(blocks, name), getattr(whole, name), 1e-12)
    del columns["q3 [deg]"]
    columns["q10 [rad]"] = machine.closure.solve(truth["q"])[:, machine.column("q10")]
    columns["q10 [rad]"][333] += 2
    with pytest.raises(RecordingError, match=r"\(sample 333\).* zero and sign of q2, q10"):
        read_measured(machine, write(tmp_path, columns))


def test_nan_in_an_npz(machine, columns, tmp_path):
    for name, value in ((PRESSURE, np.nan), ("q2 [deg]", np.inf)):
        broken = columns | {name: np.where(np.arange(401) == 7, value, columns[name])}
        np.savez(tmp_path / "measured.npz", **broken)
        text = rf"measured.npz: '{name.split()[0]}' is {value} at sample 7, give finite numbers"
        with pytest.raises(RecordingError, match=text):
            read_measured(machine, tmp_path / "measured.npz")


def test_beyond_a_dead_centre(machine, columns, truth, tmp_path):
    """Where B, D and C are in line the stroke X1 is longest: two angles q9 for shorter ones."""
    in_line = oracles.angle(*(oracles.C - oracles.B)) - oracles.angle(*oracles.D_IN_2)
    del columns["q2 [deg]"], columns["q3 [deg]"]
    start = machine.home[machine.column("q9")]
    for end, beyond in ((in_line + 0.05, False), (in_line - 0.05, True)):
        q9 = start + (end - start) * truth["t"] / 4
        file = write(tmp_path, columns | {"q9 [rad]": q9, "X2 [m]": np.full(401, 0.0108)})
        with pytest.raises(RecordingError) as caught:
            read_measured(machine, file)
        if not beyond:
            assert "by q9 'X1' goes from 0.0221 to 0.04" in str(caught.value)
            continue
        first = int(np.argmax(q9 < in_line))
        assert str(caught.value) == (
            f"{file}: sample {first} is beyond a dead centre, where q1, X1, X2 do not determine "
            "the configuration: see that zero and sign of q9 are the machine's, and that none "
            "of them counts from the horizon (inclination_LINK), or cut the recording"
        )


class TestRuns:
    def test_a_run_is_completed_by_its_machine(self, machine, path, columns, truth, tmp_path):
        file = write(tmp_path, columns, f"# machine: {path}")
        for recording in (read_run(file), read_run(file, machine)):
            assert np.abs(recording.q - truth["q"]).max() < 1e-12

    def test_without_a_machine_forces_are_wanted(self, columns, tmp_path):
        del columns["q1_force [N m]"]
        file = write(tmp_path, columns)
        with pytest.raises(RecordingError, match="no active joint among the columns"):
            read_run(file)
        file = write(tmp_path, columns, "# machine: gone.yaml")
        with pytest.raises(CraneError, match="its machine is not found .* add --machine"):
            read_run(file)


def test_command_line(path, columns, tmp_path):
    """One way to read files: plot with a machine, identify with a joint locked."""
    del columns["q1 [deg]"]
    file = write(tmp_path, columns)
    identify = ("identify", path, file, "--out", "found")
    result = typed(*identify, cwd=tmp_path)
    assert result.returncode == 2 and not (tmp_path / "found").exists()
    assert f"error: {file}: 'q1' is not determined, give 'q1 [rad]'; or lock" in result.stderr
    result = typed(*identify, "--lock", "q1=0", cwd=tmp_path)
    assert "nothing tells" not in result.stderr
    columns["q1 [rad]"] = columns["time [ms]"] * 1e-4
    result = typed("plot", write(tmp_path, columns), "--machine", path, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "figure.png").is_file()
