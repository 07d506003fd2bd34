"""Recordings: validation, selection, conversion and files."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crane.common.errors import InputError, RecordingError
from crane.recordings.recording import Recording
from crane.recordings.recording_summary import recorded_machine_name


def make(**changes):
    """Three samples of a joint that turns and one that slides, with a tip and a reference."""
    values = {
        "time": [0.0, 0.1, 0.3],
        "joints": ("q1", "X1"),
        "q": [[0.0, 0.01], [0.1, 0.02], [0.2, 0.03]],
        "v": [[1.0, 0.1], [1.0, 0.1], [0.5, 0.05]],
        "tau": [[0.3, -16.0], [0.2, -17.0], [0.1, -18.0]],
        "units": {"q1": "rad", "X1": "m"},
        "channels": {"tip_x": [0.4, 0.5, 0.6], "valve": [0.0, 1.0, 0.0]},
        "channel_units": {"tip_x": "m"},
        "machine": "mini_forwarder",
        "task": "lift",
    }
    return Recording(**values | changes)


def assert_equal(one, two):
    assert one.joints == two.joints
    assert one.units == two.units
    assert one.channel_units == two.channel_units
    assert (one.machine, one.task) == (two.machine, two.task)
    for name in ("time", "q", "v", "tau"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert list(one.channels) == list(two.channels)
    for name in one.channels:
        np.testing.assert_array_equal(one.channels[name], two.channels[name])


def test_arrays_are_own_contiguous_copies():
    table = np.asfortranarray(np.arange(12.0).reshape(3, 4))
    recording = make(q=table[:, :2], time=[0, 1, 2])
    table[:] = -1.0
    np.testing.assert_array_equal(recording.q, [[0, 1], [4, 5], [8, 9]])
    for array in (recording.time, recording.q, recording.v, *recording.channels.values()):
        assert array.dtype == np.float64
        assert array.flags.c_contiguous
    assert recording.channel_units == {"tip_x": "m", "valve": ""}


def test_columns_go_by_their_names():
    recording = make(free=("q1",), tau=[[0, -16.0], [0, -17.0], [0, -18.0]])
    names = ["time", "q1", "X1", "q1_velocity", "X1_velocity", "X1_force", "tip_x", "valve"]
    assert list(recording) == names and "X1" in recording and "q1_force" not in recording
    np.testing.assert_array_equal(recording["X1_velocity"], [0.1, 0.1, 0.05])
    np.testing.assert_array_equal(recording["X1_force"], recording.tau[:, 1])
    np.testing.assert_array_equal(recording["tip_x"], [0.4, 0.5, 0.6])
    with pytest.raises(InputError, match="'X1_velocty' is not .*, did you mean 'X1_velocity'?"):
        recording["X1_velocty"]
    for wrong in (0, slice(2), recording.time < 0.2):
        with pytest.raises(InputError, match="go by names .*'between' and 'at'"):
            recording[wrong]


def test_written_file(tmp_path):
    make().to_csv(tmp_path / "run.csv")
    assert (tmp_path / "run.csv").read_text().splitlines() == [
        "# crane recording",
        "# machine: mini_forwarder",
        "# task: lift",
        "# crane samples: 3",
        "time [s],q1 [rad],X1 [m],q1_velocity [rad/s],X1_velocity [m/s],"
        "q1_force [N m],X1_force [N],tip_x [m],valve",
        "0.0,0.0,0.01,1.0,0.1,0.3,-16.0,0.4,0.0",
        "0.1,0.1,0.02,1.0,0.1,0.2,-17.0,0.5,1.0",
        "0.3,0.2,0.03,0.5,0.05,0.1,-18.0,0.6,0.0",
    ]


def test_noise_is_as_large_as_asked_for_and_leaves_nothing_exact():
    time = np.arange(0.0, 40.0, 0.01)
    q = np.column_stack([np.sin(time), 0.02 * np.cos(time)])
    v = np.column_stack([np.cos(time), -0.02 * np.sin(time)])
    channels = {"q2": time, "q2_velocity": 1 + 0 * time, "X_acceleration": -q[:, 1]}
    exact = Recording(
        time, ("q1", "X"), q, v, 30 * v, {"q1": "rad", "X": "m"}, channels,
        {"q2": "rad", "q2_velocity": "rad/s", "X_acceleration": "m/s2"}, free=(),
    )  # fmt: skip
    asked = {"X": 1e-5, "X_force": 0.05, "q1": 1e-4, "q2": 1e-3}
    noisy = exact.with_noise(asked, seed=3)
    off = {name: x - exact.columns()[name] for name, x in noisy.columns().items()}
    names = ["X", "X_force", "q1", "q2"]
    for name in names:  # of 4000 normal numbers: 5 deviations of their mean and size
        assert abs(off[name].std() / asked[name] - 1) < 5 / np.sqrt(8000)
        assert abs(off[name].mean() / asked[name]) < 5 / np.sqrt(4000)
    alike = np.corrcoef([off[name] for name in names]) - np.eye(4)
    assert np.abs(alike).max() < 5 / np.sqrt(4000)
    assert not off["time"].any() and not off["q1_force"].any()
    np.testing.assert_array_equal(noisy.v, np.gradient(noisy.q, time, axis=0))
    assert list(noisy.channels) == ["q2"]
    back = dict(reversed(asked.items()))
    np.testing.assert_array_equal(noisy.q, exact.with_noise(back, seed=3).q)
    assert not np.array_equal(noisy.q, exact.with_noise(asked, seed=4).q)
    measured = exact.with_noise({"X_velocity": 1e-3, "q2_velocity": 0.0})
    assert 9e-4 < (measured.v - exact.v)[:, 1].std() < 1.1e-3
    assert list(measured.channels) == ["q2", "q2_velocity"]


@pytest.mark.parametrize(
    ("deviations", "message"),
    [
        ({"X2": 1.0}, "noise of the column 'X2', "),
        ({"time": 1.0}, "noise of the column 'time', "),
        ({"q1": -1.0}, "the noise of 'q1' is -1, it must not be negative"),
    ],
)
def test_noise_that_cannot_be(deviations, message):
    one = Recording([0.0], ("q1",), [[0.0]], [[0.0]], [[0.0]], {"q1": "rad"})
    with pytest.raises(InputError) as caught:
        one.with_noise(deviations)
    assert str(caught.value).startswith(message)


words = st.text(
    st.characters(exclude_characters=',[]"#', categories=("L", "N", "P", "S", "Zs")),
    min_size=1,
    max_size=8,
).filter(lambda text: text == text.strip() and text.isprintable())
numbers = st.floats(-1e30, 1e30)  # larger ones are refused when they are read


@st.composite
def recordings(draw):
    suffixes = ("_velocity", "_force")
    names = words.filter(lambda name: name != "time" and not name.endswith(suffixes))
    names = draw(st.lists(names, min_size=1, max_size=6, unique=True))
    split = draw(st.integers(1, len(names)))
    joints, channels = tuple(names[:split]), names[split:]
    count = draw(st.integers(1, 5))

    def table(width):
        row = st.lists(numbers, min_size=width, max_size=width)
        return draw(st.lists(row, min_size=count, max_size=count))

    return Recording(
        time=sorted(draw(st.lists(numbers, min_size=count, max_size=count, unique=True))),
        joints=joints,
        q=table(split),
        v=table(split),
        tau=table(split),
        units={name: draw(st.sampled_from(["rad", "m"])) for name in joints},
        channels={name: [row[0] for row in table(1)] for name in channels},
        channel_units={name: draw(words | st.just("")) for name in channels},
        machine=draw(words | st.just("")),
        task=draw(words | st.just("")),
    )


@settings(deadline=None)
@given(recordings())
def test_any_recording_survives_the_round_trip(tmp_path_factory, recording):
    path = tmp_path_factory.mktemp("run") / "run.csv"
    recording.to_csv(path)
    assert_equal(Recording.from_csv(path), recording)


def test_errors_are_references_less_coordinates():
    channels = {"reference_X1": [0.02] * 3, "q2": [0.5, 0.6, 0.7], "reference_q2": [1.0] * 3}
    recording = make(channels=channels, channel_units={})
    np.testing.assert_allclose(recording.error("X1"), [0.01, 0.0, -0.01], atol=1e-15)
    np.testing.assert_allclose(recording.error("q2"), [0.5, 0.4, 0.3], atol=1e-15)
    with pytest.raises(RecordingError, match="^'q1' has no reference in this recording, known"):
        recording.error("q1")
    with pytest.raises(RecordingError, match="recording, the run followed none$"):
        make().error("X1")


def test_a_machine_s_own_name_is_kept_where_its_file_has_another(tmp_path):
    for name, machine, noted in (
        ("Crane No. 1", "/there/my.yaml", True), ("my", "/there/my.yaml", False),
        ("patu655", 'patu655 with {"lock": {"slew": 0.0}}', False),
    ):  # fmt: skip
        recording = make(machine=machine, machine_name=name)
        for file in (tmp_path / "a.csv", tmp_path / "a.npz"):
            (recording.to_csv if file.suffix == ".csv" else recording.to_npz)(file)
            assert Recording.read(file).machine_name == (name if noted else "")
            assert recorded_machine_name(Recording.read(file)) == name
    assert recorded_machine_name(make(machine="/there/my.yaml")) == "my"


BROKEN = {
    "q transposed": ({"q": np.zeros((2, 3))}, "q has the shape (2, 3), give (3, 2), a column"),
    "time in a column": ({"time": [[0.0], [1.0], [2.0]]}, "time has the shape (3, 1), give (3,)"),
    "text": ({"tau": [["a", "b"]] * 3}, "tau is not an array of numbers, give (3, 2)"),
    "short channel": ({"channels": {"valve": [1.0]}, "channel_units": {}}, "channel 'valve' has"),
    "nan": ({"q": [[0, 0], [0, np.nan], [0, 0]]}, "'X1' is nan at sample 1, give finite numbers"),
    "nan in time": ({"time": [0.0, np.nan, 1.0]}, "'time' is nan at sample 1"),
    "time goes back": ({"time": [0.0, -1.0, 2.0]}, "time goes from 0.0 to -1.0 s at sample 1"),
    "no joints": (
        {"joints": (), "units": {}, **dict.fromkeys(("q", "v", "tau"), np.zeros((3, 0)))},
        "no active joint among the columns",
    ),
    "a joint twice": (
        {"joints": ("X1", "X1"), "units": {"X1": "m"}},
        "column 'X1' is there twice, rename or remove one",
    ),
    "no unit": ({"units": {"q1": "rad"}}, "units are for 'q1', give 'q1', 'X1'"),
    "degrees": (
        {"units": {"q1": "deg", "X1": "m"}},
        "column 'q1' is in [deg], give 'q1 [rad]' or 'q1 [m]'",
    ),
    "unit of nothing": ({"channel_units": {"tipx": "m"}}, "unit of the channel 'tipx', did you"),
    "a channel named time": (
        {"channels": {"time": [0, 1, 2]}, "channel_units": {}},
        "column 'time' is there twice",
    ),
    "channels like a joint": (
        {
            "channels": dict.fromkeys(("q2", "q2_velocity", "q2_force"), [0, 1, 2]),
            "channel_units": {},
        },
        "channels 'q2', 'q2_velocity', 'q2_force' hold an active joint, rename those",
    ),
    "channels like part of a joint": (
        {"channels": dict.fromkeys(("q2_force", "q2_velocity"), [0, 1, 2]), "channel_units": {}},
        "column 'q2' is missing beside 'q2_velocity', 'q2_force', add it, or rename",
    ),
    "comma in a name": (
        {"channels": {"a,b": [0, 1, 2]}, "channel_units": {}},
        "'a,b' cannot be the name of a column",
    ),
    "bracket in a unit": ({"channel_units": {"tip_x": "m]"}}, "'m]' cannot be the unit of a"),
    "two lines": ({"task": "lift\nreturn"}, "task 'lift\\nreturn' is not one line of text"),
}


@pytest.mark.parametrize(("changes", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_recordings(changes, message):
    with pytest.raises(RecordingError) as caught:
        make(**changes)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_samples():
    empty = np.zeros((0, 2))
    with pytest.raises(RecordingError, match="no samples, give at least one"):
        make(time=[], q=empty, v=empty, tau=empty, channels={}, channel_units={})


def test_changed_copies_are_checked_too():
    assert replace(make(), task="return").task == "return"
    with pytest.raises(RecordingError, match="time goes from"):
        replace(make(), time=[2.0, 1.0, 0.0])


HEAD = "time [s],q1 [rad],q1_velocity [rad/s],q1_force [N m]"


def from_text(tmp_path, text):
    path = tmp_path / "run.csv"
    path.write_text(text)
    return Recording.from_csv(path)


def test_order_of_columns_is_free(tmp_path):
    recording = from_text(
        tmp_path,
        "b_force [N],a_velocity [rad/s],load,b [m],time [s],a [rad],b_velocity [m/s],"
        "a_force [N m]\n"
        "1,2,3,4,5,6,7,8\n",
    )
    assert recording.joints == ("b", "a")
    assert recording.time == [5]
    np.testing.assert_array_equal(recording.q, [[4, 6]])
    np.testing.assert_array_equal(recording.v, [[7, 2]])
    np.testing.assert_array_equal(recording.tau, [[1, 8]])
    assert recording.units == {"b": "m", "a": "rad"}
    assert list(recording.channels) == ["load"]
    assert (recording.machine, recording.task) == ("", "")


def test_joints_that_are_not_active_are_channels(tmp_path):
    """With their rates beside them, and written and read again as such."""
    recording = from_text(tmp_path, f"{HEAD},q2 [rad],q2_velocity [rad/s]\n0,1,2,3,4,5\n")
    assert recording.joints == ("q1",)
    assert recording.channel_units == {"q2": "rad", "q2_velocity": "rad/s"}
    recording.to_csv(tmp_path / "again.csv")
    assert_equal(Recording.from_csv(tmp_path / "again.csv"), recording)


def test_units_are_converted(tmp_path):
    recording = from_text(
        tmp_path,
        "time [ms],q1 [deg],q1_velocity [deg/s],q1_force [kN m],pressure_q1_a [bar]\n"
        "250,180,-90,2,66\n",
    )
    assert (recording.time, recording.q, recording.v) == (0.25, np.pi, -np.pi / 2)
    assert recording.tau == 2000.0 and recording.units == {"q1": "rad"}
    assert recording.channels["pressure_q1_a"] == 66e5
    assert recording.channel_units == {"pressure_q1_a": "Pa"}


BROKEN_FILES = {
    "no force": (
        "time [s],q1 [rad],q1_velocity [rad/s]\n0,1,2\n",
        "no active joint among the columns 'time', 'q1', 'q1_velocity', give for each joint",
    ),
    "no displacement": (
        "time [s],q1_velocity [rad/s],q1_force [N m]\n0,1,2\n",
        "column 'q1' is missing beside 'q1_velocity', 'q1_force'",
    ),
    "gradians": (
        f"{HEAD}\n0,1,2,3\n".replace("[rad]", "[gon]"),
        "column 'q1' is in [gon], give 'q1 [rad]'",
    ),
    "no unit": (
        f"{HEAD}\n0,1,2,3\n".replace(" [rad]", ""),
        "column 'q1' has no unit, give 'q1 [rad]'",
    ),
    "velocity of another kind": (
        f"{HEAD}\n0,1,2,3\n".replace("[rad/s]", "[m/s]"),
        "column 'q1_velocity' is in [m/s], give 'q1_velocity [rad/s]'",
    ),
    "tab in a note": (f"# task: a\tb\n{HEAD}\n0,1,2,3\n", "task 'a\\tb' is not one line of text"),
}


@pytest.mark.parametrize(("text", "message"), BROKEN_FILES.values(), ids=BROKEN_FILES.keys())
def test_broken_files(tmp_path, text, message):
    with pytest.raises(RecordingError) as caught:
        from_text(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'run.csv'}: ")
    assert str(caught.value).count("run.csv") == 1
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("others", "proposed"),
    [
        ("X_velocity [m/s],X_force [N]", "'X [m]'"),
        ("X_force [N]", "'X [m]'"),
        ("X_force [N m]", "'X [rad]'"),
        ("X_velocity [m/s],X_force [N m]", "'X [rad]' or 'X [m]'"),  # which tell nothing
    ],
)
def test_units_that_fit_the_other_columns_are_proposed(tmp_path, others, proposed):
    with pytest.raises(RecordingError) as caught:
        from_text(tmp_path, f"time [s],X [foo],{others}\n0,1,2{',3' * others.count(',')}\n")
    told = str(caught.value).partition("run.csv: ")[2]
    assert told == f"column 'X' is in [foo], give {proposed}"


def test_velocities_may_be_missing(tmp_path):
    """They are the derivatives of the displacements then."""
    time = np.linspace(0, 2, 401)
    path = tmp_path / "strokes.csv"
    rows = np.column_stack([time, np.sin(time), np.cos(3 * time)])
    np.savetxt(path, rows, delimiter=",", header="time [s],X1 [m],X1_force [N]", comments="")
    read = Recording.from_csv(path)
    assert read.joints == ("X1",)
    np.testing.assert_allclose(read.v[1:-1, 0], np.cos(time[1:-1]), atol=1e-5)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"time [s]": [0, 1], "X1 [m]": [0, 1, 2], "X1_force [N]": [0, 1, 2]},
            "'time .s.' has the",
        ),
        ({"time [s]": ["a", "b"]}, "'time .s.' has the shape"),
        ({}, "holds no samples"),
        ({"time": [0, 1], "X1 [m]": [0, 1], "X1_force [N]": [0, 1]}, "column 'time' has no unit"),
        ({"time [s]": [0, 1], "X1_force [N]": [0, 1]}, "no active joint among"),
        ({"time [s]": [0, np.nan], "X1 [m]": [0, 1], "X1_force [N]": [0, 1]}, "'time' is nan"),
    ],
)
def test_wrong_npz(tmp_path, columns, message):
    np.savez(tmp_path / "run.npz", **{k: np.array(v) for k, v in columns.items()})
    with pytest.raises(RecordingError, match=message):
        Recording.read(tmp_path / "run.npz")
    (tmp_path / "text.npz").write_text("no zip")
    for name, text in (
        ("text.npz", "is no npz file"),
        ("no.npz", "no such file"),
        ("a.txt", "csv or"),
    ):
        with pytest.raises(RecordingError, match=text):
            Recording.read(tmp_path / name)
