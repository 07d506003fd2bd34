"""Sketches: pins at forward kinematics, every name once, labels that overlap nothing."""

import re
import warnings
from itertools import combinations

import numpy as np
import pinocchio as pin
import pytest
from command_line import typed
from conftest import DATA
from matplotlib.backends.backend_agg import FigureCanvasAgg

import crane
from crane.common.errors import CraneWarning, InputError, LimitError, OutOfReachError, OutputError
from crane.description import bundled_machines
from crane.view.plots.figure_style import joint_symbol
from crane.view.sketches.sketch_elements import find_plane
from crane.view.sketches.sketch_figure import sketch_figure

PLANAR = ["four_bar.yaml", "slider_crank.yaml", "five_bar.urdf"]


@pytest.fixture(scope="module")
def machines():
    """The bundled machines and those of tests/data that move in a plane."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        loaded = [crane.load(name) for name in bundled_machines()]
    return loaded + [crane.load(DATA / name) for name in PLANAR]


@pytest.fixture(scope="module")
def at_home(machines):
    """Each machine with its sketch at the home configuration."""
    return [(machine, sketch_figure(machine)) for machine in machines]


def drawn(figure):
    """Positions of the symbols that have names."""
    return {
        line.get_gid(): line.get_xydata()[0]
        for line in figure.axes[0].get_lines()
        if line.get_gid()
    }


def names(figure):
    """Every name in the labels, the numbers of the loops left out."""
    texts = [x.get_text() for x in figure.axes[0].texts if x.get_gid() == "label"]
    return [re.sub(r"^\S (?=\S)", "", part) for text in texts for part in text.split(", ")]


def overlaps(figure):
    """Pairs of words in the drawing that cover each other."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [(x.get_text(), x.get_window_extent(renderer)) for x in figure.axes[0].texts]
    return [(a, b) for (a, one), (b, other) in combinations(boxes, 2) if one.overlaps(other)]


def crossed(figure):
    """Words in the drawing with a line of a body or a rod through them."""
    (axes,) = figure.axes
    renderer = FigureCanvasAgg(figure).get_renderer()
    lines = [x for x in axes.get_lines() if len(x.get_xdata()) > 1 and x.get_linewidth() > 1]
    found = []
    for text in (x for x in axes.texts if (x.get_gid() or "").startswith("label")):
        box = text.get_window_extent(renderer)
        for line in lines:
            path = line.get_transform().transform_path(line.get_path())
            if path.intersects_bbox(box, filled=False):
                found.append((text.get_text(), line.get_xydata()))
    return found


def in_plane(angle):
    """Directions to the right and up in a plane that a slewing joint has turned."""
    return np.array([[np.cos(angle), np.sin(angle), 0], [0, 0, 1]])


def random_postures(machine, count, seed=0):
    rng = np.random.default_rng(seed)
    low, high = machine.lower, machine.upper
    home = machine.home[machine.closure.active]
    low, high = np.where(np.isfinite(low), low, home - 0.5), np.where(np.isfinite(high), high, 0.5)
    return rng.uniform(low, high, (count, len(low)))


@pytest.mark.parametrize("name", ["mini_forwarder", "patu655"])
def test_pins_are_where_forward_kinematics_puts_them(machines, name):
    (machine,) = [x for x in machines if x.name == name]
    for q_a in random_postures(machine, 2):
        q = machine.closure.solve(q_a)
        data = machine.model.createData()
        pin.framesForwardKinematics(machine.model, data, q)
        plane, found = in_plane(q_a[0]), drawn(sketch_figure(machine, q_a))
        revolute = [x for x in machine.joints[1:] if machine.unit(x) == "rad"]
        for joint in revolute:
            at = data.oMi[machine.model.getJointId(joint)].translation
            np.testing.assert_allclose(found[f"joint {joint}"], plane @ at, rtol=0, atol=1e-9)
        for loop in machine.closure.equations.loops:
            for end, gid in ((loop.predecessor, ""), (loop.successor, " mate")):
                at = data.oMf[machine.frame(end)].translation
                np.testing.assert_allclose(
                    found[f"loop {loop.name}{gid}"], plane @ at, rtol=0, atol=1e-9
                )
        tip = data.oMf[machine.frame(machine.tip)].translation
        np.testing.assert_allclose(found["tip"], plane @ tip, rtol=0, atol=1e-9)


def test_every_joint_and_loop_is_named_once(at_home):
    for machine, figure in at_home:
        expected = [*machine.joints, *(loop.name for loop in machine.closure.equations.loops)]
        assert sorted(names(figure)) == sorted(map(joint_symbol, expected)), machine.name


def test_no_words_overlap_or_lie_on_lines_at_home(at_home):
    for machine, figure in at_home:
        assert overlaps(figure) == [], machine.name
        assert crossed(figure) == [], machine.name


@pytest.mark.slow
def test_no_words_overlap_anywhere_on_the_cranes(machines):
    for machine in machines[:3]:
        for q_a in random_postures(machine, 3, seed=1):
            assert overlaps(sketch_figure(machine, q_a, show_centres_of_mass=True)) == [], (
                machine.name,
                q_a,
            )


def test_axes_are_equal_and_named_in_metres(at_home):
    for _, figure in at_home:
        (axes,) = figure.axes
        box = axes.get_position()
        width, height = figure.get_size_inches() * [box.width, box.height]
        spans = np.ptp([axes.get_xlim(), axes.get_ylim()], axis=1)
        assert width / spans[0] == pytest.approx(height / spans[1], rel=1e-9)
        assert axes.get_xlabel().endswith(" [m]") and axes.get_ylabel().endswith(" [m]")


def test_cylinders_reach_from_pin_to_pin(mini):
    """Barrels begin at their pins, rods end at theirs, whatever the strokes."""
    from crane.view.sketches.mechanism_projection import project_mechanism

    for q_a in random_postures(mini, 10):
        q = mini.closure.solve(q_a)
        mechanism = project_mechanism(mini, q, find_plane(mini, q))
        pins = {shown.name: shown.position for shown in mechanism.pins}
        for slide, pin_name, eye in zip(
            mechanism.slides, ("q4", "q10"), ("A1_eye", "A2_eye"), strict=True
        ):
            np.testing.assert_allclose(slide.start, pins[pin_name], rtol=0, atol=1e-9)
            np.testing.assert_allclose(slide.rod_outer_end, pins[eye], rtol=0, atol=1e-9)
            way, along = slide.rod_outer_end - slide.start, slide.rod_inner_end - slide.start
            barrel = np.linalg.norm(slide.mouth - slide.start)
            assert 0 < np.linalg.norm(along) < barrel < np.linalg.norm(way)


def test_centres_of_mass_only_where_asked(mini):
    assert "centre of mass" not in drawn(sketch_figure(mini))
    figure = sketch_figure(mini, show_centres_of_mass=True)
    lines = [x for x in figure.axes[0].get_lines() if x.get_gid() == "centre of mass"]
    places = {tuple(np.round(line.get_xydata()[0], 9)) for line in lines}
    data = mini.model.createData()
    pin.forwardKinematics(mini.model, data, mini.home)
    bodies = range(1, mini.model.njoints)
    levers = [data.oMi[i].act(mini.model.inertias[i].lever) for i in bodies]
    assert places == {tuple(np.round(in_plane(0) @ lever, 9) + 0.0) for lever in levers}


def test_plane_turns_with_the_crane(mini):
    for angle in (-2.0, 0.3, 3.0):
        plane = find_plane(mini, mini.closure.solve([angle, 0.01, 0.02]))
        np.testing.assert_allclose([plane.right, plane.up], in_plane(angle), atol=1e-12)
        assert plane.labels[1] == "z"


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_sketch_writes_all_kinds(mini, tmp_path, kind):
    crane.sketch(mini, tmp_path / f"a.{kind}", [0.5, 0.01, 0.02])
    begin = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[kind]
    assert (tmp_path / f"a.{kind}").read_bytes().startswith(begin)


def test_wrong_requests(mini, stewart, slider_crank, tmp_path):
    with pytest.raises(OutputError, match=r"end the name in \.png"):
        crane.sketch(mini, tmp_path / "a.gif")
    with pytest.raises(LimitError, match="X1 = 1 is outside of its limits"):
        crane.sketch(mini, tmp_path / "a.png", [0, 1.0, 0])
    with pytest.raises(InputError, match="stewart has no plane: no more than 2 of its 15"):
        crane.sketch(stewart, tmp_path / "a.png")
    with pytest.raises(InputError, match="view 'zz' is unknown, known: xy, xz, yz"):
        crane.sketch(mini, tmp_path / "a.png", plane="zz")
    with pytest.raises(OutOfReachError, match="loop 'meeting'"):
        machine = crane.load(slider_crank.path.parent / "five_bar.urdf")
        crane.sketch(machine, tmp_path / "a.png", [2.0, 0.0])
    assert list(tmp_path.iterdir()) == []
    crane.sketch(stewart, tmp_path / "a.png", plane="xz")
    assert (tmp_path / "a.png").is_file()


def test_command(tmp_path):
    result = typed("sketch", "tx40", cwd=tmp_path)
    assert (result.returncode, result.stdout) == (0, "written to tx40_sketch.png\n")
    result = typed("sketch", "kr300", "--at", "q1=0.1,q2=-1.2", "--out", "a.svg", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "loop rod_eye" in (tmp_path / "a.svg").read_text()  # artists keep their names


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["tx4"], "did you mean 'tx40'?"),
        (["tx40", "--out", "a.jpg"], "end the name in .png, .svg or .pdf"),
        (["tx40", "--at", "q9=1"], "--at: 'q9' is no active joint, known: q1, q2"),
        (["tx40", "--at", "q1"], "--at is 'q1', write JOINT=VALUE,..."),
        (["tx40", "--at", "q1=9"], "q1 = 9 is outside of its limits"),
        (["tx40", "--plane", "front"], "view 'front' is unknown"),
    ],
)
def test_errors_are_one_line_and_write_nothing(arguments, text, tmp_path):
    result = typed("sketch", *arguments, cwd=tmp_path)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert text in result.stderr
    assert list(tmp_path.iterdir()) == []
