"""The run page in a browser: shown values equal the recording, no outside requests."""

import base64
import dataclasses
import itertools
import shutil
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from executed_lines import at_most
from warned import quiet

import crane
from crane.common.errors import CraneWarning, RecordingError
from crane.formats.visuals.urdf_shapes import BoxShape, CylinderShape
from crane.recordings.recording import Recording
from crane.view.page.force_markers import full_arrow_forces, spring_markers
from crane.view.page.page_channels import ThinningGrid, page_columns, plot_groups
from crane.view.page.report_page import mechanical_work, reached_limit_sentences, summarize_run
from crane.view.page.scene import build_scene, link_poses, read_visuals, sliding_body_visuals

DATA = Path(__file__).parent / "data"
WEBGL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
CORNERS = [[0.0, 0.0221, 0.0108], [0.4, 0.03, 0.0], [1.1, 0.0, 0.03], [-0.7, 0.002, 0.004]]


@pytest.fixture(scope="module")
def machine():
    return quiet(crane.load, "mini_forwarder")


@pytest.fixture(scope="module")
def recording(machine):
    """Two seconds at 5 ms from t = 3 s, forces that change their signs on the way."""
    time = 3.0 + np.linspace(0, 2, 401)
    nodes = [3.0, 3.75, 4.25, 5.0]
    q_a = np.column_stack([np.interp(time, nodes, column) for column in np.transpose(CORNERS)])
    q = machine.closure.solve(q_a)
    tau = np.column_stack([0.1 * (4.2 - time), 50 * (4 - time), 20 * (time - 4.5)])
    passive = [joint for joint in machine.joints if joint not in machine.active]
    channels = {joint: q[:, machine.column(joint)] for joint in passive}
    channels["pressure_X1_a"] = 1e6 * (1 + np.sin(9 * time) ** 2)
    channels["reference_X1"] = q_a[:, 1] + 1e-3
    return Recording(
        time=time,
        joints=machine.active,
        q=q_a,
        v=np.gradient(q_a, time, axis=0),
        tau=tau,
        units={joint: machine.unit(joint) for joint in machine.active},
        channels=channels,
        channel_units={"pressure_X1_a": "Pa"},
        task="round the corners",
    )


def part(recording, rows, time=None):
    """Some samples of a recording, perhaps at other times."""
    return dataclasses.replace(
        recording,
        time=recording.time[rows] if time is None else time,
        channels={name: values[rows] for name, values in recording.channels.items()},
        **{name: getattr(recording, name)[rows] for name in ("q", "v", "tau")},
    )


def decoded(text):
    return np.frombuffer(base64.b64decode(text), "<f4")


def line(found, name):
    """(group, line) of a column."""
    ((group, wanted),) = [(g, x) for g in found for x in g["lines"] if x["name"] == name]
    return group, wanted


def test_extremes_survive_thinning_out(machine):
    """One outlier in a million samples is visible."""
    time = np.arange(300_001) * 1e-3
    rng = np.random.default_rng(3)
    tau = rng.normal(size=(len(time), 3))
    tau[123_456, 1], tau[200_001, 1] = 91.25, -77.5
    q = np.tile(machine.home[machine.closure.active], (len(time), 1))
    units = {joint: machine.unit(joint) for joint in machine.active}
    recording = Recording(time, machine.active, q, 0 * q, tau, units)
    frames = np.arange(0, len(time), 33)
    grid = ThinningGrid.from_recording(recording, frames)
    _, found = line(plot_groups(machine, recording, grid), "X1_force")
    low, high = decoded(found["series"]["low"]), decoded(found["series"]["high"])
    assert len(low) == len(high) < 10_000
    assert (low.min(), high.max()) == (-77.5, 91.25)
    centres = np.frombuffer(base64.b64decode(grid.time_axis()["time"]), "<f8")
    span = time[-1] / len(centres)
    assert centres[high.argmax()] == pytest.approx(time[123_456], abs=span)
    np.testing.assert_allclose(decoded(found["series"]["frames"]), tau[frames, 1], rtol=1e-7)


def test_columns_are_grouped_and_read_in_handy_units(machine, recording):
    grid = ThinningGrid.from_recording(recording, np.arange(401))
    found = plot_groups(machine, recording, grid)
    expected = {
        "q1": ("Angles", "deg", 180 / np.pi),
        "X1": ("Strokes", "mm", 1e3),
        "X1_velocity": ("Stroke velocities", "mm/s", 1e3),
        "X1_force": ("Forces", "N", 1.0),
        "pressure_X1_a": ("Pressures", "bar", 1e-5),
        "q9": ("Passive angles", "deg", 180 / np.pi),
    }
    values = recording.columns()
    for name, (title, unit, scale) in expected.items():
        group, there = line(found, name)
        assert (group["title"], group["unit"]) == (title, unit)
        shown = decoded(there["series"]["low"])
        np.testing.assert_allclose(shown, scale * values[name], rtol=2e-7, atol=1e-6)
    opened = {group["title"] for group in found if group["open"]}
    assert {"Angles", "Strokes", "Forces", "Pressures"} <= opened
    assert "Passive angles" not in opened
    wanted = decoded(line(found, "X1")[1]["reference"]["low"])
    np.testing.assert_allclose(wanted, 1e3 * (recording.q[:, 1] + 1e-3), rtol=1e-6)


def test_every_column_is_on_the_page_once(machine, recording):
    names = [column.name for column in page_columns(machine, recording)]
    references, derived = {"reference_X1"}, {"error_X1"}
    assert sorted(names) == sorted(set(recording.columns()) - {"time"} - references | derived)


def test_errors_and_the_sum_of_energies_are_plotted(machine, recording):
    energies = {"kinetic": recording.time**2, "potential": 1 - recording.time}
    energetic = dataclasses.replace(
        recording,
        channels=recording.channels | energies,
        channel_units=recording.channel_units | dict.fromkeys(energies, "J"),
    )
    found = plot_groups(machine, energetic, ThinningGrid.from_recording(energetic, np.arange(401)))
    group, there = line(found, "error_X1")
    assert (group["title"], group["unit"], there["label"]) == ("Errors", "mm", "X1")
    np.testing.assert_allclose(decoded(there["series"]["low"]), 1.0, rtol=1e-6)
    group, there = line(found, "kinetic + potential")
    assert (group["title"], group["unit"]) == ("Energies", "J")
    expected = sum(energies.values())
    np.testing.assert_allclose(decoded(there["series"]["low"]), expected, rtol=1e-6)


def test_equal_runs_give_equal_pages(machine, recording, tmp_path):
    pages = [crane.report(machine, recording, tmp_path / f"{i}.html") for i in range(2)]
    one, two = (page.read_bytes() for page in pages)
    assert one == two


def test_work_and_limits(machine, recording):
    given, taken = mechanical_work(recording)
    power = (recording.tau * recording.v).sum(axis=1)
    assert given - taken == pytest.approx(np.trapezoid(power, recording.time), rel=1e-12)
    assert min(given, taken) >= 0
    told = reached_limit_sentences(machine, recording)
    assert len(told) == 4  # X1 and X2 go from one end to the other
    assert told[0].startswith("X1 reaches its lower limit of 0 mm at 4.25 s")
    assert not summarize_run(machine, None)["forces"]


def test_a_second_recording_has_to_be_of_the_machine(machine, recording, tmp_path):
    units = {"q1": "rad", "x1": "m", "X2": "m"}
    other = dataclasses.replace(
        recording, joints=tuple(units), units=units, channels={}, channel_units={}
    )
    with pytest.raises(RecordingError, match="the second recording: .* no joint 'X1'"):
        crane.report(machine, recording, tmp_path / "page.html", other)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_minute_at_a_thousand_hertz_is_small_and_no_work_of_its_rows(
    machine, recording, tmp_path
):
    rows = np.arange(60_001) % 401
    long = part(recording, rows, np.arange(60_001) * 1e-3)
    with at_most(50_000):  # lines; below one per sample, of which there are 60,000
        page = crane.report(machine, long, tmp_path / "page.html")
    assert page.stat().st_size < 5e6


@pytest.fixture(scope="module")
def browser():
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium in the path")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=WEBGL)
        yield started
        started.close()


@pytest.fixture
def opened(browser, tmp_path):
    """Opens a report, sees at the end that nothing was asked for and nothing complained."""
    pages = []

    def open_report(machine, recording, other=None, size=(1280, 720), **options):
        path = crane.report(machine, recording, tmp_path / f"page{len(pages)}.html", other)
        page = browser.new_page(
            viewport=dict(zip(("width", "height"), size, strict=True)), **options
        )
        problems, requests = [], []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on(
            "console",
            lambda line: problems.append(line.text) if line.type in ("error", "warning") else None,
        )
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_function("window.crane !== undefined")
        pages.append((page, path, problems, requests))
        return page

    yield open_report
    for page, path, problems, requests in pages:
        page.close()
        assert requests == [path.as_uri()]
        assert problems == []


def world(machine, q, link):
    """(4, 4) pose of a link."""
    data = machine.model.createData()
    pin.forwardKinematics(machine.model, data, q)
    return pin.updateFramePlacement(machine.model, data, machine.frame(link)).homogeneous


def scrub(page, share):
    """Drag the time bar's thumb there."""
    box = page.locator("#seek").bounding_box()
    page.mouse.click(box["x"] + 8 + share * (box["width"] - 16), box["y"] + box["height"] / 2)


@pytest.mark.slow
def test_bodies_are_where_forward_kinematics_has_them(machine, recording, opened):
    page = opened(machine, recording)
    links = [f.name for f in machine.model.frames if f.type == pin.FrameType.BODY]
    assert len(links) > len({visual.link for visual in read_visuals(machine)})  # some bare ones
    q = machine.closure.solve(recording.q)
    seen = set()
    for share in (0.0, 0.23, 0.5, 0.81, 1.0, 0.12):
        scrub(page, share)
        time = page.evaluate("crane.time")
        sample = int(np.argmin(abs(recording.time - time)))
        assert recording.time[sample] == pytest.approx(time, abs=1e-12)  # a recorded instant
        assert (time - 3) / 2 == pytest.approx(share, abs=0.02)
        seen.add(sample)
        for link in links:
            shown = np.reshape(page.evaluate("(link) => crane.pose(link)", link), (4, 4)).T
            np.testing.assert_allclose(shown, world(machine, q[sample], link), atol=1e-6)
    assert len(seen) == 6
    assert page.inner_text("#machine") == "mini_forwarder"
    assert page.inner_text("#task") == "round the corners"


@pytest.mark.slow
def test_marks_are_where_the_machine_has_them(machine, recording, opened):
    page = opened(machine, recording)
    page.evaluate("crane.seek(4.2)")
    sample = int(np.argmin(abs(recording.time - page.evaluate("crane.time"))))
    q = machine.closure.solve(recording.q[sample])
    data = machine.model.createData()
    centre = pin.centerOfMass(machine.model, data, q)
    shown = page.evaluate("crane.marks.layers.mass.object.children[0].position.toArray()")
    np.testing.assert_allclose(shown, centre, atol=1e-9)
    pins = page.evaluate(
        "crane.marks.layers.pins.object.children.map((pin) => pin.position.toArray())"
    )
    loops = machine.closure.equations.loops
    for place, loop in zip(pins, loops, strict=True):
        for end in (loop.predecessor, loop.successor):  # both ends: the loops are closed
            np.testing.assert_allclose(place, world(machine, q, end)[:3, 3], atol=1e-6)


@pytest.mark.slow
def test_cursor_values_and_clock_are_of_one_time(machine, recording, opened):
    page = opened(machine, recording)
    for share in (0.3, 0.7):
        scrub(page, share)
        time = page.evaluate("crane.time")
        cursors = page.evaluate(
            "crane.channels.panels.filter((p) => p.open).map((p) => p.plot.time)"
        )
        assert len(cursors) >= 4
        assert set(cursors) == {time}
        assert page.inner_text("#clock").startswith(f"{time:.2f} /")
        sample = int(np.argmin(abs(recording.time - time)))
        for name, scale in (("X1", 1e3), ("X1_force", 1.0), ("pressure_X1_a", 1e-5)):
            text = page.inner_text(f"button.chip[title='{name}'] b").replace("\u2212", "-")
            value = scale * recording.columns()[name][sample]
            assert float(text) == pytest.approx(value, rel=1e-3, abs=2e-3)


@pytest.mark.slow
def test_dragging_in_a_plot_moves_the_machine(machine, recording, opened):
    page = opened(machine, recording)
    box = page.locator(".canvases").first.bounding_box()
    page.mouse.move(box["x"] + 80, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] - 30, box["y"] + 40)
    page.mouse.up()
    assert page.evaluate("crane.time") > 4.5
    assert float(page.input_value("#seek")) == pytest.approx(page.evaluate("crane.time"))


@pytest.mark.slow
def test_arrows_turn_with_the_sign_of_the_force(machine, recording, opened):
    """X1 pushes before 4 s and pulls after, q1 turns back after 4.2 s: red, and then blue.

    A straight arrow points along the force, a round one turns right-handed about the torque.
    """
    page = opened(machine, recording)
    q = machine.closure.solve(recording.q)
    found = []
    for time in (3.2, 3.7, 4.4, 4.9):
        page.evaluate("(time) => crane.seek(time)", time)
        sample = int(np.argmin(abs(recording.time - page.evaluate("crane.time"))))
        (direction, length, colour), (normal, _, turning) = page.evaluate(
            """() => ["X1", "q1"].map((wanted) => {
                const { arrow } = crane.marks.arrows.find(({ name }) => name === wanted);
                const own = arrow.shaft ? [0, 1, 0] : [0, 0, 1];
                const direction = arrow.tip.position.clone().set(...own);
                const { r, b } = arrow.material.color;
                direction.applyQuaternion(arrow.object.quaternion);
                const length = arrow.shaft ? arrow.shaft.scale.y + arrow.tip.scale.y : 0;
                return [direction.toArray(), length, r - b];
            })"""
        )
        force = recording.tau[sample, 1]
        axis = world(machine, q[sample], "A1_rod")[:3, 0]
        np.testing.assert_allclose(direction, np.sign(force) * axis, atol=1e-6)
        assert np.sign(colour) == np.sign(force)
        torque = recording.tau[sample, 0]
        np.testing.assert_allclose(normal, [0, 0, np.sign(torque)], atol=1e-6)
        assert np.sign(turning) == np.sign(torque)
        found.append((abs(force), length))
    (f1, l1), (f2, l2), _, (f4, l4) = found
    assert l1 / l2 == pytest.approx(f1 / f2, rel=1e-3)
    assert l1 / l4 == pytest.approx(f1 / f4, rel=1e-3)


@pytest.mark.slow
def test_springs_reach_from_frame_to_frame(opened, tmp_path):
    text = (DATA / "slider_crank.yaml").read_text().replace("urdf: ", f"urdf: {DATA}/")
    text += "forces: [{between: [base, slider], stiffness: 30, rest: 0.1, damping: 1}]\n"
    (tmp_path / "sprung.yaml").write_text(text)
    sprung = crane.load(tmp_path / "sprung.yaml")
    run = crane.simulate(sprung, duration=0.2)
    page = opened(sprung, run)
    for sample in (0, 120, 200):
        page.evaluate("(time) => crane.seek(time)", run.time[sample])
        sample = int(np.argmin(abs(run.time - page.evaluate("crane.time"))))
        start, end = page.evaluate(
            """() => {
                const { link: { object, long } } = crane.marks.springs[0];
                object.updateMatrix();
                const wire = long[0][0];
                wire.updateMatrix();
                const { array } = wire.geometry.attributes.position;
                const count = array.length / 3 / 301;  // points around the wire
                const centre = (i) => {
                    const sum = object.position.clone().set(0, 0, 0);
                    for (let k = 0; k < count - 1; k++) {
                        const at = 3 * (i * count + k);
                        sum.add(sum.clone().set(...array.slice(at, at + 3)));
                    }
                    sum.multiplyScalar(1 / (count - 1));
                    return sum.applyMatrix4(wire.matrix).applyMatrix4(object.matrix).toArray();
                };
                return [centre(0), centre(300)];
            }"""
        )
        q = np.array([run.columns()[joint][sample] for joint in sprung.joints])
        np.testing.assert_allclose(start, world(sprung, q, "base")[:3, 3], atol=1e-5)
        np.testing.assert_allclose(end, world(sprung, q, "slider")[:3, 3], atol=1e-5)


@pytest.mark.slow
def test_it_plays_pauses_and_listens_to_keys(machine, recording, opened):
    page = opened(machine, recording)
    now = lambda: page.evaluate("crane.time")  # noqa: E731
    assert now() == 3.0
    page.click("#play")
    page.wait_for_function("crane.time > 3.2")
    page.keyboard.press("Space")
    stopped = now()
    page.wait_for_timeout(200)
    assert now() == stopped
    assert abs(recording.time - stopped).min() < 1e-12  # stands at a recorded instant
    page.keyboard.press("Home")
    assert now() == 3.0
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert now() == pytest.approx(3 + 2 / 30, abs=0.0026)
    page.keyboard.press("ArrowLeft")
    assert now() == pytest.approx(3 + 1 / 30, abs=0.0026)
    page.keyboard.press("End")
    assert now() == 5.0
    page.click("#first")
    page.select_option("#speed", "5")
    page.keyboard.press("Escape")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Space")
    page.wait_for_function("crane.time === 5 && !crane.timeline.playing", timeout=120_000)


@pytest.mark.slow
def test_views_marks_and_channels_are_switched(machine, recording, opened):
    page = opened(machine, recording)
    for view in ("iso", "side", "front", "top"):
        page.click(f"#views button:text-is('{view}')")
        seen = page.evaluate(
            "crane.viewer.camera.position.clone().sub(crane.viewer.controls.target)"
            ".normalize().toArray()"
        )
        back = {"side": [0, 0, 1], "front": [1, 0, 0], "top": [0, 1, 0]}.get(view)
        if back is not None:  # the viewer's y axis is up
            np.testing.assert_allclose(seen, back, atol=2e-3)
    page.click("#follow")
    before = page.evaluate("crane.viewer.controls.target.toArray()")
    page.evaluate("crane.seek(4.0)")
    after = page.evaluate("crane.viewer.controls.target.toArray()")
    q = machine.closure.solve(recording.q)
    x, y, z = (world(machine, q[200], "link7_tip") - world(machine, q[0], "link7_tip"))[:3, 3]
    np.testing.assert_allclose(np.subtract(after, before), [x, z, -y], atol=1e-6)
    for layer in ("forces", "path", "mass", "pins"):
        page.click(f"#layers button[data-layer={layer}]")
        assert not page.evaluate(f"crane.marks.layers.{layer}.object.visible")
    lines = "crane.channels.panels.find((p) => p.group.title === 'Strokes').plot.lines.length"
    count = page.evaluate(lines)
    page.click("button.chip[title='X1']")  # with its reference
    assert page.evaluate(lines) == count - 2
    page.click("#more button:text('Passive angles')")
    assert page.is_visible("button.chip[title='q9']")


@pytest.mark.slow
def test_a_second_recording_is_a_ghost_with_lines_of_its_own(machine, recording, opened):
    later = dataclasses.replace(part(recording, np.arange(100, 401)), task="late")
    page = opened(machine, recording, later)
    page.evaluate("crane.seek(3.2)")
    assert not page.evaluate("ghost.visible")  # it has not begun
    page.evaluate("crane.seek(4.5)")
    assert page.evaluate("ghost.visible")
    same = page.evaluate(
        "Object.keys(ghostGroups).every((link) => ghostGroups[link].matrix.elements"
        ".every((x, i) => Math.abs(x - crane.space.groups[link].matrix.elements[i]) < 1e-2))"
    )
    assert same
    second = page.inner_text("button.chip[title='X1'] i").replace("\u2212", "-")
    assert float(second) == pytest.approx(float(page.inner_text("button.chip[title='X1'] b")))
    apart = dataclasses.replace(recording, time=recording.time + 1e6)
    page = opened(machine, recording, apart)
    assert page.evaluate("ghost.visible")  # both start together, which the page tells
    assert "clock moved" in page.inner_text("#over")


@pytest.mark.slow
@pytest.mark.parametrize(
    "size",
    [(1280, 720), (390, 844), *(pytest.param(x, marks=pytest.mark.long)
                                for x in ((844, 390), (768, 1024)))],
)  # fmt: skip
def test_one_sample_and_a_still_machine_fit_in_every_window(machine, recording, opened, size):
    for shown in (part(recording, np.array([70])), None, recording):
        page = opened(machine, shown, size=size, has_touch=size[0] < 1000)
        page.wait_for_timeout(300)
        wide, high = page.evaluate(
            "[document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
        )
        assert (wide, high) == size
        assert page.evaluate("document.getElementById('side').scrollWidth") <= size[0]
        cut = page.evaluate(
            """() => [...document.querySelectorAll("button, select, h1, h2, #clock, #summary")]
                .filter((item) => item.offsetParent !== null)
                .map((item) => [item.id || item.textContent, item.getBoundingClientRect()])
                .filter(([, box]) => box.left < -0.5 || box.right > innerWidth + 0.5)
                .map(([name]) => name)"""
        )
        assert cut == []
        boxes = page.evaluate(
            """() => ["views", "layers", "summary"].map((id) => document.getElementById(id))
                .filter((item) => item.parentElement.id === "space")
                .map((item) => item.getBoundingClientRect())
                .map(({ left, right, top, bottom }) => [left, right, top, bottom])"""
        )
        for one, two in itertools.combinations(boxes, 2):
            apart = one[1] <= two[0] or two[1] <= one[0] or one[3] <= two[2] or two[3] <= one[2]
            assert apart, (one, two)
        q = machine.home if shown is None else machine.closure.solve(shown.q[0])
        pose = np.reshape(page.evaluate("crane.pose('link7')"), (4, 4)).T
        np.testing.assert_allclose(pose, world(machine, q, "link7"), atol=1e-6)
        assert page.is_visible("#player") == (shown is not None)


@pytest.mark.slow
def test_touch_moves_the_time(machine, recording, opened):
    page = opened(machine, recording, size=(390, 844), has_touch=True)
    box = page.locator(".canvases").first.bounding_box()
    page.touchscreen.tap(box["x"] + 0.6 * box["width"], box["y"] + 30)
    assert 3.8 < page.evaluate("crane.time") < 4.5


@pytest.mark.slow
def test_a_clock_that_counts_from_long_ago_is_shown_from_its_start(machine, recording, opened):
    page = opened(machine, part(recording, slice(None), recording.time + 1.7e9 + 0.25))
    assert page.inner_text("#clock") == "0.25 / 2.25 s"
    assert "1700000003 s" in page.inner_text("#summary")
    page.keyboard.press("End")
    assert page.evaluate("crane.time") == pytest.approx(1.7e9 + 5.25, abs=1e-6)


@pytest.mark.slow
def test_without_webgl_plots_and_numbers_remain(machine, recording, browser, tmp_path):
    path = crane.report(machine, recording, tmp_path / "page.html")
    page = browser.new_page()
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.add_init_script(
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
        "    return kind.includes('webgl') ? null : get.call(this, kind, ...more);"
        "};"
    )
    page.goto(path.as_uri())
    page.keyboard.press("End")
    assert page.evaluate("crane.time") == 5.0
    assert page.inner_text("button.chip[title='X1'] b") == "2.000"
    assert "WebGL" in page.inner_text("#pane")
    page.close()
    assert problems == []


# --- markers ------------------------------------------------------------------------------------


SPRINGS = """forces:
  - {between: [guide, slider], stiffness: 300, rest: 0.2, damping: 5}
  - {between: [base, rod_eye], damping: 5}
  - {between: [base, rod_middle], force: -2}
  - {joint: s, stiffness: 20}
gas_springs: {strut: {between: [base, slider], area: 1.0e-4, pressure: 1.0e+4, volume: 1.0e-3}}
ropes:
  - {between: [base, rod_middle], length: 0.6, stiffness: 1.0e+4}
"""


@pytest.fixture(scope="module")
def sprung(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sprung")
    text = (DATA / "slider_crank.yaml").read_text().replace("urdf: ", f"urdf: {DATA}/")
    (folder / "sprung.yaml").write_text(text + SPRINGS)
    return crane.load(folder / "sprung.yaml")


def test_springs_are_drawn_from_frame_to_frame(sprung):
    q = sprung.closure.solve(np.array([[1.0], [1.4], [0.7]]))
    found = {tuple(spring["parts"]): spring for spring in spring_markers(sprung, q)}
    assert len(spring_markers(sprung, q)) == 5  # that of the joint has no place
    assert set(found) == {("coil", "strut"), ("strut",), ("line",)}
    for parts, links in ((("coil", "strut"), ("guide", "slider")), (("line",), None)):
        one, links = found[parts], links or ("base", "rod_middle")
        poses = link_poses(sprung, np.vstack([sprung.home[None], q]), links)
        start, end = (poses[link][:, :3, 3] for link in links)
        lengths = np.linalg.norm(end - start, axis=1)
        assert one["length"] == pytest.approx(lengths[0], abs=1e-12)
        assert one["least"] == pytest.approx(lengths[1:].min(), abs=1e-12)
        data = sprung.model.createData()
        pin.forwardKinematics(sprung.model, data, q[1])
        for place, expected in zip(one["ends"], (start[2], end[2]), strict=True):
            pose = np.reshape(place["placement"], (4, 4)).T
            shown = data.oMi[place["joint"] + 1].homogeneous @ pose
            np.testing.assert_allclose(shown[:3, 3], expected, atol=1e-12)


def test_ends_of_springs_are_in_the_picture(sprung, tmp_path):
    folder = tmp_path / "far"
    folder.mkdir()
    for part in ("crank", "slider"):
        text = (DATA / "slider_crank" / f"{part}.urdf").read_text()
        text = text.replace(
            '<link name="guide"/>',
            '<link name="guide"/><link name="far"/><joint name="j" type="fixed"><origin '
            'xyz="-2 0 1"/><parent link="base"/><child link="far"/></joint>',
        )
        drawn = '<visual><geometry><sphere radius="0.01"/></geometry></visual><inertial>'
        (folder / f"{part}.urdf").write_text(text.replace("<inertial>", drawn))
    text = (DATA / "slider_crank.yaml").read_text().replace("slider_crank/", f"{folder}/")
    text += "forces: [{between: [far, slider], stiffness: 3}]\n"
    (tmp_path / "far.yaml").write_text(text)
    scene = build_scene(crane.load(tmp_path / "far.yaml"))
    assert scene.lower[0] == pytest.approx(-2) and scene.upper[2] == pytest.approx(1)


def test_a_body_that_slides_and_is_not_drawn_is_a_block_along_its_axis(sprung):
    assert [visual.link for visual in sliding_body_visuals(sprung, ())] == ["slider"]
    (block,) = (visual for visual in read_visuals(sprung) if isinstance(visual.shape, BoxShape))
    np.testing.assert_allclose(block.placement[:3, 3], 0)
    assert block.shape.size[0] > block.shape.size[1] == block.shape.size[2]  # along x, as s
    assert sliding_body_visuals(sprung, [sprung.model.getJointId("s")]) == []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CraneWarning)
        for name in ("mini_forwarder", "patu655", "excavator"):  # all have shapes of their own
            machine = crane.load(name)
            links = {visual.link for visual in read_visuals(machine)}
            drawn = {machine.model.frames[machine.frame(link)].parentJoint for link in links}
            assert sliding_body_visuals(machine, drawn) == []


def test_a_cylinder_that_is_not_drawn_has_a_rod_that_stays_in_its_barrel(tmp_path):
    body = '<inertial><mass value="3"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="{x}">{body}</inertial></link>' for x in ("barrel", "rod"))
    (tmp_path / "cylinder.urdf").write_text(
        f"""<robot name="cylinder"><link name="base"/>{links}
        <joint name="pin" type="continuous"><parent link="base"/><child link="barrel"/>
        <axis xyz="0 1 0"/></joint>
        <joint name="stroke" type="prismatic"><parent link="barrel"/><child link="rod"/>
        <origin xyz="0.8 0 0.1"/><axis xyz="-1 0 0"/>
        <limit lower="0.1" upper="0.7" effort="1" velocity="1"/></joint></robot>"""
    )
    machine = crane.load(tmp_path / "cylinder.urdf")
    (rod,) = sliding_body_visuals(machine, ())
    assert rod.link == "rod" and isinstance(rod.shape, CylinderShape)
    ends = [(rod.placement @ [0, 0, z * rod.shape.length, 1])[:3] for z in (0.5, -0.5)]
    np.testing.assert_allclose(ends, [[0, 0, 0], [0.6, 0, 0]], atol=1e-15)  # against the axis
    text = (tmp_path / "cylinder.urdf").read_text().replace('lower="0.1" upper="0.7"', "{}")
    (tmp_path / "endless.urdf").write_text(text.format('lower="-1000" upper="1000"'))
    (block,) = sliding_body_visuals(crane.load(tmp_path / "endless.urdf"), ())
    assert isinstance(block.shape, BoxShape)  # such limits are placeholders


def test_arrows_are_in_proportion_to_what_joints_can():
    machine = quiet(crane.load, "mini_forwarder")
    limits = {"q1": 1.765, "X1": 80.0, "X2": 80.0}
    peaks = {"q1": 0.011, "X1": 40.0, "X2": 10.0}
    full = full_arrow_forces(machine, peaks)
    shares = {joint: peak / full[joint] for joint, peak in peaks.items()}
    expected = {joint: peaks[joint] / limits[joint] / 0.5 for joint in peaks}
    assert shares == pytest.approx(expected)
    assert full_arrow_forces(machine, dict.fromkeys(peaks, 0.0)) == pytest.approx(limits)


def test_without_limits_torques_are_forces_on_the_longest_body(tmp_path):
    text = (DATA / "slider_crank.yaml").read_text().replace("slider_crank/", f"{tmp_path}/")
    (tmp_path / "free.yaml").write_text(text)
    for part in ("crank", "slider"):
        urdf = (DATA / "slider_crank" / f"{part}.urdf").read_text()
        (tmp_path / f"{part}.urdf").write_text(urdf.replace('effort="50"', 'effort="0"'))
    machine = crane.load(tmp_path / "free.yaml", active=["theta"])
    assert full_arrow_forces(machine, {"theta": 6.0}) == pytest.approx({"theta": 6.0})
    sliding = crane.load(tmp_path / "free.yaml", active=["s"])
    peaks = {"theta": 6.0, "s": 10.0}  # 6 N m on a rod of 0.3 m are 20 N
    for one in (machine, sliding):
        full = full_arrow_forces(one, peaks)
        assert full == pytest.approx({"theta": 6.0, "s": 20.0})
