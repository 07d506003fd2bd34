"""Access control of live views: other web pages and invalid values are rejected."""

import asyncio
import gc
import http.client
import shutil
import socket
import threading
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from queue import SimpleQueue

import numpy as np
import pytest
from conftest import DATA

import crane
from crane.view.live.live_server import AccessGuard
from crane.view.live.live_session import Session

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
