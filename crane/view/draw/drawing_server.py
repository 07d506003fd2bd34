"""Server of the page of a drawing."""

import json
import socket
import socketserver
from collections.abc import Callable
from contextvars import copy_context
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from queue import SimpleQueue
from threading import Lock, Thread
from typing import Any

from crane.common.errors import CraneError, warn
from crane.formats.machine_file.json_schema import SCHEMA_PATH
from crane.view.draw.drawing_session import DrawingSession
from crane.view.live.live_server import (
    REFUSAL_MESSAGE,
    AccessGuard,
    RequestQueue,
    free_port,
    stop_on_signals,
)
from crane.view.page.html_document import filled_template
from crane.view.page.report_page import open_in_browser

_MAX_REQUEST = 2_000_000  # bytes
_SCRIPTS = ("data", "draw_model", "draw_canvas", "draw_panel", "draw_tools", "draw")
_FORMS = ("bodies", "cylinders", "slides", "pins", "plates", "tubes")

Answer = tuple[int, str, bytes]  # status, type and content


def serve_drawing(
    session: DrawingSession,
    page_data: dict[str, Any],
    picture: bytes = b"",
    host: str = "127.0.0.1",
    port: int | None = None,
    is_opened: bool = False,
) -> None:
    """Serve the page of a drawing until SIGINT or SIGTERM.

    Args:
        session: The drawing.
        page_data: What the page shows at first: the `model`, and more for its scripts.
        picture: Picture under it; empty: none.
        host: Address to listen on; by default only this computer.
        port: Port; by default the first free one from 8080.
        is_opened: Whether to open a browser.

    Raises:
        InputError: There is no such host.
        OutputError: The port is taken.
    """
    signals: RequestQueue = SimpleQueue()
    guard, port = AccessGuard(host), free_port(host, port)
    with stop_on_signals(signals):
        server = DrawingServer(guard, port, session, drawing_html(page_data), picture)
        if not guard.is_local_only:
            warn(
                f"it listens on {host}, not on this computer alone: whoever has the address "
                f"draws, and writes {session.file.path}; it is sent unencrypted"
            )
        Thread(target=server.serve_forever, daemon=True).start()
        address = guard.address(port)
        print(f"drawing at {address} (Ctrl+C ends it)", flush=True)
        if is_opened:
            open_in_browser(address)
        signals.get()
        server.shutdown()


class DrawingServer(ThreadingHTTPServer):
    """Answers the requests that a guard lets in, one after another.

    Args:
        guard: Check of requests.
        port: Port to listen on.
        session: The drawing.
        page: HTML of the page.
        picture: Picture under the drawing.
    """

    server_bind = socketserver.TCPServer.server_bind  # without a search for the host's name

    def __init__(
        self, guard: AccessGuard, port: int, session: DrawingSession, page: str, picture: bytes
    ):
        actions = session.check, session.move, session.drag, session.save
        self._actions: dict[str, Callable[..., Any]] = {f"/{x.__name__}": x for x in actions}
        self._pages = {"/": ("text/html", page.encode()), "/picture": ("image/*", picture)}
        self._lock, self._context = Lock(), copy_context()  # with the options of the program
        self.guard, self.address_family = guard, socket.getaddrinfo(guard.host, port)[0][0]
        super().__init__((guard.host, port), _RequestHandler)

    def answer(self, path: str | None, body: bytes) -> Answer:
        """Return the answer to a request; a path of None is refused."""
        if path is None:
            return 403, "text/plain", REFUSAL_MESSAGE.encode()
        if path not in self._actions:
            return (200, *self._pages[path]) if path in self._pages else (404, "text/plain", b"")
        try:
            with self._lock:
                found = self._context.run(self._actions[path], **json.loads(body))
        except Exception as error:  # one window's mistake does not end it for the others
            text = str(error) if isinstance(error, CraneError) else f"not done: {error!r}"
            found = {"error": text}
        return 200, "application/json", json.dumps(found).encode()

    def handle_error(self, *_: object) -> None:
        """Drop what cannot be read or sent without a word."""


class _RequestHandler(BaseHTTPRequestHandler):
    server: DrawingServer
    timeout = 60.0  # of a silent client [s]

    def do_GET(self) -> None:  # noqa: N802
        hosts, origins = (self.headers.get_all(x) or [] for x in ("Host", "Origin"))
        path = self.server.guard.authorized_path(self.path, hosts, origins)
        size = self.headers.get("Content-Length", "0")
        is_short = path is not None and size.isdecimal() and int(size) <= _MAX_REQUEST
        body = self.rfile.read(int(size)) if is_short else b""
        status, kind, content = self.server.answer(path, body)
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    do_POST = do_GET  # noqa: N815

    def log_message(self, *_: object) -> None:
        """Print nothing."""


def drawing_html(page_data: dict[str, Any]) -> str:
    """Return the page of a drawing as HTML, whose forms are those of the JSON Schema."""
    schemas = json.loads(SCHEMA_PATH.read_text(encoding="utf-8"))["$defs"]
    data = page_data | {"forms": {name: schemas[name]["properties"] for name in _FORMS}}
    styles, title = ("page", "dark", "draw"), f"{page_data['file']}: drawing"
    return filled_template("draw", styles, _SCRIPTS, title, data)
