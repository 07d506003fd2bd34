"""Names in figures appear literally, without interpretation by matplotlib."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from broken_machines import DATA
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import crane
from crane.recordings.recording import Recording
from crane.view.plots.calibration_figure import comparison_figure
from crane.view.plots.figure_style import escape_label, joint_symbol, write_figure
from crane.view.plots.identification_figures import correlation_figure
from crane.view.result_files import plot_result
from crane.view.sketches.sketch_canvas import format_joint_symbol
from crane.view.sketches.sketch_figure import sketch

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
    np.testing.assert_array_equal(picture(format_joint_symbol(name)), expected)
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
