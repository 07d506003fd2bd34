"""Measured valve signals replayed on the model."""

from dataclasses import replace

import numpy as np
import pytest
from hydraulic_rig import COMPENSATED, rig

import crane
from crane.common.errors import CraneError, CraneWarning, RecordingError
from crane.control import ValveSignals, interpolate_references
from crane.description.external_forces import TIP_WRENCH_NAME
from crane.recordings import timeseries
from crane.recordings.timeseries import Table
from crane.simulation.recording_replay import ChannelComparison, replay


@pytest.fixture
def measured(tmp_path):
    """A rig's file, from a simulation that begins before the file does."""
    machine = rig(tmp_path, COMPENSATED, supply={"pressure": 1.2e7})
    times = np.linspace(0, 4, 41)
    signals = ValveSignals(machine, times, {"x": 5.8 - 0.9 * np.sin(2 * np.pi * times / 2)})
    recording = crane.simulate(machine, signals, duration=4.0)
    return machine, recording


def write(path, columns, units):
    timeseries.write_table(path, Table(units, np.column_stack(list(columns.values())), {}))
    return path


def columns_of(recording, start=0, every=1):
    chosen = slice(start, None, every)
    columns = {
        "time": recording.time[chosen] + 12.5,
        "x": 1e3 * recording.q[chosen, 0],
        "x_velocity": recording.v[chosen, 0],
        "voltage_x": recording.channels["voltage_x"][chosen],
        "pressure_x_a": recording.channels["pressure_x_a"][chosen] / 1e5,
        "pressure_x_b": recording.channels["pressure_x_b"][chosen] / 1e5,
        "pressure_supply": recording.channels["pressure_supply"][chosen],
    }
    units = dict(zip(columns, ("s", "mm", "m/s", "V", "bar", "bar", "Pa"), strict=True))
    return columns, units


def test_the_model_s_own_recording_comes_back(tmp_path, measured):
    """From a lift on, in mm and bar, with a clock of its own: everything as it was."""
    machine, recording = measured
    path = write(tmp_path / "file.csv", *columns_of(recording, start=300))
    again, comparison = replay(machine, path)
    rows = {channel.name: channel for channel in comparison.channels}
    assert set(rows) == {"x", "x_velocity", "pressure_x_a", "pressure_x_b"}
    assert rows["x"].rms < 1e-7
    assert rows["pressure_x_a"].rms < 2e3
    assert rows["x"].relative_rms < 1e-5
    assert again.time[-1] == pytest.approx(3.7)
    assert again.task == "file"
    assert np.ptp(recording.q[300:, 0]) > 0.005


def test_lost_samples_over_which_a_signal_changes_are_told(tmp_path, measured):
    machine, recording = measured
    columns, units = columns_of(recording)
    kept = np.abs(recording.time - 2.0) > 0.1005
    columns = {name: x[kept] for name, x in columns.items()}
    path = write(tmp_path / "file.csv", columns, units)
    told = r"^no samples between 14\.399 and 14\.601 s, over which the signal of 'x' is"
    with pytest.warns(CraneWarning, match=told) as caught:
        replay(machine, path)
    assert len(caught) == 1
    columns["voltage_x"] = 0.0 * columns["voltage_x"] + 5.8  # nothing is interpolated
    replay(machine, write(tmp_path / "constant.csv", columns, units))


def test_measured_strokes_beyond_the_limits_are_told(tmp_path, measured):
    """A bump of the sensor to 600 mm, the stroke being 535 mm; noise of 1 mm is none."""
    machine, recording = measured
    columns, units = columns_of(recording)
    columns["x"] = columns["x"] + np.where(np.abs(recording.time - 2) < 0.0105, 400.0, 0.0)
    top = columns["x"].max()
    path = write(tmp_path / "file.csv", columns, units)
    told = rf"measured 'x' goes to {top / 1e3:.6g} m at t = "
    with pytest.warns(CraneWarning, match=told) as caught:
        replay(machine, path)
    assert "beyond its limit 0.535 m: look at the limits" in str(caught[0].message)


def test_a_wrong_model_shows(tmp_path, measured):
    """RMS error and its share of the variation, against numpy."""
    machine, recording = measured
    path = write(tmp_path / "file.csv", *columns_of(recording, every=10))
    slower = machine.replace(hydraulics=crane.load(_slower(tmp_path)).hydraulics)
    again, comparison = replay(slower, path)
    x = next(channel for channel in comparison.channels if channel.name == "x")
    gap = np.interp(recording.time[::10], again.time, again.q[:, 0]) - recording.q[::10, 0]
    assert x.rms == pytest.approx(np.sqrt(np.mean(gap**2)), rel=1e-9)
    assert x.relative_rms == pytest.approx(x.rms / np.std(recording.q[::10, 0]), rel=1e-9)
    assert x.relative_rms > 0.05
    assert f"| x | m | {x.rms:.4g} |" in comparison.to_markdown()


def _slower(folder):
    other = folder / "slower"
    other.mkdir()
    rig(other, {**COMPENSATED, "flow": 20 / 6e4}, supply={"pressure": 1.2e7})
    return other / "rig.yaml"


def test_measured_pressures_of_supply_and_tank_drive_it(tmp_path, measured):
    """A supply that fails half-way: the load stops rising."""
    machine, _ = measured
    time = np.linspace(0, 4, 401)
    columns = {
        "time": time,
        "x": np.full(401, 0.2),
        "voltage_x": np.full(401, 5.0),
        "pressure_supply": np.where(time < 2, 1.2e7, 1e5),
        "pressure_tank": np.full(401, 3e5),
    }
    units = dict(zip(columns, ("s", "m", "V", "Pa", "Pa"), strict=True))
    again, _ = replay(machine, write(tmp_path / "file.csv", columns, units))
    speed = again.v[:, 0]
    assert speed[1800] == pytest.approx(14.6e-3, rel=0.02)
    assert abs(speed[-200:]).max() < 1e-4
    assert again.channels["pressure_tank"] == pytest.approx(3e5)
    assert again.channels["pressure_supply"][-1] == 1e5


def test_angles_serve_as_well_as_strokes(tmp_path):
    """A crane with an angle sensor at the boom, in degrees."""
    machine = crane.load("patu655", lock={"slew": 0.0})
    recording = crane.simulate(machine, crane.joystick(machine, "stir"), duration=6.0)
    columns = {
        "time": recording.time,
        "q2": np.degrees(recording.channels["q2"]),
        "X_tilt": recording.q[:, 1],
        "X_ext": recording.q[:, 2],
        "voltage_slew": np.full(len(recording.time), 5.8),
        "voltage_X_lift": recording.channels["voltage_X_lift"],
        "voltage_X_ext": recording.channels["voltage_X_ext"],
    }
    units = dict(zip(columns, ("s", "deg", "m", "m", "V", "V", "V"), strict=True))
    _, comparison = replay(machine, write(tmp_path / "file.csv", columns, units))
    rows = {channel.name: channel.rms for channel in comparison.channels}
    assert set(rows) == {"q2", "X_tilt", "X_ext"}
    assert max(rows.values()) < 1e-4


@pytest.mark.parametrize("rates", [True, False])
def test_a_noisy_rest_is_a_rest(tmp_path, measured, rates):
    """Half a second before the valve opens, 0.2 mm of noise: by differences up to 20 mm/s."""
    machine, recording = measured
    columns, units = columns_of(recording, every=10)
    rest = 50
    columns = {name: np.concatenate([np.repeat(x[:1], rest), x]) for name, x in columns.items()}
    columns["time"] = 0.01 * np.arange(len(columns["x"]))
    rng = np.random.default_rng(4)
    columns["x"] += 0.2 * rng.normal(size=len(columns["x"]))  # [mm]
    columns["x_velocity"] += 0.02 * rng.normal(size=len(columns["x"]))
    if not rates:
        del columns["x_velocity"]
    path = write(tmp_path / "file.csv", columns, {name: units[name] for name in columns})
    again, comparison = replay(machine, path)
    assert again.v[0, 0] == 0
    assert abs(again.q[0, 0] - recording.q[0, 0]) < 1e-4
    x = next(channel for channel in comparison.channels if channel.name == "x")
    assert x.rms < 4e-4


def test_a_noisy_start_in_motion_keeps_its_velocity(tmp_path, measured):
    machine, recording = measured
    columns, units = columns_of(recording, start=300)
    rng = np.random.default_rng(5)
    columns["x"] = columns["x"] + 0.05 * rng.normal(size=len(columns["x"]))
    columns["x_velocity"] = columns["x_velocity"] + 0.01 * rng.normal(size=len(columns["x"]))
    again, _ = replay(machine, write(tmp_path / "file.csv", columns, units))
    assert abs(again.v[0, 0] - recording.v[300, 0]) < 5e-3
    assert abs(again.q[0, 0] - recording.q[300, 0]) < 2e-5


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda c, u: c.pop("voltage_x"), "no signal of a valve, give at least one of 'voltage_x"),
        (lambda c, u: c.update(voltage_y=c.pop("voltage_x")), "'voltage_y' is of no valve"),
        (lambda c, u: c["voltage_x"].__setitem__(3, np.nan), "'' is not a finite number"),
        (lambda c, u: c["pressure_x_a"].__setitem__(0, -3.0), "count from a vacuum: to gauge"),
        (lambda c, u: c["pressure_x_b"].__setitem__(5, -3.0), "is -300000 Pa at sample 5, but"),
        (lambda c, u: c.update(pressure_tank=c["x"] - 1e3), "'pressure_tank' has no unit"),
        (lambda c, u: c["pressure_supply"].__setitem__(7, -1.0), "'pressure_supply' is -1 Pa at"),
        (lambda c, u: u.update(voltage_x="bar"), "'voltage_x' is in [Pa], give 'voltage_x [V]'"),
        (
            lambda c, u: u.update(pressure_x_a="m"),
            "'pressure_x_a' is in [m], give 'pressure_x_a [Pa",
        ),
        (lambda c, u: (c.update(kinetic=c["x"]), u.update(kinetic="V")), "give 'kinetic [J]'"),
        (lambda c, u: c["x"].__setitem__(0, 9e3), "outside of its limits"),
        (lambda c, u: c.pop("pressure_x_b"), "'pressure_x_b' is missing beside 'pressure_x_a'"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, measured, change, line):
    machine, recording = measured
    columns, units = columns_of(recording, every=100)
    columns = {name: values.copy() for name, values in columns.items()}
    change(columns, units)
    units = {name: units.get(name, "V" if name == "voltage_y" else "") for name in columns}
    path = write(tmp_path / "file.csv", columns, units)
    with pytest.raises(CraneError) as caught:
        replay(machine, path)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path)) or "limits" in line


@pytest.mark.parametrize("step", [0.0, -1.0, np.nan])
def test_steps_that_cannot_be_are_refused(tmp_path, measured, step):
    machine, recording = measured
    path = write(tmp_path / "file.csv", *columns_of(recording, every=100))
    with pytest.raises(CraneError, match="the step is .* s, give a number above 0"):
        replay(machine, path, step)


def test_rounding_of_a_channel_at_rest_is_no_variation():
    """-45 deg in rad vary by 1e-16: the error is not 1e14 times that."""
    resting = np.full(101, np.radians(-45.0))
    assert ChannelComparison("q3", "rad", resting, resting + 1e-3).relative_rms == np.inf


def test_one_sample_and_other_machines_are_refused(tmp_path, measured):
    machine, recording = measured
    columns, units = columns_of(recording)
    one = write(tmp_path / "one.csv", {k: v[:1] for k, v in columns.items()}, units)
    with pytest.raises(RecordingError, match=r"one\.csv: has one sample, give at least two"):
        replay(machine, one)
    with pytest.raises(CraneError, match="columns are missing: 'q1_force', 'X1_force'"):
        replay(crane.load("mini_forwarder"), one)


def test_a_closed_loop_that_was_pushed_at_its_tip_is_repeated(tmp_path):
    machine = crane.load("mini_forwarder")
    times, home = np.array([0.0, 0.1, 0.2, 0.3]), machine.home[machine.closure.active]
    force = np.array([[0.0, 0, 0], [0, 0, 0], [0, 2, -5], [0, 0, 0]])
    law = interpolate_references(
        crane.control.make_controller("pi", machine),
        times,
        home + np.linspace(0, 0.01, 4)[:, None],
    )
    pushed = machine.with_external_forces(
        crane.Wrench(machine.tip, force, times=times, name=TIP_WRENCH_NAME)
    )
    run = crane.simulate(pushed, law, duration=0.3, step=0.01)
    channels = dict(zip(law.reference_units, law.references(run.time).T, strict=True))
    units = run.channel_units | law.reference_units
    replace(run, channels=run.channels | channels, channel_units=units).to_csv(
        tmp_path / "run.csv"
    )
    again, _ = crane.replay(machine, tmp_path / "run.csv", 0.01, controller="pi")
    assert np.abs(again.q - run.q).max() < 1e-9 * np.ptp(run.q)
    released, _ = crane.replay(
        machine.with_external_forces(crane.Wrench(machine.tip, name=TIP_WRENCH_NAME)),
        tmp_path / "run.csv", 0.01, controller="pi",
    )  # fmt: skip
    assert np.abs(released.q - run.q).max() > 1e-6
