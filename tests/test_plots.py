"""Figures of recordings: curves, labels, formats, and names that appear as they are."""

import re
import subprocess
import sys
from dataclasses import replace
from string import ascii_lowercase
from types import SimpleNamespace

import numpy as np
import pytest
from broken_machines import DATA
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import crane
from crane.common.errors import OutputError
from crane.recordings.recording import Recording
from crane.view.plots import figure_style
from crane.view.plots.calibration_figure import comparison_figure
from crane.view.plots.figure_style import escape_label, joint_symbol, write_figure
from crane.view.plots.identification_figures import correlation_figure
from crane.view.plots.recording_figure import recording_figure
from crane.view.result_files import plot_result
from crane.view.sketches.sketch_figure import sketch

SIGNATURES = {".png": b"\x89PNG\r\n", ".svg": b"<?xml", ".pdf": b"%PDF"}


@pytest.fixture
def recording():
    """A joint that turns and one that slides, both with references, and the tip with its own."""
    time = np.linspace(0, 2, 201)
    q = np.column_stack([np.sin(time), 0.02 + 0.01 * np.cos(time)])
    v = np.column_stack([np.cos(time), -0.01 * np.sin(time)])
    tip = np.column_stack([np.cos(time), np.sin(time), 0.1 * time])
    channels = {"reference_q1": q[:, 0] + 0.1, "reference_X1": q[:, 1] - 0.001}
    channels |= {"reference_velocity_q1": v[:, 0] + 0.2}
    channels |= {f"tip_{axis}": tip[:, i] for i, axis in enumerate("xyz")}
    channels |= {f"reference_tip_{axis}": tip[:, i] - 0.01 for i, axis in enumerate("xyz")}
    return Recording(
        time=time,
        joints=("q1", "X1"),
        q=q,
        v=v,
        tau=np.column_stack([0.3 * time, -20 * time]),
        units={"q1": "rad", "X1": "m"},
        channels=channels,
        machine="mini_forwarder",
        task="loading",
    )


def without(recording, *prefixes):
    channels = {x: y for x, y in recording.channels.items() if not x.startswith(prefixes)}
    return Recording(
        recording.time,
        recording.joints,
        recording.q,
        recording.v,
        recording.tau,
        recording.units,
        channels,
    )


def panels(figure):
    """Axes over time by their place in the grid (row, column)."""
    flat = [axes for axes in figure.axes if axes.name == "rectilinear"]
    return {
        (axes.get_subplotspec().rowspan.start, axes.get_subplotspec().colspan.start): axes
        for axes in flat
    }


def curve(axes, label):
    (line,) = (line for line in axes.get_lines() if line.get_label() == label)
    return np.asarray(line.get_data())


def test_displacements_velocities_and_forces(recording):
    grid = panels(recording_figure(recording))
    expected = {
        (0, 0): ("angle [deg]", np.rad2deg(recording.q[:, 0])),
        (0, 1): ("displacement [mm]", 1e3 * recording.q[:, 1]),
        (1, 0): ("velocity [deg/s]", np.rad2deg(recording.v[:, 0])),
        (1, 1): ("velocity [mm/s]", 1e3 * recording.v[:, 1]),
        (2, 0): ("torque [N m]", recording.tau[:, 0]),
        (2, 1): ("force [N]", recording.tau[:, 1]),
        (3, 0): ("error [deg]", np.full(201, np.rad2deg(0.1))),
        (3, 1): ("error [mm]", np.full(201, -1.0)),
    }
    for place, (label, values) in expected.items():
        assert grid[place].get_ylabel() == label
        time, drawn = curve(grid[place], "recording")
        np.testing.assert_array_equal(time, recording.time)
        np.testing.assert_allclose(drawn, values, rtol=1e-14 if place[0] < 3 else 1e-12)
        low, high = grid[place].get_ylim()
        assert low < values.min() and values.max() < high
        assert grid[place].get_xlim() == (recording.time[0], recording.time[-1])
    assert [grid[0, i].get_title() for i in (0, 1)] == [joint_symbol("q1"), joint_symbol("X1")]
    assert [grid[3, i].get_xlabel() for i in (0, 1)] == ["time [s]"] * 2
    assert [grid[0, i].get_xlabel() for i in (0, 1)] == [""] * 2


def test_references_are_dashed_and_told_apart(recording):
    figure = recording_figure(recording)
    grid = panels(figure)
    expected = {
        (0, 0): np.rad2deg(recording.channels["reference_q1"]),
        (0, 1): 1e3 * recording.channels["reference_X1"],
        (1, 0): np.rad2deg(recording.channels["reference_velocity_q1"]),
    }
    for place, axes in grid.items():
        references = [line for line in axes.get_lines() if line.get_label() == "reference"]
        assert len(references) == (place in expected)
        for line in references:
            np.testing.assert_allclose(line.get_ydata(), expected[place], rtol=1e-14)
            assert line.is_dashed()
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["recording", "reference"]
    assert figure.get_suptitle() == "mini_forwarder: loading"


def test_path_of_the_tip(recording):
    figure = recording_figure(recording)
    (space,) = (axes for axes in figure.axes if axes.name == "3d")
    assert (space.get_xlabel(), space.get_ylabel(), space.get_zlabel()) == (
        "x [m]",
        "y [m]",
        "z [m]",
    )
    lines = {line.get_label(): line.get_data_3d() for line in space.get_lines()}
    for label, prefix in (("recording", "tip"), ("reference", "reference_tip")):
        for axis, values in zip("xyz", lines[label], strict=True):
            np.testing.assert_array_equal(values, recording.channels[f"{prefix}_{axis}"])
    assert np.ravel(lines["start"]) == pytest.approx([1, 0, 0])
    assert np.ravel(lines["end"]) == pytest.approx([np.cos(2), np.sin(2), 0.2])
    limits = np.diff([space.get_xlim(), space.get_ylim(), space.get_zlim()]).ravel()
    aspect = space._box_aspect / space._box_aspect[0]
    np.testing.assert_allclose(aspect, limits / limits[0])
    error = panels(figure)[2, 2]
    assert error.get_ylabel() == "tip to reference [mm]"
    np.testing.assert_allclose(curve(error, "recording")[1], 10 * np.sqrt(3))


@pytest.mark.parametrize(
    ("sizes", "plane"),
    [
        ((1.0, 0.0, 0.5), "xz"),
        ((1.0, 0.5, 0.004), "xy"),
        ((1e-17, 1.0, 0.5), "yz"),
        ((1.0, 0.0, 0.0), "xz"),  # straight
        ((0.0, 1.0, 0.0), "yz"),
        ((0.0, 0.0, 1.0), "xz"),
        ((1.0, 0.5, 0.02), ""),
    ],
)
def test_a_path_in_a_plane_is_drawn_in_it(recording, sizes, plane):
    tip = (
        3.0
        + np.array(sizes)
        * np.column_stack([np.cos(recording.time), recording.time**2, 0 * recording.time]).cumsum(
            axis=0
        )
        / 100
    )
    tip[:, 2] = 3.0 + sizes[2] * np.sin(recording.time)
    channels = recording.channels | {f"tip_{axis}": tip[:, i] for i, axis in enumerate("xyz")}
    channels |= {f"reference_tip_{axis}": tip[:, i] for i, axis in enumerate("xyz")}
    figure = recording_figure(replace(recording, channels=channels))
    (path,) = (axes for axes in figure.axes if axes.get_title() == "path of the tip")
    if not plane:
        assert path.name == "3d"
        return
    assert (path.get_xlabel(), path.get_ylabel()) == tuple(f"{axis} [m]" for axis in plane)
    for label in ("recording", "reference"):
        for values, axis in zip(curve(path, label), plane, strict=True):
            np.testing.assert_array_equal(values, tip[:, "xyz".index(axis)])
    figure.draw_without_rendering()
    one, other = np.diff(path.transData.transform([[3, 3], [4, 4]]), axis=0)[0]
    assert one == pytest.approx(other, rel=1e-9)  # to scale


def test_without_tip_or_references(recording):
    figure = recording_figure(without(recording, "reference"))
    assert sorted(panels(figure)) == [(row, i) for row in range(3) for i in range(2)]
    assert [axes.name for axes in figure.axes].count("3d") == 1
    assert figure.legends == []
    figure = recording_figure(without(recording, "reference", "tip"))
    assert [axes.name for axes in figure.axes] == ["rectilinear"] * 6
    assert figure.get_suptitle() == ""


def test_a_joint_at_rest_looks_at_rest(recording):
    noise = 1e-15 * np.sin(40 * recording.time)
    still = Recording(
        recording.time, ("q1",), *np.tile(noise[:, None], (3, 1, 1)), units={"q1": "rad"}
    )
    for axes in panels(recording_figure(still)).values():
        low, high = axes.get_ylim()
        assert high - low >= 0.01
        assert low < 0 < high


def test_names_that_are_not_a_letter_and_a_number_stay_as_they_are():
    names = ("boom_lift", "A$1", "X12")
    zeros = np.zeros((2, 3))
    recording = Recording([0, 1], names, zeros, zeros, zeros, dict.fromkeys(names, "m"))
    grid = panels(recording_figure(recording))
    assert [grid[0, i].get_title() for i in range(3)] == [
        "boom_lift",
        r"A\$1",
        r"$X_{\mathrm{12}}$",
    ]


def test_one_sample_can_be_seen():
    recording = Recording([1.0], ("q1",), [[1.0]], [[0.0]], [[0.0]], {"q1": "rad"})
    (line,) = panels(recording_figure(recording))[0, 0].get_lines()
    assert line.get_marker() == "o"


@pytest.mark.parametrize("suffix", SIGNATURES)
def test_formats(tmp_path, recording, suffix):
    path, recording = tmp_path / f"run{suffix}", without(recording, "tip", "reference")
    plot_result(recording, path)
    first = path.read_bytes()
    assert first.startswith(SIGNATURES[suffix])
    plot_result(recording, path)
    assert path.read_bytes() == first


@pytest.mark.parametrize("name", ["run.gif", "run", "run.png.txt"])
def test_unknown_format_writes_nothing(tmp_path, recording, name):
    with pytest.raises(OutputError, match=r"end the name in \.png, \.svg or \.pdf"):
        plot_result(recording, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_no_global_state_of_pyplot():
    code = (
        "import sys, crane.view.plots.recording_figure; print('matplotlib.pyplot' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"


def boxes(figure):
    """Where the words at the axes of the path in space are drawn, by what they say [pixels]."""
    figure.draw_without_rendering()
    (space,) = (axes for axes in figure.axes if axes.name == "3d")
    found = {}
    for name, axis in zip("xyz", (space.xaxis, space.yaxis, space.zaxis), strict=True):
        found[name] = [axis.label.get_window_extent()]
        low, high = sorted(axis.get_view_interval())
        for tick in axis.get_major_ticks():
            assert low < tick.get_loc() < high
            found[name].append(tick.label1.get_window_extent())
    return found


@pytest.mark.parametrize(
    "end",
    [
        (0.42, 0.01, 0.13),
        (0.38, 0.01, 0.13),
        (0.12, -0.25, 0.1),
        (0.361, 0.01, 0.0),
        (0.4, 0.7, -0.05),
        (2.4, 3.7, 9.1),
    ],
)
def test_words_at_the_axes_of_the_path_keep_apart(end):
    start = (0.36, 0.0, -0.07)
    zeros = np.zeros((50, 1))
    channels = {f"tip_{x}": np.linspace(*ends, 50) for x, *ends in zip("xyz", start, end)}  # noqa: B905
    channels |= {f"reference_{name}": values for name, values in channels.items()}
    time = np.linspace(0, 1, 50)
    recording = Recording(time, ("q1",), zeros, zeros, zeros, {"q1": "rad"}, channels)
    figure = recording_figure(recording)
    found = boxes(figure)
    assert all(2 <= len(words) <= 5 for words in found.values())
    words = [box for boxes_ in found.values() for box in boxes_]
    for i, one in enumerate(words):
        assert figure.bbox.x0 <= one.x0 and one.x1 <= figure.bbox.x1
        for other in words[:i]:
            assert not one.overlaps(other)


@pytest.mark.parametrize(
    ("joints", "tip"), [(5, True), (6, True), (7, True), (7, False), (30, True)]
)
def test_many_joints_are_wrapped(joints, tip):
    names = tuple(f"q{i + 1}" for i in range(joints))
    zeros = np.zeros((3, joints))
    channels = {f"tip_{axis}": np.arange(3.0) for axis in "xyz"} if tip else {}
    units = dict.fromkeys(names, "rad")
    figure = recording_figure(Recording([0, 1, 2], names, zeros, zeros, zeros, units, channels))
    assert 200 * figure.get_size_inches()[0] < 4000
    grid = panels(figure)
    assert len(grid) == 3 * joints
    titles = [grid[place].get_title() for place in sorted(grid) if place[0] % 3 == 0]
    assert titles == [joint_symbol(f"q{i + 1}") for i in range(joints)]
    for (row, _), axes in grid.items():
        assert axes.get_xlabel() == ("time [s]" if row % 3 == 2 else "")
    letters = [text.get_text() for place in sorted(grid) for text in grid[place].texts]
    assert letters == [f"({letter})" for letter in ascii_lowercase[: 3 * joints]]


def test_cylinders_with_valves_have_pressures_flows_and_signals(recording):
    """In the units of the page, which are those of the largest of a row; the motor has none."""
    time = recording.time
    own = {
        "pressure_X1_a": ("Pa", 1.2e7 + 1e6 * time), "pressure_X1_b": ("Pa", 3e6 - 1e5 * time),
        "pressure_supply": ("Pa", 0 * time + 2e7), "flow_X1_a": ("m3/s", 5e-4 * time),
        "flow_X1_b": ("m3/s", -3e-4 * time), "voltage_X1": ("V", 2 + time),
    }  # fmt: skip
    units = {name: unit for name, (unit, _) in own.items()}
    channels = {name: values for name, (_, values) in own.items()}
    tau = np.column_stack([9000 * time, 40e3 - 1e3 * time])
    run = Recording(
        time, recording.joints, recording.q, recording.v, tau, recording.units, channels, units
    )
    figure = recording_figure(run)
    grid = panels(figure)
    assert set(grid) == {(row, 0) for row in range(3)} | {(row, 1) for row in range(6)}
    expected = {
        (2, 0): ("torque [kN m]", {"recording": 1e-3 * tau[:, 0]}),
        (2, 1): ("force [kN]", {"recording": 1e-3 * tau[:, 1]}),
        (3, 1): ("pressure [bar]", {
            "A": 120 + 10 * time, "B": 30 - time, "supply": np.full(len(time), 200.0)}),
        (4, 1): ("flow [l/min]", {"A": 30 * time, "B": -18 * time}),
        (5, 1): ("signal [V]", {"recording": 2 + time}),
    }  # fmt: skip
    for place, (label, lines) in expected.items():
        assert grid[place].get_ylabel() == label
        assert {line.get_label() for line in grid[place].get_lines()} == set(lines)
        for name, values in lines.items():
            np.testing.assert_allclose(curve(grid[place], name)[1], values, rtol=1e-12)
    assert [grid[2, 0].get_xlabel(), grid[2, 1].get_xlabel()] == ["time [s]", ""]
    assert grid[5, 1].get_xlabel() == "time [s]"
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["recording", "A", "B", "supply"]


def test_a_small_force_beside_a_large_one_is_in_the_same_unit():
    tau = np.array([[28e3, 300.0], [27e3, -500.0]])
    zeros = np.zeros((2, 2))
    run = Recording([0, 1], ("X1", "X2"), zeros, zeros, tau, {"X1": "m", "X2": "m"})
    grid = panels(recording_figure(run))
    assert [grid[2, i].get_ylabel() for i in (0, 1)] == ["force [kN]"] * 2
    np.testing.assert_allclose(curve(grid[2, 1], "recording")[1], [0.3, -0.5])


@pytest.mark.parametrize("name", ["loader", "loader with a long boom and two chambers"])
def test_title_and_legend_stand_apart_where_there_is_one_joint(name):
    time = np.linspace(0, 2, 201)
    pressures = {f"pressure_lift_{side}": 1e6 + 1e5 * np.sin(time) for side in "ab"}
    column = np.sin(time)[:, None]
    one = Recording(
        time, ("lift",), column, column, column, {"lift": "m"}, pressures,
        dict.fromkeys(pressures, "Pa"), machine_name=name,
    )  # fmt: skip
    figure = recording_figure(one)
    figure.draw_without_rendering()
    (legend,) = figure.legends
    above, beside = (part.get_window_extent() for part in (figure._suptitle, legend))
    assert not above.overlaps(beside)


# --- curves with fewer points -------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 7, 100, 101, 999, 4321])
def test_an_envelope_has_all_that_can_be_seen(monkeypatch, count):
    monkeypatch.setattr(figure_style, "_MAX_POINTS", 100)
    rng = np.random.default_rng(count)
    time, values = np.arange(float(count)), rng.normal(size=count)
    at, kept = figure_style.envelope(time, values)
    assert len(at) <= max(2 * 100, 6) and (np.diff(at) > 0).all()
    np.testing.assert_array_equal(values[at.astype(int)], kept)
    assert (at[0], at[-1]) == (0, count - 1)
    assert (kept.min(), kept.max()) == (values.min(), values.max())
    # in every stretch of an eightieth of the time, lowest and highest are there
    edges = np.linspace(0, count, 81)
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        inside = values[(time >= low - count / 40) & (time < high + count / 40)]
        shown = kept[(at >= low - count / 40) & (at < high + count / 40)]
        whole = values[(time >= low) & (time < high)]
        if len(whole):
            assert shown.min() <= whole.min() and shown.max() >= whole.max()
            assert shown.min() >= inside.min()


def test_a_path_keeps_its_ends(monkeypatch):
    monkeypatch.setattr(figure_style, "_MAX_POINTS", 100)
    points = np.random.default_rng(0).normal(size=(1234, 3))
    path = figure_style.thin_path(points)
    assert len(path) <= 101
    np.testing.assert_array_equal(path[[0, -1]], points[[0, -1]])
    np.testing.assert_array_equal(figure_style.thin_path(points[:100]), points[:100])


# --- names in figures ---------------------------------------------------------------------------


NAMES = [r"$\bad$", "$", "$$", "a$b$c", r"a\$b", r"\$\bad\$", r"$x^{", r"\frac{", "x^y_z", "50 %"]


def picture(text, **options):
    figure = Figure(figsize=(3, 0.5), dpi=100)
    figure.text(0.05, 0.4, text, **options)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_set_as_it_is(name):
    """The text looks as matplotlib sets it with mathematics switched off."""
    expected = picture(name, parse_math=False)
    assert expected.min() < 200
    np.testing.assert_array_equal(picture(escape_label(name)), expected)
    np.testing.assert_array_equal(picture(joint_symbol(name)), expected)
    picture(f"{joint_symbol('q1')}, {joint_symbol(name)}")  # both in one text


def test_a_name_that_begins_with_an_underscore_is_in_the_legend():
    axes = Figure().subplots()
    axes.plot([0, 1], label=escape_label("_a"))
    assert [text.get_text() for text in axes.legend().get_texts()] == [" _a"]


def test_long_names_and_names_that_cannot_be_printed():
    assert len(escape_label("x" * 10**6)) == 80
    assert escape_label("a\nb\0c") == "a b c"


HOSTILE = {
    "four_bar": r"$\four$", "crank": r"$\bad$", "coupler": "_b$c", "rocker": r"$\frac$",
    "swing": r"$\sw$", "coupler_pin": r"$\pin$", "pin": r"$^$",
}  # fmt: skip


def test_figures_of_a_machine_with_such_names(tmp_path):
    (tmp_path / "four_bar").mkdir()
    pattern = rf"(?<![\w/.])({'|'.join(HOSTILE)})(?![\w/.])"
    for file in ("four_bar.yaml", "four_bar/ground.urdf", "four_bar/rocker.urdf"):
        text = re.sub(pattern, lambda found: HOSTILE[found[1]], (DATA / file).read_text())
        (tmp_path / file).write_text(text.replace(": $^$", ": '$^$'"))
    machine = crane.load(tmp_path / "four_bar.yaml")
    assert machine.active == (r"$\bad$",) and machine.tip == r"$\pin$"
    figures = [tmp_path / f"{i}.png" for i in range(5)]
    sketch(machine, figures[0])
    time = np.linspace(0, 1, 30)
    one = np.sin(time)[:, None]
    recording = Recording(
        time, machine.active, one, one, one, {machine.active[0]: "rad"},
        machine=r"$\four$", task=r"$\sw$ \alpha$",
    )  # fmt: skip
    plot_result(recording, figures[1])
    plot_result(crane.workspace(machine), figures[2])
    vary = {f"friction.{machine.joints[0]}.coulomb": [0.3, 0.4]}
    plot_result(
        crane.study(machine.path, vary, [r"$\sw$"], [r"peak_$\bad$"], processes=1), figures[3]
    )
    channel = SimpleNamespace(
        name=r"$\bad$", unit=r"$\u$", measured=time, simulated=time, rms=0.0, relative_rms=0.0
    )
    comparison = SimpleNamespace(time=time, channels=[channel])
    write_figure(figures[4], lambda: comparison_figure(comparison))
    assert all(figure.stat().st_size for figure in figures)
    picture_of_names = FigureCanvasAgg(correlation_figure(np.eye(2), [r"$\bad$.mass", "_b$c.m$x"]))
    picture_of_names.draw()
