"""The page on which a machine is driven, in a browser: its numbers are the library's."""

import shutil

import numpy as np
import pytest
from command_line import typed
from warned import quiet

import crane
from crane.common.errors import InputError
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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["patu655", "excavator"])
def test_a_drive_by_keys_is_repeated_by_the_library(browser, tmp_path, name):
    done = typed("view", name, "--drive", "--no-open", "--out", tmp_path / "drive.html")
    assert done.returncode == 0
    assert (tmp_path / "drive.html").stat().st_size < 3e6
    page = opened(browser, tmp_path / "drive.html", viewport={"width": 1280, "height": 760})
    for key in "wd":
        page.keyboard.down(key)
        page.wait_for_timeout(700)
        page.keyboard.up(key)
    dragged(page, 20, -40)
    page.wait_for_timeout(500)
    page.keyboard.press("Space")
    assert page.evaluate("window.crane.state.status") == 1
    assert page.evaluate("window.crane.frames") > 3
    with page.expect_download() as download:
        page.click("#save")
    path = tmp_path / "drive.csv"
    download.value.save_as(path)
    assert not page.faults
    page.close()
    machine = crane.load(name)
    recorded = quiet(crane.Recording.from_csv, path)
    replayed, _ = quiet(crane.replay, machine, path, 0.01)
    moved = np.ptp(recorded.q, axis=0)
    assert moved.max() > 0.05
    np.testing.assert_allclose(recorded.q, replayed.q, rtol=0, atol=1e-9)
    assert np.ptp(recorded.channels["load_tip_force_z"]) > 100.0
    for channel in ("tip_z", "pressure_supply", "work"):
        scale = np.abs(replayed.channels[channel]).max()
        difference = recorded.channels[channel] - replayed.channels[channel]
        assert np.abs(difference).max() < 1e-9 * scale


@pytest.mark.slow
def test_a_gamepad_moves_the_levers_and_a_stop_is_told(browser, tmp_path):
    path = tmp_path / "drive.html"
    path.write_text(drive_html(crane.load("patu655")), encoding="utf-8")
    page = opened(browser, path, viewport={"width": 390, "height": 800})
    pad = "{ axes: [0, -1, 0, 0], buttons: [], connected: true }"
    page.evaluate(f"navigator.getGamepads = () => [{pad}]")
    page.click("#run")
    page.wait_for_function("window.crane.state.time > 0.5", timeout=20_000)
    levers = page.evaluate("window.crane.state.levers")
    assert levers[1] == 1.0
    assert levers[0] == levers[2] == levers[3] == 0.0
    page.click("#reset")
    page.wait_for_function("window.crane.state.time === 0", timeout=20_000)
    width = page.evaluate("document.documentElement.scrollWidth")
    assert width <= 390
    assert not page.faults
    page.close()


def test_what_cannot_be_driven_is_told():
    machine = crane.load("tx40")
    machine.model.effortLimit[:] = 0.0
    with pytest.raises(InputError, match="give joints an effort limit"):
        drive_html(machine)


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
