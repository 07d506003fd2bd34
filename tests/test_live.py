"""Live views: closed loops after every move, limits, access, end of the process."""

import asyncio
import gc
import http.client
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from queue import SimpleQueue

import numpy as np
import pytest
from command_line import MAIN, typed
from conftest import DATA
from executed_lines import at_most
from hypothesis import given
from hypothesis import strategies as st

import crane
from crane.common.errors import InputError, RecordingError
from crane.recordings.recording import Recording
from crane.view.live.live_page import readout_html, warning_html
from crane.view.live.live_server import AccessGuard
from crane.view.live.live_session import Playback, Session
from crane.view.page.scene import round_up_to_nice


@pytest.fixture
def recording(mini):
    time = np.linspace(2.0, 3.0, 11)
    q = np.column_stack([0.1 * time, 0.02 - 0.003 * time, 0.01 + 0.002 * time])
    units = {joint: mini.unit(joint) for joint in mini.active}
    return Recording(time, mini.active, q, np.zeros_like(q), 10 * q, units)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mini", "patu", "five_bar", "slider_crank"])
def test_moves_keep_the_loops_closed(request, name):
    machine = request.getfixturevalue(name)
    session, rng = Session(machine), np.random.default_rng(0)
    refused = 0
    for index in rng.integers(len(machine.active), size=300):
        before = session.readout
        value = rng.uniform(session.lower[index], session.upper[index])
        posture = session.move(machine.active[index], value)
        assert posture.residual < 1e-9
        assert float(machine.closure.residual(posture.configuration)) < 1e-9
        others = np.arange(len(machine.active)) != index
        np.testing.assert_array_equal(posture.q_a[others], before.q_a[others])
        if not posture.refusal:
            assert posture.q_a[index] == value
        refused += bool(posture.refusal)
    assert (refused > 0) == (name == "five_bar")


def test_the_numbers_are_those_of_the_machine(mini):
    session = Session(mini)
    session.move("q1", 0.7)
    posture = session.move("X1", 0.011)
    dynamics, kinematics = crane.Dynamics(mini), crane.Kinematics(mini)
    np.testing.assert_allclose(posture.configuration, mini.closure.solve(posture.q_a), atol=1e-12)
    np.testing.assert_allclose(posture.gravity, dynamics.gravity(posture.q_a), atol=1e-9)
    np.testing.assert_allclose(posture.tip, kinematics.position(posture.q_a), atol=1e-12)
    gamma = mini.closure.gamma(posture.configuration)
    one, other = posture.gain_joints
    assert abs(posture.largest_gain) == np.abs(gamma[mini.closure.passive]).max()
    assert posture.largest_gain == gamma[mini.column(one), mini.active.index(other)]


@given(shares=st.lists(st.floats(0, 1), min_size=3, max_size=3), mass=st.floats(0, 1))
def test_payload_adds_the_weight_that_virtual_work_says(mini, shares, mass):
    session = Session(mini)
    for joint, share, low, high in zip(
        mini.active, shares, session.lower, session.upper, strict=True
    ):
        session.move(joint, low + share * (high - low))
    bare = session.readout.gravity
    loaded = session.set_payload(mass)
    lever = crane.Kinematics(mini).jacobian(loaded.q_a)[2]
    np.testing.assert_allclose(loaded.gravity - bare, 9.81 * mass * lever, atol=1e-9)
    np.testing.assert_allclose(session.set_payload(0.0).gravity, bare, atol=1e-12)


def test_at_the_edge_the_machine_stops_and_names_the_loop(five_bar):
    """The two arms of a five-bar are in line there; see the closed form of its reach."""
    session = Session(five_bar)
    posture = session.move("a", 2.0)
    assert posture.refusal == (
        "a stops at 50.06 deg: beyond it loop 'meeting' leaves its assembly branch or cannot be "
        "closed"
    )
    with pytest.raises(crane.CraneError):
        five_bar.closure.solve([posture.q_a[0] + 1e-3, 0.0])
    assert posture.residual < 1e-9 and posture.condition_number > 100
    assert session.move("a", 2.0).q_a[0] == pytest.approx(posture.q_a[0], abs=1e-4)
    assert session.move("a", 0.0).refusal == ""


@pytest.mark.parametrize("name", ["five_bar", "stewart"])
def test_there_is_a_way_back_from_every_edge(request, name):
    machine = request.getfixturevalue(name)
    session, rng = Session(machine), np.random.default_rng(3)
    edges = 0
    while edges < 20:
        index = rng.integers(len(machine.active))
        joint, before = machine.active[index], session.readout
        value = rng.choice([session.lower[index], session.upper[index]])
        if not session.move(joint, value).refusal:
            continue
        edges += 1
        back = session.move(joint, before.q_a[index])
        assert back.refusal == ""
        np.testing.assert_allclose(back.configuration, before.configuration, atol=1e-6)


def test_a_long_move_never_jumps_to_where_the_loops_close_again(five_bar):
    session = Session(five_bar)
    for value in np.linspace(1.0, np.pi, 20):
        posture = session.move("a", value)
        assert posture.refusal and posture.q_a[0] < 0.9
        session.go_home()


def test_wrong_moves(mini, five_bar):
    session = Session(mini)
    with pytest.raises(InputError, match="'q3' is no active joint, known: X1, X2, q1"):
        session.move("q3", 0.0)
    with pytest.raises(InputError, match="X1 = 0.04 m is outside of 0 to 0.03"):
        session.move("X1", 0.04)
    with pytest.raises(InputError, match="the value of X1 is nan m"):
        session.move("X1", float("nan"))
    with pytest.raises(InputError, match="must not be negative"):
        session.set_payload(-1.0)
    with pytest.raises(InputError, match="'five_bar' has no tip"):
        Session(five_bar).set_payload(1.0)
    np.testing.assert_array_equal(session.readout.configuration, mini.home)


def test_slider_ends(mini, five_bar):
    session = Session(mini)
    np.testing.assert_array_equal(session.lower, mini.lower)
    np.testing.assert_array_equal(session.upper, mini.upper)
    assert session.max_payload == 1.0  # half of 1.287 kg, rounded up
    np.testing.assert_allclose(Session(five_bar).upper, np.pi)
    assert [round_up_to_nice(x) for x in (0.9, 1.0, 1.1, 23, 0.051)] == [1, 1, 2, 50, 0.1]


def test_playback_runs_straight_between_samples(mini, recording):
    playback = Playback(mini, recording)
    assert (playback.start, playback.end) == (2.0, 3.0)
    for t in (2.0, 2.04, 2.5, 3.0):
        q_a, tau = playback.interpolate(t)
        expected = [0.1 * t, 0.02 - 0.003 * t, 0.01 + 0.002 * t]
        np.testing.assert_allclose(q_a, expected, atol=1e-12)
        np.testing.assert_allclose(tau, 10 * np.array(expected), atol=1e-12)
    np.testing.assert_array_equal(playback.interpolate(9.0)[0], recording.q[-1])
    session = Session(mini)
    posture = session.set_active_coordinates(playback.interpolate(2.55)[0])
    assert posture.refusal == "" and posture.residual < 1e-9


def test_playback_of_another_machine(patu, recording):
    with pytest.raises(RecordingError, match="no joint 'slew', which drives patu655"):
        Playback(patu, recording)


def test_words_have_every_number(mini):
    session = Session(mini)
    text = readout_html(mini, session.set_payload(0.2), 0.2, np.array([1.5, 2.5, 3.5]))
    for word in (*mini.joints, "recorded", "3.5 N", "payload", "rad/m"):
        assert word in text
    assert "payload" not in readout_html(mini, session.set_payload(0.0), 0.0)
    assert warning_html("") == "" and "&lt;b&gt;" in warning_html("<b>")


def begin(*arguments, code=MAIN):
    """A live view in a process group of its own, and the line with its address."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, "live", *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    return process, process.stdout.readline()


def group_is_empty(group):
    """Whether no process of a group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.parametrize("aspect", [390 / 844, 0.7, 1.0, 1.8])
def test_the_machine_is_in_view_and_above_the_panel_of_a_phone(patu, aspect):
    """Projected corners of all shapes: within the window, and of one upright in its upper part."""
    pytest.importorskip("viser")
    from crane.view.live.live_scene import LiveScene
    from crane.view.live.live_server import AccessGuard, start_server, stop_server
    from crane.view.page.scene import link_poses, read_visuals, shape_corners

    session = Session(patu)
    server = start_server(AccessGuard("127.0.0.1"), 0)
    try:
        look_at, position = LiveScene(server, session).camera_view(aspect)
    finally:
        stop_server(server)
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    visuals = read_visuals(patu)
    poses = link_poses(patu, patu.home[None], {visual.link for visual in visuals})
    ways = (shape_corners(visuals, poses) - position) @ np.column_stack(
        [right, np.cross(right, forward), forward]
    )
    half = np.tan(np.radians(20))
    x, y = ways[:, 0] / ways[:, 2] / half / aspect, ways[:, 1] / ways[:, 2] / half
    assert np.abs(x).max() < 1 and y.max() < 1
    assert y.min() > (0.2 if aspect < 1 else -1)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("connected", [False, True])
def test_both_signals_end_it_and_leave_nothing(number, connected):
    viser_client = pytest.importorskip("viser") and pytest.importorskip("websockets.sync.client")
    process, line = begin(DATA / "slider_crank.yaml", "--port", "0")
    address = re.fullmatch(
        r"live view at http://(127\.0\.0\.1:\d+/\S+/) \(Ctrl\+C ends it\)\n", line
    )
    assert address, line + process.stderr.read()
    client = viser_client.connect(f"ws://{address[1]}", subprotocols=[protocol()], max_size=None)
    if not connected:
        client.close()
    process.send_signal(number)
    out, err = process.communicate(timeout=300)
    assert (process.returncode, out, err) == (0, "", "")
    assert group_is_empty(process.pid)


@pytest.mark.slow
def test_a_slider_moves_the_picture_with_little_work(patu):
    """From the note of a slider to everything sent: 1900 lines, 50 ms on a slow computer."""
    pytest.importorskip("viser")
    from queue import SimpleQueue

    from crane.view.live.live_page import LivePage
    from crane.view.live.live_server import AccessGuard, start_server, stop_server

    session = Session(patu)
    server = start_server(AccessGuard("127.0.0.1"), 0)
    try:
        page, rng = LivePage(server, session, None, SimpleQueue()), np.random.default_rng(0)
        for i in range(300):
            joint = patu.active[i % len(patu.active)]
            unit = 180 / np.pi if patu.unit(joint) == "rad" else 1000.0
            low, high = unit * patu.lower[i % 4], unit * patu.upper[i % 4]
            with at_most(4_000):
                page.process_requests([(f"joint {joint}", rng.uniform(low, high))])
            assert session.readout.residual < 1e-9
    finally:
        stop_server(server)


def protocol():
    import viser

    return f"viser-v{viser.__version__}"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["tx4"], "did you mean 'tx40'?"),
        (["tx40", "--host", "no.such.host.invalid"], "host 'no.such.host.invalid' is not known"),
        (["tx40", "--machine", "tx40"], "--machine is for runs, and 'tx40' is none"),
        (["tx40", "--run", "nowhere.csv"], "nowhere.csv: no such file"),
        (["nowhere.csv"], "nowhere.csv: no such file"),
    ],
)
def test_errors_are_one_line(arguments, text):
    pytest.importorskip("viser")
    done = typed("live", *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert text in done.stderr


def test_a_port_that_is_taken_is_told():
    pytest.importorskip("viser")
    import socket

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        process, line = begin("tx40", "--port", port)
        _, err = process.communicate(timeout=300)
    assert (process.returncode, line) == (2, "")
    assert f"127.0.0.1: port {port} cannot be listened on (Address already in use)" in err
    assert err.endswith("choose another port\n")


def test_without_viser_it_says_how_to_get_it():
    process, line = begin("tx40", code=f"import sys; sys.modules['viser'] = None; {MAIN}")
    _, err = process.communicate(timeout=300)
    assert (process.returncode, line) == (2, "")
    assert err == (
        "error: a live view needs viser, install it in the repository's folder: "
        "pip install '.[live]'\n"
    )


# --- access -------------------------------------------------------------------------------------


pytest.importorskip("viser")


@pytest.fixture(scope="module")
def live():
    """Port, door, page and notes of a view that is served."""
    from crane.view.live.live_page import LivePage
    from crane.view.live.live_server import start_server, stop_server

    door, requests = AccessGuard("127.0.0.1"), SimpleQueue()
    server = start_server(door, 0)
    page = LivePage(server, Session(crane.load(DATA / "slider_crank.yaml")), None, requests)
    yield server.get_port(), door, page, requests
    stop_server(server)


def connect(port, path, **headers):
    """A websocket as a browser or a program opens it."""
    import viser
    from websockets.sync.client import connect

    with socket.create_connection(("127.0.0.1", port)) as there:
        host = headers.pop("Host", f"127.0.0.1:{port}")
        return connect(
            f"ws://{host}{path}", sock=there.dup(), max_size=None, open_timeout=10,
            subprotocols=[f"viser-v{viser.__version__}"], additional_headers=headers,
        )  # fmt: skip


def get(port, path, **headers):
    """Status of a request."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


FOREIGN = {
    "a page of another origin": ("{path}", {"Origin": "http://elsewhere.example"}),
    "another port of this computer": ("{path}", {"Origin": "http://127.0.0.1:1"}),
    "a page without origin": ("{path}", {"Origin": "null"}),
    "a name made to lead here": (
        "{path}", {"Host": "rebound.example:{port}", "Origin": "http://rebound.example:{port}"},
    ),
    "a name, from a program": ("{path}", {"Host": "rebound.example"}),
    "no token": ("/", {}),
    "another token": ("/AAAAAAAAAAAAAAAAAAAAAA/", {}),
    "a token with more": ("/{token}x/", {}),
}  # fmt: skip


@pytest.mark.parametrize("who", FOREIGN)
def test_strangers_get_nothing(live, who):
    from websockets.exceptions import InvalidStatus

    port, door, _, _ = live
    said = {"port": port, "token": door.token, "path": f"/{door.token}/"}
    path, headers = FOREIGN[who]
    headers = {name: value.format(**said) for name, value in headers.items()}
    assert get(port, path.format(**said), **headers) == 403
    with pytest.raises(InvalidStatus, match="403"):
        connect(port, path.format(**said), **headers)


def ask(port, lines):
    """First line of the answer to a request of any bytes."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as there:
        there.sendall(lines)
        return there.makefile("rb").readline()


REQUESTS = {
    "bytes above 127": b"GET /\xe9\xff/ HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n\r\n",
    "an origin that is none": b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nOrigin: http://[\r\n\r\n",
    "a host that is none": b"GET / HTTP/1.1\r\nHost: \xff[%d\r\n\r\n",
}


@pytest.mark.parametrize("what", REQUESTS)
def test_a_request_of_any_bytes_is_refused_without_a_word(live, what, capfd):
    port, door, *_ = live
    for path in (b"", door.token.encode()[:-1]):
        line = ask(port, REQUESTS[what].replace(b"GET /", b"GET /" + path) % port)
        assert line == b"HTTP/1.1 403 Forbidden\r\n"
    line = ask(port, b"\xff\0 garbage\r\n\r\n")
    assert line == b"" or b" 400 " in line
    assert capfd.readouterr() == ("", "")


def test_what_a_window_sends_and_nobody_can_read_is_dropped(live, capfd):
    import msgspec
    from websockets.exceptions import ConnectionClosed

    port, door, page, requests = live
    name = next(iter(page._sliders.values()))._impl.uuid
    messages = [
        "a text", b"", b"\xc1" * 100, bytes(range(256)), b"\x93\x01",
        *(
            msgspec.msgpack.encode(x)
            for x in (
                None, [1], {"type": "GuiUpdateMessage"}, {"type": "Nothing"}, {"type": 3},
                {"type": "GuiUpdateMessage", "uuid": name, "updates": 3},
                {"type": "GuiUpdateMessage", "uuid": [name], "updates": {"value": 0.1}},
                {"type": "ViewerCameraMessage", "wxyz": "x"},
                {"messages": [{"type": "ViewerCameraMessage", "wxyz": 1}], "timestampSec": 1.0},
            )
        ),
    ]  # fmt: skip
    for message in messages:
        with connect(port, f"/{door.token}") as client:
            assert client.recv(timeout=10)
            try:
                for _ in range(3):
                    client.send(message)
            except ConnectionClosed:
                continue
    assert get(port, f"/{door.token}/") == 200  # it goes on
    with connect(port, f"/{door.token}") as client:
        assert client.recv(timeout=10)
    gc.collect()  # tasks whose errors nobody took
    assert requests.empty() and capfd.readouterr() == ("", "")


def test_those_with_the_address_come_in(live):
    port, door, _, _ = live
    here = f"http://127.0.0.1:{port}"
    assert door.address(port) == f"{here}/{door.token}/"
    for headers in ({}, {"Origin": here}):
        assert get(port, f"/{door.token}/", **headers) == 200
        with connect(port, f"/{door.token}", **headers) as client:
            assert client.recv(timeout=10)
    assert get(port, f"/{door.token}/../../etc/passwd") == 404


def test_hosts():
    inside = AccessGuard("127.0.0.1").authorized_path
    assert (
        AccessGuard("0.0.0.0").is_local_only is AccessGuard("crane.example").is_local_only is False
    )
    assert AccessGuard("::1").is_local_only is AccessGuard("localhost").is_local_only is True
    for host, wanted in {
        "192.0.2.1:80": True,
        "[2001:db8::1]:80": True,
        "x.example": False,
    }.items():
        door = AccessGuard("0.0.0.0")
        assert (door.authorized_path(f"/{door.token}/", [host], []) == "/") is wanted
        assert inside("/", [host], []) is None
    door = AccessGuard("crane.example")
    assert door.authorized_path(f"/{door.token}/x", ["crane.example:80"], []) == "/x"
    assert door.authorized_path(f"/{door.token}/", [], []) is None
    assert door.authorized_path(f"/{door.token}/", ["[::1"], []) is None


BAD = [[1.0, 2.0], "0.1", None, float("nan"), float("inf"), 1e308, -5.0, 10**400, True, {"a": 1}]


@pytest.mark.parametrize("value", BAD, ids=range(len(BAD)))
def test_values_that_mean_nothing_move_nothing(live, value, monkeypatch):
    from viser._messages import GuiUpdateMessage

    _, _, page, requests = live
    server = page._server
    name, slider = next(iter(page._sliders.items()))
    before, good = float(slider.value), float(0.4 * slider.min + 0.6 * slider.max)
    monkeypatch.setattr(server.gui, "_resolve_client", lambda _: object())
    hear, loop = (
        server._websock_server._handle_incoming_message,
        server._websock_server._background_event_loop,
    )

    def say(what):
        message = GuiUpdateMessage(slider._impl.uuid, what)
        asyncio.run_coroutine_threadsafe(hear(0, message), loop).result(10)

    say({"value": value})
    say({"min": 0.0})
    assert requests.empty() and slider.value == before
    say({"value": good})
    assert requests.get(timeout=10) == (name, good)
    say({"value": before})
    assert requests.get(timeout=10) == (name, before)


def test_a_mistake_does_not_end_it(live, monkeypatch):
    _, _, page, _ = live

    def wrong(*_):
        raise TypeError("a mistake")

    with monkeypatch.context() as context:
        context.setattr(page._session, "move", wrong)
        page.process_requests([(next(iter(page._sliders)), 0.0)])
        assert "a mistake" in page._warning_html.content
    page.process_requests([("home", 1.0)])
    assert "a mistake" not in page._warning_html.content
    assert np.isfinite(page._session.readout.configuration).all()


class Elsewhere(BaseHTTPRequestHandler):
    """A page of somebody else that tries to open the socket."""

    def __init__(self, script, *arguments):
        self._script = script
        super().__init__(*arguments)

    def do_GET(self):  # noqa: N802
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(self._script.encode())

    def log_message(self, *_):
        pass


@pytest.mark.slow
def test_a_browser_lets_its_own_page_in_and_no_other(live):
    import viser

    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium in the path")
    sync_api = pytest.importorskip("playwright.sync_api")
    port, door, _, _ = live
    script = (
        f"<script>const s = new WebSocket('ws://127.0.0.1:{port}/{door.token}', "
        f"'viser-v{viser.__version__}'); s.onmessage = () => document.title = 'in'; "
        "s.onerror = () => document.title = 'out'</script>"
    )
    other = HTTPServer(("127.0.0.1", 0), partial(Elsewhere, script))
    threading.Thread(target=other.serve_forever, daemon=True).start()
    rule = f"--host-resolver-rules=MAP rebound.example 127.0.0.1:{port}"
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=[rule])
        page = browser.new_page()
        page.goto(door.address(port))  # with the token even: the origin is what counts
        page.get_by_text("Active joints").wait_for(timeout=60_000)
        page.goto(f"http://127.0.0.1:{other.server_port}/")
        page.wait_for_function("document.title !== ''")
        assert page.title() == "out"
        answer = page.goto(f"http://rebound.example:{port}/{door.token}/")
        assert answer.status == 403
        browser.close()
    other.shutdown()
