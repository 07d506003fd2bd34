"""Results write themselves into folders, from Python as from the command line."""

import numpy as np
import pytest
from writing_commands import read

import crane
from crane.common.errors import OutputError
from crane.common.result import Result
from crane.identification.hydraulics.cylinder_equations import EquationSides
from crane.identification.hydraulics.orifice_coefficients import OrificeCoefficients
from crane.identification.hydraulics.valve_curve import ValveCurve, _valve_parameters
from crane.recordings.measured_recordings import read_run
from crane.simulation.linear.linearization import linear_models
from crane.view.result_files import RESULT_FILES, plot_result, result_summary


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with machines and recordings, see `written.read`."""
    place = tmp_path_factory.mktemp("inputs")
    read(place)
    return place


def four_bar(folder):
    return crane.load(folder / "four_bar.yaml")


def mini():
    return crane.load("mini_forwarder")


def rig_run(folder):
    rig = crane.load(folder / "rig.yaml")
    return rig, read_run(folder / "rig.csv", rig)


def power_comparison(folder):
    balance = crane.power_balance(*rig_run(folder))
    return crane.studies.PowerComparison({"one": balance, "two": balance}, 3.0)


def valve_curve(_):
    samples = np.linspace(-4.0, 4.0, 9)
    values = np.array([0.5, -0.5, 0.1, 0.1])
    values = np.append(values, _valve_parameters(values, 4.0, (1e-3, 8e-4))[0])
    return ValveCurve("x", values, np.eye(9), 5.0, 4.0, samples, samples, 0.01)


def orifices(folder):
    time, five = np.linspace(0.0, 1.0, 20), np.full(5, 5.0)
    sides = (EquationSides(time, time, 1.01 * time),)
    rig = crane.load(folder / "rig.yaml")
    return OrificeCoefficients(rig, "x", "weak", five, np.eye(5), five, 2.0, 1.0, 0.1, sides)


# By class: how a small result is made of the folder's files, options, and the files written.
CASES = {
    "Breakout": (
        lambda _: crane.ratings.breakout(crane.load("patu655"), bucket="X_tilt"),
        {},
        "breakout.md",
    ),
    "Calibration": (
        lambda x: crane.calibrate(x / "rig.yaml", x / "rig.csv", {"load_x.mass": None}),
        {},
        "calibration.md calibration.png report.html machine/rig.yaml machine/rig/rig.urdf",
    ),
    "Capacity": (
        lambda _: crane.capacity(mini(), step=0.3),
        {"parameters": ["link7.mass"]},
        "capacity.md capacity.csv capacity.png capacity.html sheet.pdf slopes.csv",
    ),
    "Comparison": (
        lambda x: crane.replay(crane.load(x / "rig.yaml"), x / "rig.csv", 0.01)[1],
        {},
        "recording.csv summary.md comparison.md comparison.png",
    ),
    "CylinderFriction": (
        lambda x: crane.identification.identify_cylinder_friction(*rig_run(x), "x"),
        {},
        "friction.txt friction.png",
    ),
    "Design": (
        lambda _: crane.design(
            "mini_forwarder", {"link7.mass": (0.1, 0.2)}, minimise=["mass"], starts=1
        ),
        {},
        "design.md design.png solutions.csv machine/*",
    ),
    "Excitation": (
        lambda x: crane.excite(
            crane.load(x / "slider_crank.yaml"), harmonics=2, periods=1, step=0.1
        ),
        {},
        "reference.csv reference.png coefficients.yaml",
    ),
    "Identification": (
        lambda x: crane.identify(mini(), [read_run(x / "mini.csv", mini())]),
        {"recordings": "mini.csv"},
        "report.html parameters.csv",
    ),
    "LinearModel": (
        lambda x: crane.linearize(four_bar(x)),
        {"models": lambda x: linear_models(four_bar(x), {"crank_arm.mass": [1.0, 2.0]})},
        "model.mat model.npz modes.md modes.png over.png",
    ),
    "OrificeCoefficients": (orifices, {"unit": "m"}, "orifices.txt orifices.png"),
    "PowerBalance": (
        lambda x: crane.power_balance(*rig_run(x)),
        {},
        "power.md power.csv power.png sankey.png",
    ),
    "PowerComparison": (power_comparison, {}, "comparison.md comparison.png"),
    "Recording": (
        lambda _: crane.simulate(mini(), duration=0.02),
        {"npz": True, "views": True},
        "recording.npz summary.md figure.png view.html",
    ),
    "SectionChart": (
        lambda x: crane.dynamics.section_chart(
            crane.load(x / "boom.yaml"), crane.Recording.from_csv(x / "boom.csv"), "boom"
        ),
        {},
        "sections.md sections.csv sections.png",
    ),
    "Sensitivities": (
        lambda x: crane.sensitivities(
            four_bar(x), None, duration=0.01, parameters=["crank_arm.mass"]
        ),
        {},
        "sensitivities.md sensitivities.csv sensitivities.png",
    ),
    "SignalExcitation": (
        lambda x: crane.identification.excite_valves(
            crane.load(x / "rig.yaml"), {"load_x.mass": None}, duration=4.0
        ),
        {},
        "signals.csv signals.png",
    ),
    "Study": (
        lambda _: crane.study(
            "mini_forwarder", {"payload.mass": [1, 2]}, measures=["mass"], processes=1
        ),
        {},
        "study.csv study.png",
    ),
    "LiftChart": (
        lambda _: crane.ratings.lift_chart(crane.load("patu655"), ["X_lift"]),
        {},
        "lift_chart.md lift_chart.csv lift_chart.png lift_chart.html",
    ),
    "ToolForce": (
        lambda _: crane.ratings.tool_force(crane.load("patu655"), "up", step=2.0),
        {},
        "tool_force.md tool_force.csv tool_force.png",
    ),
    "ValveCurve": (valve_curve, {}, "valve.txt valve.png"),
    "WorkingRange": (
        lambda _: crane.working_range(mini()),
        {},
        "working_range.md working_range.csv working_range.png",
    ),
    "Workspace": (
        lambda x: crane.workspace(four_bar(x), 100),
        {},
        "workspace.md workspace.csv curves.csv workspace.png",
    ),
}
SLOW = "Calibration", "SignalExcitation"


@pytest.mark.parametrize("signal_range", [5.0, -5.0])
def test_slopes_of_what_a_valve_curve_gives_a_machine_file(signal_range):
    """Beside central differences, for valves that extend at high and at low signals."""
    values, areas = np.array([0.7, -0.4, 0.11, 0.09]), (1e-3, 8e-4)
    _, slopes = _valve_parameters(values, signal_range, areas)
    for i, step in enumerate(1e-6 * np.eye(4)):
        more, less = (
            _valve_parameters(values + sign * step, signal_range, areas)[0] for sign in (1, -1)
        )
        np.testing.assert_allclose(slopes[:, i], (more - less) / 2e-6, rtol=1e-7, atol=1e-12)


def test_every_result_has_a_case():
    def subclasses(of):
        return {x for one in of.__subclasses__() for x in {one, *subclasses(one)}}

    for name in crane.__all__:
        found = getattr(crane, name)  # which imports its module
        for inner in getattr(found, "__all__", ()):
            getattr(found, inner)
    results = {x.__name__ for x in subclasses(Result) if not x.__name__.startswith("Rating")}
    assert results == set(RESULT_FILES) == set(CASES)


@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow if x in SLOW else ()) for x in CASES]
)
def test_written_from_python(name, folder, tmp_path):
    make, options, names = CASES[name]
    result = make(folder)
    assert type(result).__name__ == name
    assert len(repr(result)) <= 200 and "\n" not in repr(result)
    options = {key: x(folder) if callable(x) else x for key, x in options.items()}
    target = tmp_path / "new" / "result"
    text = result.write(target, **options)
    written = {str(x.relative_to(target)) for x in target.rglob("*") if x.is_file()}
    wanted = {x for x in names.split() if not x.startswith("machine/")}
    assert {x for x in written if not x.startswith("machine/")} == wanted
    assert any(x.startswith("machine/") for x in written) == ("machine/" in names)
    assert all((target / x).stat().st_size for x in written)
    summary = RESULT_FILES[name].summary
    assert text == (target / summary).read_text() if summary else text
    assert text == result_summary(result, **options)
    # a folder that holds something is replaced on request alone, and what others wrote stays
    (target / "notes").write_text("the user's own")
    with pytest.raises(OutputError, match="is not empty"):
        result.write(target, **options)
    result.write(target, overwrite=True)
    left = {x.name for x in target.iterdir()}
    optional = {"slopes.csv", "over.png", "recording.npz", "figure.png", "view.html"}
    assert left >= {x for x in wanted if x not in optional or name != "Recording"} - optional
    assert "notes" in left and not left & (optional - {"view.html"})


def test_unknown_options_are_errors(tmp_path):
    recording = crane.simulate(mini(), duration=0.02)
    with pytest.raises(TypeError, match="Recording.write has no option nz, only npz, views"):
        recording.write(tmp_path / "run", nz=True)
    assert list(tmp_path.iterdir()) == []


def test_a_figure_alone(tmp_path):
    recording = crane.simulate(mini(), duration=0.02)
    plot_result(recording, tmp_path / "run.svg")
    assert (tmp_path / "run.svg").read_text().startswith("<?xml")
