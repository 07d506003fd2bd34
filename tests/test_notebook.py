"""Output of machines, runs and results in notebooks, with names escaped."""

import dataclasses
import inspect
import shutil
import sys
import time
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest
from test_section_forces import write as write_boom

import crane
from crane.common import one_line_repr, progress
from crane.common.one_line_repr import OneLineRepr
from crane.common.progress import PROGRESS, ignore_progress, progress_reporter
from crane.identification.calibration.calibration_result import CalibrationChannel as Sensed
from crane.identification.calibration.calibration_result import FittedParameter
from crane.simulation.recording_replay import ChannelComparison
from crane.studies.residual_sway_study import SwayRow
from crane.view import notebook, notebook_progress, result_files

SOURCE = Path(__file__).parents[1]
EVIL = "<script>alert(1)</script> \"&' </iframe> ![i](http://a.b/c.png) --> <!--"
ALLOWED = {
    "div", "style", "p", "img", "table", "thead", "tbody", "tr", "th", "td", "details", "summary",
    "iframe", "pre", "code", "strong", "em", "ul", "li", "h1", "h2",
}  # fmt: skip


class Parsed(HTMLParser):
    """Elements, addresses and text of a piece of HTML."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.addresses, self.inner, self.text = [], [], [], ""
        self.attributes = set()
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}
        for name, value in attrs:
            if name in ("src", "href", "data", "action"):
                self.addresses.append(value)
            if name == "srcdoc":
                self.inner.append(value)

    def handle_data(self, data):
        self.text += data


def looked_at(what):
    """Its HTML, parsed: closed in itself, whatever it holds."""
    found = Parsed(what._repr_html_())
    assert set(found.tags) <= ALLOWED
    assert found.attributes <= set(
        ["class", "style", "alt", "src", "width", "title", "sandbox", "srcdoc", "open"]
    )
    assert all(x.startswith("data:image/") for x in found.addresses)
    return found


def drawing(found):
    """The SVG of a machine."""
    (address,) = [x for x in found.addresses if x.startswith("data:image/svg+xml,")]
    return ElementTree.fromstring(unquote(address.partition(",")[2]))


@pytest.fixture(scope="module")
def run(mini):
    control = crane.PI(mini, crane.task_trajectory(mini, "loading"))
    return crane.simulate(mini, control, label="loading")


def test_a_machine_has_its_sketch_and_its_facts(mini):
    html = mini._repr_html_()
    assert str(mini.path.parent) not in html  # a notebook may be given away
    found = looked_at(mini)
    assert len(html) < 100_000
    assert drawing(found).tag.endswith("svg")
    for words in (
        *mini.joints, "link4_J to link5_J", "driven", "passive", "0 to 0.03 m", "0.0221 m", "80 N",
        "1.765 N m", "urdf/mini_forwarder/chain_c.urdf", "8 independent equations",
    ):  # fmt: skip
        assert words in found.text
    assert found.text.count("passive") == len(mini.closure.passive)


def test_a_circuit_and_free_joints_are_told():
    found = looked_at(crane.load("patu655_grapple"))
    assert (
        "compensated valve" in found.text and "cylinder areas A 78.54, B 53.91 cm2" in found.text
    )
    assert "free" in found.text


def test_a_machine_that_no_plane_holds_says_so():
    found = looked_at(crane.load("excavator", floating=True))
    assert "svg" not in "".join(found.addresses) and "no picture: " in found.text
    assert "independent equations" in found.text


def test_a_recording_has_its_page_its_plots_and_its_numbers(mini, run):
    html = run._repr_html_()
    found = looked_at(run)
    assert len(html) < 3_000_000
    (inner,) = found.inner
    assert inner.startswith("<!DOCTYPE html>") and inner.rstrip().endswith("</html>")
    assert inner == notebook.report_html(mini, run, frame_share=notebook._FRAME_SHARE)
    assert 'sandbox="allow-scripts"' in html and "allow-same-origin" not in html
    assert len(found.addresses) == 1 and "-90.00 to 0.31 deg" in found.text


def stretched(run, count, **changes):
    """As many samples at a hundred per second."""
    again = {name: np.resize(x, count) for name, x in run.channels.items()}
    every = {name: np.resize(getattr(run, name), (count, 3)) for name in ("q", "v", "tau")}
    time = np.arange(count) / 100.0
    return dataclasses.replace(run, time=time, channels=again, **every, **changes)


def test_long_recordings_are_no_longer_pages(mini, run):
    sizes = [
        len(notebook.report_html(mini, stretched(run, count), frame_share=notebook._FRAME_SHARE))
        for count in (12_000, 120_000)
    ]
    assert sizes[1] < 1.05 * sizes[0] < 3_500_000


@pytest.mark.parametrize("machine", ["nowhere/crane.yaml", "patu655"])
def test_a_recording_without_its_machine_still_shows_its_plots(run, machine):
    found = looked_at(dataclasses.replace(run, machine=machine))
    assert not found.inner and "its motion is not played: " in found.text
    assert len(found.addresses) == 1 and "peak speed" in found.text


@pytest.mark.slow
def test_names_stay_text(mini, run):
    task = next(iter(mini.tasks.values()))
    evil = dataclasses.replace(
        mini, name=EVIL, source=EVIL, tip=None,
        tasks={"a": dataclasses.replace(task, name=EVIL, description=EVIL)},
    )  # fmt: skip
    found = looked_at(evil)
    assert found.text.count(EVIL) >= 3 and drawing(found).tag.endswith("svg")
    assert not [x for x in drawing(found).iter() if x.tag.endswith("script")]
    labelled = looked_at(dataclasses.replace(run, task=EVIL))
    page, plain = Parsed(labelled.inner[0]), Parsed(looked_at(run).inner[0])
    assert page.tags == plain.tags and page.addresses == plain.addresses
    study = crane.studies.Study(
        EVIL, (EVIL,), ("energy",), (EVIL,), {EVIL: EVIL, "energy": "J"},
        {EVIL: np.array([1.0, 2.0]), "energy": np.array([1.0, 3.0])}, ("", ""), (2,), (EVIL,),
    )  # fmt: skip
    assert EVIL in looked_at(study).text
    values = np.array([0.0, 1.0])
    assert (
        "&lt;script"
        in crane.simulation.Comparison(
            values, (ChannelComparison(EVIL, "m", values, values),)
        )._repr_html_()
    )


def test_a_comparison_of_nothing_says_so():
    found = looked_at(crane.simulation.Comparison(np.array([0.0, 1.0]), ()))
    assert not found.addresses
    assert "no picture: the file has no channel that the simulation has too" in found.text


def test_markdown_makes_tables_and_no_addresses():
    text = f"# title\n\nof `a_b` and {EVIL} <http://x.y>\n\n- one\n\n| a | b |\n| --- | ---: |\n"
    found = Parsed(
        "".join(notebook._split_blocks(text + "| **x** | 2 |\n", notebook._render_markdown))
    )
    assert not found.addresses and "script" not in found.tags and "title" not in found.text
    assert {"code", "li", "table", "strong"} <= set(found.tags) and EVIL in found.text


def section_chart(folder):
    """Of a boom that is lifted."""
    machine = crane.load(write_boom(folder))
    control = crane.ComputedTorque(machine, crane.point_to_point([0.3], [0.4], 1.0))
    run = crane.simulate(machine, control, duration=0.1, step=0.01)
    return crane.dynamics.section_chart(machine, run, "boom")


def results(mini, run, folder):
    """Of each class that is shown, one that takes little."""
    patu, digger = crane.load("patu655"), crane.load("excavator")
    swing = crane.ValvePD(patu, crane.task_trajectory(patu, "swing"))
    account = crane.power_balance(patu, crane.simulate(patu, swing, duration=0.2))
    values = run.time, run.q[:, 0]
    by = ["link7.mass"]
    lift = crane.PI(mini, crane.task_trajectory(mini, "lift"))
    yield crane.study("mini_forwarder", {by[0]: [0.1, 0.2]}, ["lift"], ["peak_X1"])
    yield crane.workspace(mini, 100)
    yield crane.identify(mini, run, prior=0.3)
    yield crane.capacity(patu, step=1.0)
    yield crane.ratings.lift_chart(patu, ["X_lift"])
    yield crane.ratings.torques(patu, radius=5.0)
    yield crane.ratings.breakout(digger)
    yield crane.working_range(digger)
    yield crane.simulation.settle(digger)
    yield section_chart(folder)
    yield crane.ratings.tool_force(digger, "up", step=2.0)
    yield account
    yield crane.studies.PowerComparison({"one": account, "two": account})
    yield crane.linearize(patu)
    yield crane.sensitivities(mini, lift, parameters=by, duration=0.1)
    yield crane.simulation.gradient(
        mini, lift, duration=0.1, functional=np.ones((101, 3)), parameters=by
    )
    yield crane.simulation.Comparison(
        values[0], (ChannelComparison("q1", "rad", values[1], values[1]),)
    )
    channel = (run.time < 7.0, values[1], 1.1 * values[1], values[1])
    fitted = FittedParameter("link7.mass", 0.2, 0.21, 0.01, False, False, "kg")
    sensor = Sensed("a.csv", "q1", "rad", run.time, *channel)
    yield crane.identification.Calibration(mini, (fitted,), (sensor,), {by[0]: 0.21}, (), 7)
    yield crane.excite(mini, starts=1, harmonics=2, period=4.0)
    yield crane.design("mini_forwarder", {by[0]: (0.1, 0.3)}, minimise=["mass"], starts=1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::crane.CraneWarning")
def test_every_result_has_its_line_its_figure_and_its_table(mini, run, tmp_path):
    seen = set()
    for result in results(mini, run, tmp_path):
        found, name = looked_at(result), type(result).__name__
        assert found.text.count(repr(result)) == 1 and len(repr(result)) <= 200
        assert {"table", "pre"} & set(found.tags), name
        assert bool(found.addresses) == (name in WITH_FIGURES), name
        assert "no picture" not in found.text and bool(found.inner) == (name == "LinearModel")
        seen.add(name)
    others = {"Recording", "SignalExcitation"}  # looked at above, and in test_excite_valves
    assert seen | others >= WITH_FIGURES


def test_what_has_nothing_to_show_is_shown_in_its_line(mini):
    assert crane.Dynamics(mini)._repr_html_() is None
    formatter = pytest.importorskip("IPython.core.formatters").DisplayFormatter()
    assert set(formatter.format(mini.closure)[0]) == {"text/plain"}
    both, _ = formatter.format(mini)
    assert set(both) == {"text/plain", "text/html"} and both["text/plain"] == repr(mini)


def instances(mini, run):
    """One of each public class that tests can make in no time."""
    patu, grapple = crane.load("patu655"), crane.load("patu655_grapple")
    lift, swing = crane.task_trajectory(mini, "lift"), crane.task_trajectory(patu, "swing")
    pd, zeros = crane.ValvePD(patu, swing), np.zeros(2)
    phase = crane.description.Phase("out", {"X_ext": 0.6}, {"X_ext": 0.3}, 5.0)
    soil = next(iter(crane.description.SOILS.values()))
    joint = crane.studies.SwayStudy("swing", (SwayRow(0.0, "flat", 0.0, 1.0, 1.0, 0.01, 0.5),))
    fitted = FittedParameter("link7.mass", 0.2, 0.21, 0.01, False, False, "kg")
    return [
        mini,
        mini.closure,
        run,
        lift,
        swing,
        soil,
        joint,
        pd,
        phase,
        crane.simulation.Batch(zeros, *(np.zeros((3, 2, n)) for n in (3, 3, 3, 4)), {}, {}),
        crane.dynamics.Buckling(patu),
        crane.identification.Calibration(mini, (fitted,), (), {}, (), 1),
        crane.ComputedTorque(mini, lift),
        crane.description.Contact("tip"),
        crane.description.SoilCutting("tip", soil, 1.0, 0.5, [0, 0, 1], [1, 0, 0]),
        crane.Dynamics(mini),
        crane.description.EndStop("x", 1e6),
        crane.description.ExternalForce("tip"),
        crane.description.ForceElement("x", 10.0),
        crane.description.Friction(1.0),
        crane.description.GasSpring("x", 1e-3, 1e6, 1e-4),
        crane.description.Ground(),
        crane.Kinematics(mini),
        crane.control.ControlLaw(mini),
        crane.hydraulics.PDGains(1.0, 2.0),
        crane.PI(mini, lift),
        crane.description.PIGains(1.0, 2.0),
        crane.Payload("tip", 10.0),
        crane.description.PhasedWrench("tip", [[0, 0, 1.0]] * 2, phases=[0, 1]),
        crane.control.LeverPhases(patu, [phase]),
        crane.description.WrenchFunction("tip", lambda t, *state: np.zeros(6)),
        crane.dynamics.Reactions(mini),
        crane.description.Rope(("a", "b"), 1.0, 1e5),
        crane.ratings.Rule("own", "mine"),
        crane.control.SampledCommand(lambda t, *state: np.zeros(4), patu),
        crane.description.Sensor(),
        crane.control.ValveSignals(patu, [0, 1], {x: zeros for x in patu.hydraulics.joints}),
        crane.motion.Sway(grapple),
        crane.control.TipVelocity(patu, lambda t: np.zeros(3)),
        crane.motion.Transmission(mini),
        crane.control.ZeroForce(mini),
        crane.ratings.Torques("X", "q", 1e4, 0.1, 5.0, 300.0, 1.0, 1.5e4, 1e4),
        crane.control.ValveDrive(patu, pd),
        crane.control.ValveFeedforward(patu, swing),
        crane.motion.via_attitudes([0, 1], [[0, 0, 0], [0, 0, 1.0]]),
        crane.Wrench("tip", (0, 0, 1.0)),
    ]


def test_every_class_is_shown_in_one_line(mini, run):
    seen = set()
    for thing in instances(mini, run):
        line, name = repr(thing), type(thing).__name__
        assert len(line) <= 200 and "\n" not in line and " at 0x" not in line, line
        assert name in line
        seen.add(name)
    submodules = [
        x for x in (getattr(crane, name) for name in crane.__all__) if inspect.ismodule(x)
    ]
    listed = [getattr(module, name) for module in submodules for name in module.__all__]
    shown = {x.__name__ for x in listed if inspect.isclass(x) and issubclass(x, OneLineRepr)}
    elsewhere = {"FmuController", "SectionForces"}  # test_fmu, test_section_forces
    assert shown - seen == RESULTS | elsewhere


# Results whose figures a notebook shows; those of cylinders come from identifications of minutes.
WITH_FIGURES = {
    name
    for name, files in result_files.RESULT_FILES.items()
    if files.notebook_figures or files.figures
} - {"CylinderFriction", "OrificeCoefficients", "ValveCurve"}
# Those that take seconds: `results`, and tests of what makes them.
RESULTS = {
    "Breakout", "Capacity", "Comparison", "Design", "Excitation", "Gradient", "Identification",
    "LiftChart", "LinearModel", "PowerBalance", "PowerComparison", "SectionChart", "Sensitivities",
    "SignalExcitation", "StandingMachine", "Study", "ToolForce", "WorkingRange", "Workspace",
}  # fmt: skip


def test_lines_say_what_there_is(mini, run):
    patu = crane.load("patu655")
    machine = "Machine('{}', {} degrees of freedom, {} joints, {} loops{})"
    assert repr(mini) == machine.format("mini_forwarder", 3, 11, 4, "")
    assert repr(patu) == machine.format("patu655", 4, 10, 3, ", hydraulic")
    assert repr(run).startswith("Recording of mini_forwarder: loading, 10 s in 10001 samples: 30 ")
    long = dataclasses.replace(mini, name=1000 * "a\nb")
    assert len(repr(long)) == 200 and "\n" not in repr(long) and repr(long).endswith("\u2026")
    assert one_line_repr.shorten_to_line("a\nb") == "a b"


@pytest.fixture
def heard(monkeypatch):
    """Shares that somebody listens to."""
    monkeypatch.setattr(PROGRESS, "is_enabled", True)
    yield PROGRESS
    PROGRESS.reset()


def test_only_the_outermost_call_tells_its_share(heard):
    def outer():
        tell = progress_reporter(None)
        tell(0.25)
        inner()
        assert heard.finished_share(sys._getframe()) == 0.25
        given = [].append
        assert progress_reporter(given) is given

    def inner():
        assert progress_reporter(None) is ignore_progress
        assert heard.finished_share(sys._getframe()) == 0.25

    outer()
    assert heard.finished_share(sys._getframe()) is None  # it has returned
    again = progress_reporter(None)
    assert again is not None and heard.finished_share(sys._getframe()) == 0.0


def test_nobody_is_told_where_nobody_listens():
    assert not PROGRESS.is_enabled and progress_reporter(None) is ignore_progress


def test_calls_tell_shares_to_who_listens(heard, mini, monkeypatch):
    shares = []
    monkeypatch.setattr(heard, "_set_share", shares.append)
    crane.study("mini_forwarder", {"link7.mass": [0.1, 0.2]}, ["lift"], ["peak_X1"])
    assert shares == [0.5, 1.0]
    crane.simulate(mini, duration=0.01)
    assert shares[-1] == 1.0 and len(shares) > 3


class Handle:
    """What IPython's `display` gives."""

    def __init__(self):
        self.lines = []

    def update(self, line, raw):
        assert raw and line["text/plain"] == ""
        self.lines.append(line["text/html"])


def test_a_cell_that_takes_long_has_a_line_that_goes(monkeypatch, heard):
    handle, events = Handle(), {}
    shell = SimpleNamespace(events=SimpleNamespace(register=events.__setitem__))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(
        display=lambda line, raw, display_id: handle.update(line, raw) or handle))  # fmt: skip
    monkeypatch.setattr(progress, "REPORT_DELAY", 0.02)
    monkeypatch.setattr(progress, "REPORT_INTERVAL", 0.02)
    notebook_progress.show_cell_progress(shell)
    busy = compile(
        "tell = telling(None)\ntell(0.5)\nwhile len(lines) < 3: sleep(0.01)", "x", "exec"
    )
    names = {"__name__": "crane.studies.x", "telling": progress_reporter, "lines": handle.lines}
    exec(busy, names | {"sleep": time.sleep})
    events["post_run_cell"](None)
    assert handle.lines[-1] == "" and len(handle.lines) > 3
    assert 'value="0.500"></progress> computing variants, 50%' in handle.lines[-2]
    count = len(handle.lines)
    events["pre_run_cell"](None)
    time.sleep(0.1)  # nothing of the package runs
    events["post_run_cell"](None)
    assert len(handle.lines) == count


CELLS = """
import crane; from crane.common import progress; progress.REPORT_DELAY = 0.2
progress.REPORT_INTERVAL = 0.05
machine = crane.load("mini_forwarder"); machine
---
control = crane.PI(machine, crane.task_trajectory(machine, "loading"))
run = crane.simulate(machine, control, label="loading"); run
---
masses = [0.1 + 0.001 * i for i in range(20)]
crane.study("mini_forwarder", {"link7.mass": masses}, ["lift"], ["peak_X1"])
---
raise ValueError("own")
---
crane.workspace(machine, 100)
"""


@pytest.mark.slow
def test_a_real_notebook(tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(SOURCE), prepend=":")
    made = [nbformat.v4.new_code_cell(text) for text in CELLS.split("---\n")]
    book, bars = nbformat.v4.new_notebook(cells=made), []

    class Client(nbclient.NotebookClient):
        def process_message(self, msg, cell, index):
            html = msg["content"].get("data", {}).get("text/html", "")
            if "<progress" in html and "display" in msg["msg_type"]:
                bars.append((index, html))
            return super().process_message(msg, cell, index)

    Client(book, timeout=300, kernel_name="python3", allow_errors=True,
           resources={"metadata": {"path": str(tmp_path)}}).execute()  # fmt: skip
    told = [html for index, html in bars if index == 2]
    assert any("computing motions" in html or "reading" in html for html in told)
    assert any('value="0.' in html for html in told)
    results = [
        [x for x in cell.outputs if x.output_type == "execute_result"] for cell in book.cells
    ]
    assert [len(x) for x in results] == [1, 1, 1, 0, 1]
    assert book.cells[3].outputs[0].ename == "ValueError"
    for cell in book.cells:
        assert "<progress" not in str(cell.outputs)  # of what is over nothing stays
    lines = ("Machine(", "Recording of", "Study of", "", "Workspace of")
    for outputs, words in zip(results, lines, strict=True):
        for output in outputs:
            assert words in output.data["text/plain"] and words in output.data["text/html"]


@pytest.mark.slow
def test_the_motion_plays_in_a_notebook(run, tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium in the path")
    file, wrong, asked = tmp_path / "notebook.html", [], []
    file.write_text(f"<!DOCTYPE html><meta charset='utf-8'>{run._repr_html_()}")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium,
            args=["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
                  "--enable-unsafe-swiftshader"],
        )  # fmt: skip
        page = browser.new_page(viewport={"width": 390, "height": 800})
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(file.as_uri())
        inner = page.frame_locator("iframe")
        sync_api.expect(inner.locator("#machine")).to_have_text("mini_forwarder", timeout=60_000)
        inner.locator("#next").click()
        sync_api.expect(inner.locator("#clock")).not_to_contain_text("0.00 /")
        (frame,) = page.frames[1:]
        reach = "(() => { try { return parent.document.title } catch (e) { return e.name } })()"
        assert frame.evaluate(reach) == "SecurityError"
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        browser.close()
    assert not wrong and all(x.startswith(("file:", "data:", "blob:", "about:")) for x in asked)
