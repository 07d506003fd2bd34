"""The page on which a machine is driven, in a browser: its numbers are the library's."""

import json
import shutil
from itertools import pairwise

import numpy as np
import pytest
from command_line import typed
from warned import quiet

import crane
from crane.common.errors import InputError
from crane.motion.kinematics import Kinematics
from crane.recordings.measured_recordings import recorded_machine
from crane.view.page.drive_conditions import DriveConditions
from crane.view.page.drive_goals import goal_data
from crane.view.page.drive_levers import lever_data
from crane.view.page.drive_page import drive_html

WEBGL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def browser():
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium in the path")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=WEBGL)
        yield running
        running.close()


def opened(browser, path, **options):
    """The page, whose requests and errors are kept."""
    page = browser.new_page(**options)
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("console", lambda one: one.type == "error" and page.faults.append(one.text))
    page.on("request", lambda one: one.url.startswith("http") and page.faults.append(one.url))
    page.goto(path.as_uri())
    page.wait_for_function("window.crane && window.crane.state", timeout=30_000)
    return page


def dragged(page, x, y):
    """Drag the tip by some pixels, and hold it there; the force and its label then."""
    page.wait_for_function("pull.tip")
    place = "(() => { const { left, top } = element('pane').getBoundingClientRect();"
    left, top = page.evaluate(
        place + "const [x, y] = pull.pixels(pull.tip); return [left + x, top + y]; })()"
    )
    page.mouse.move(left, top)
    page.mouse.down()
    for share in (0.3, 0.6, 1.0):
        page.mouse.move(left + share * x, top + share * y)
        page.wait_for_timeout(100)
    until = page.evaluate("window.crane.state.time") + 0.4
    page.wait_for_function(f"window.crane.state.time > {until}", timeout=20_000)
    label, hand = page.text_content("output.pull"), page.evaluate("window.crane.state.hand")
    page.mouse.up()
    return np.array(hand["force"]), label


TRIANGLES = "viewer.renderer.info.render.triangles"  # of a frame; a processor draws each


def saved(page, path):
    """The recording that the page saves."""
    with page.expect_download() as download:
        page.click("#save")
    download.value.save_as(path)
    assert not page.faults
    page.close()
    return quiet(crane.Recording.from_csv, path)


def assert_replayed(machine, recorded, path):
    """The library moves as the page."""
    replayed, _ = quiet(crane.replay, machine, path, 0.01)
    np.testing.assert_allclose(recorded.q, replayed.q, rtol=0, atol=1e-10)
    assert np.median(np.abs(recorded.q - replayed.q)) < 1e-11
    for channel in ("tip_z", "pressure_supply", "work", "static_stability", "stability"):
        if channel in recorded.channels:
            scale = np.abs(replayed.channels[channel]).max()
            difference = recorded.channels[channel] - replayed.channels[channel]
            assert np.abs(difference).max() < 1e-7 * scale, channel
            assert np.median(np.abs(difference)) < 1e-9 * scale, channel
    assert recorded.channels.keys() <= replayed.channels.keys()


@pytest.mark.slow
def test_a_drive_with_another_load_and_slope_is_repeated_by_the_library(browser, tmp_path):
    done = typed("view", "excavator", "--drive", "--no-open", "--out", tmp_path / "drive.html")
    assert done.returncode == 0
    assert (tmp_path / "drive.html").stat().st_size < 3e6
    page = opened(browser, tmp_path / "drive.html", viewport={"width": 1280, "height": 760})
    page.locator("#conditions input").first.fill("2")  # before the first step
    for key, conditions in (("k", "payload: 5"), ("d", "pitch: 4, roll: -3"), ("w", "payload: 0")):
        page.keyboard.down(key)
        page.wait_for_timeout(400)
        page.keyboard.up(key)
        page.evaluate(f"crane.worker.postMessage({{ conditions: {{ {conditions} }} }})")
        page.wait_for_timeout(200)
    dragged(page, 20, -40)
    page.keyboard.press("Space")
    page.wait_for_function("!crane.state.running")
    assert page.evaluate("crane.state.status") == 1
    assert page.evaluate("crane.frames") > 3
    assert not page.evaluate("isSoftware") or 2000 < page.evaluate(TRIANGLES) < 8000
    recorded = saved(page, tmp_path / "drive.csv")
    changes = json.loads(recorded.changes)
    assert [set(values) for _, values in changes] == [
        {"payload.mass"}, {"gravity.x", "gravity.y", "gravity.z"}, {"payload.mass"},
    ]  # fmt: skip
    machine = recorded_machine(tmp_path / "drive.csv", recorded.machine)
    assert machine.parameter_changes["payload.mass"] > 0
    assert np.ptp(recorded.q, axis=0).max() > 0.05
    assert np.ptp(recorded.channels["load_tip_force_z"]) > 100.0
    assert_replayed(machine, recorded, tmp_path / "drive.csv")


@pytest.mark.slow
def test_a_gamepad_does_a_cycle(browser, tmp_path):
    machine, path = crane.load("patu655"), tmp_path / "drive.html"
    path.write_text(drive_html(machine), encoding="utf-8")
    page = opened(browser, path, viewport={"width": 640, "height": 480})
    page.select_option("#goal", label="lift the load")
    page.evaluate("window.axes = [0, 0, 0, 0]")
    page.evaluate("navigator.getGamepads = () => [{ axes: window.axes, buttons: [] }]")
    goal, levers, first = page.evaluate("[drive.goals[0], drive.levers, drive.columns.length]")
    joints = page.evaluate("drive.joints.map(({ column }) => column)")
    ranges, kinematics = machine.upper - machine.lower, Kinematics(machine)
    axes = {"slew": (0, 1.0), "stick": (1, -1.0), "tool": (2, 1.0), "boom": (3, -1.0)}
    for _ in range(1000):
        state, row = page.evaluate("[crane.state.goal, crane.state.row]")
        if state["isDone"]:
            break
        way = np.array(goal["points"][state["next"]]) - row[first : first + 3]
        jacobian = kinematics.jacobian([row[i] for i in joints]) * ranges / 10
        square = jacobian.T @ jacobian
        lever = 0.8 * np.linalg.solve(
            square + 1e-3 * np.trace(square) * np.eye(4), jacobian.T @ way
        )
        lever *= (np.linalg.norm(way) > 0.6 * goal["radius"]) / max(1.0, np.abs(lever).max())
        given = [0.0, 0.0, 0.0, 0.0]
        for one, x in zip(levers, lever, strict=True):
            axis, sign = axes[one["role"]]
            given[axis] = float(sign * one["sign"] * (0.88 * x + 0.12 * np.sign(x)))
        page.evaluate(f"window.axes = {given}")
        page.wait_for_timeout(30)
    state = page.evaluate("crane.state")
    assert state["goal"]["isDone"], page.faults
    result = state["results"][0]
    assert (result["goal"], len(page.evaluate("crane.state.changes"))) == ("lift the load", 2)
    page.evaluate("window.axes = [0, 0, 0, 0]")
    recorded = saved(page, tmp_path / "drive.csv")
    assert_replayed(machine, recorded, tmp_path / "drive.csv")
    end = json.loads(recorded.changes)[1][0]  # where the load is put down
    first, last = np.interp([end - result["time"], end], recorded.time, recorded["pump_work"])
    assert result["energy"] == pytest.approx(last - first, rel=0.02)
    assert f'"goal":"{result["goal"]}"' in (tmp_path / "drive.csv").read_text()


@pytest.mark.slow
def test_sticks_by_touch_in_both_patterns(browser, tmp_path):
    path = tmp_path / "drive.html"
    path.write_text(drive_html(crane.load("mini_forwarder")), encoding="utf-8")
    page = opened(browser, path, viewport={"width": 390, "height": 844}, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    moved = {}
    for pattern in ("ISO", "SAE"):
        page.click("#summary summary")
        page.select_option("#pattern", pattern)
        page.click("#summary summary")
        box = page.locator(".stick.left .pad").bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 2)
        page.wait_for_function("crane.state.levers.some((x) => Math.abs(x) === 1)")
        levers = page.evaluate("crane.state.levers")
        moved[pattern] = [name for name, x in zip(("q1", "X1", "X2"), levers, strict=True) if x]
        page.mouse.up()
        page.wait_for_function("crane.state.levers.every((x) => x === 0)")
    assert moved == {"ISO": ["X2"], "SAE": ["X1"]}
    page.click("#reset")
    page.wait_for_function("crane.state.time === 0")
    page.reload()
    page.wait_for_function("window.crane && window.crane.state")
    assert page.evaluate("crane.levers.pattern") == "SAE"
    assert not page.faults
    page.close()


def test_what_nothing_drives_is_told():
    machine = crane.load("mini_forwarder", active=[], free=["q1", "X1", "X2"])
    with pytest.raises(InputError, match="nothing drives 'mini_forwarder'"):
        drive_html(machine)


def test_levers_move_the_tip_as_they_say():
    machine = crane.load("patu655")
    levers = lever_data(DriveConditions(machine).program)
    assert [lever["role"] for lever in levers] == ["slew", "boom", "stick", "tool"]
    kinematics, home = Kinematics(machine), machine.home[machine.closure.active]
    tip = kinematics.position(home)
    for lever, (axis, sign) in zip(levers, ((1, -1), (2, -1), (0, 1), (0, 1)), strict=True):
        column = machine.active.index(lever["joint"])
        ahead = kinematics.position(home + 1e-3 * lever["sign"] * np.eye(4)[column])
        assert sign * (ahead - tip)[axis] > 0  # right, down, out, out


def test_goals_are_in_reach():
    machine = crane.load("mini_forwarder")
    goals = goal_data(machine, [0.0, 0.1, 0.2, 0.3], -10.0)
    assert {"lift the load", "grade a line", "reach three points", *machine.tasks} == {
        goal["name"] for goal in goals
    }
    kinematics = Kinematics(machine)
    for goal in goals:
        path = kinematics.inverse(np.array(goal["points"][:1]))
        assert machine.check_limits(path[0], "goal").shape == (3,)
    grade = np.array(next(x["points"] for x in goals if x["name"] == "grade a line"))
    assert np.ptp(grade[:, 2]) < 1e-12
    assert all(np.hypot(*b) < np.hypot(*a) for a, b in pairwise(grade[:, :2]))


def test_instances_with_other_payloads_are_those_of_other_machines():
    conditions = DriveConditions(crane.load("mini_forwarder"))
    mass = conditions.masses[7]
    other = crane.export.InstanceProgram(crane.load("mini_forwarder", {"payload.mass": mass}), ())
    np.testing.assert_array_equal(conditions.program.variant_defaults[7], other.defaults)
    assert conditions.data()["payload"]["start"] == 0


@pytest.mark.slow
def test_a_closed_loop_that_was_pulled_and_led_is_repeated(browser, tmp_path):
    path, csv = tmp_path / "drive.html", tmp_path / "drive.csv"
    typed("view", "mini_forwarder", "--drive", "--controller", "pi", "--no-open", "--out", path)
    page = opened(browser, path, viewport={"width": 1280, "height": 760})
    force, label = dragged(page, 60, -120)
    assert np.linalg.norm(force) > 0.5 and label.endswith("N")
    page.click(".hand button:has-text('move the target')")
    dragged(page, -60, -40)
    with page.expect_download() as download:
        page.click("#save")
    download.value.save_as(csv)
    assert not page.faults
    page.close()
    recorded = quiet(crane.Recording.from_csv, csv)
    again, _ = quiet(crane.replay, crane.load("mini_forwarder"), csv, 0.01, controller="pi")
    assert np.ptp(recorded.channels["load_tip_force_z"]) > 0.5
    assert np.abs(recorded.q - again.q).max() < 1e-9 * np.ptp(recorded.q)
    moved = np.ptp(recorded.channels["reference_X1"])
    assert moved > 1e-4 and np.abs(recorded.error("X1")).max() < moved
