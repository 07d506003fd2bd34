"""Server of a live view, and the guard of its requests."""

import asyncio
import hmac
import io
import ipaddress
import logging
import os
import secrets
import signal
import socket
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from queue import Empty, SimpleQueue
from typing import Any
from urllib.parse import urlsplit

from crane.common.errors import CraneWarning, InputError, OutputError
from crane.common.optional_libraries import import_optional_library
from crane.view.live.live_page import LivePage
from crane.view.live.live_session import Playback, Session

REFUSAL_MESSAGE = "Refused: open the address that crane has told, by the number of its host.\n"


class AccessGuard:
    """Check of requests: token, host and origin.

    Args:
        host: Name or address that is listened on.

    Attributes:
        host: As given.
        token: Random first part of the path.
    """

    def __init__(self, host: str):
        self.host, self.token = host, secrets.token_urlsafe(16)

    @property
    def is_local_only(self) -> bool:
        """Whether only this computer has access."""
        return self.host.lower() == "localhost" or _is_loopback(self.host)

    def address(self, port: int) -> str:
        """Return the address to open in a browser."""
        host_text = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host_text}:{port}/{self.token}/"

    def authorized_path(self, path: str, hosts: list[str], origins: list[str]) -> str | None:
        """Return the path behind the token; None if the request is refused.

        Args:
            path: Requested path.
            hosts: All `Host` headers.
            origins: All `Origin` headers; only browsers send them.
        """
        if len(hosts) != 1 or not self._is_known_host(hosts[0]):
            return None
        try:
            if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
                return None
        except ValueError:  # no address
            return None
        path_token, slash, inner_path = path.partition("?")[0].removeprefix("/").partition("/")
        # a path may hold any bytes
        if not hmac.compare_digest(os.fsencode(path_token), self.token.encode()):
            return None
        return "/" + inner_path

    def _is_known_host(self, host: str) -> bool:
        """Return whether a `Host` header names the host that is listened on."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
            is_named = name in ("localhost", self.host.lower())
            return is_named or ipaddress.ip_address(name).is_loopback or not self.is_local_only
        except ValueError:
            return False

    @contextmanager
    def guard_servers(self) -> Iterator[None]:
        """Guard HTTP and websocket requests of servers that viser starts in this context.

        What cannot be read, of anybody, is dropped without a word.
        """
        from websockets.asyncio import server

        serve: Any = server.serve

        def guarded_serve(*arguments: Any, process_request: Callable, **options: Any) -> Any:
            def check_request(connection: Any, request: Any) -> Any:
                header_values = request.headers.get_all
                path = self.authorized_path(
                    request.path, header_values("Host"), header_values("Origin")
                )
                if path is None:
                    return connection.respond(403, REFUSAL_MESSAGE)
                request.path = path
                return process_request(connection, request)

            asyncio.get_running_loop().set_exception_handler(lambda *_: None)
            options["logger"] = logging.Logger("crane.live", logging.CRITICAL + 1)
            return serve(*arguments, process_request=check_request, **options)

        server.serve = guarded_serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = serve  # type: ignore[misc]


def restrict_widget_updates(server: Any) -> None:
    """Accept from clients only slider values within their ranges and button presses.

    viser would accept any value of any property and send it to all other clients.
    """
    from viser._messages import GuiUpdateMessage

    gui = server.gui
    interface, update = gui._websock_interface, gui._handle_gui_updates

    async def checked(client: Any, message: Any) -> None:
        widgets, name = gui._gui_input_handle_from_uuid, message.uuid
        is_known = isinstance(name, str) and name in widgets
        if is_known and _is_valid_update(widgets[name], message.updates):
            await update(client, message)

    interface.unregister_handler(GuiUpdateMessage, update)
    interface.register_handler(GuiUpdateMessage, checked)


def _is_valid_update(widget: Any, updates: Any) -> bool:
    """Return whether an update sets a value that the widget can have."""
    if not isinstance(updates, dict) or set(updates) != {"value"}:
        return False
    value = updates["value"]
    if widget._impl.is_button:
        return isinstance(value, bool)
    if type(value) not in (int, float):
        return False
    # a browser rounds to whole steps; not a number is within nothing
    return float(widget.min - widget.step) <= value <= float(widget.max + widget.step)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


_FIRST_PORT, _PORT_COUNT = 8080, 20  # default range of ports
_FRAME_INTERVAL = 1 / 30  # of a recording that plays [s]

RequestQueue = SimpleQueue[tuple[str, float] | None]


def serve_live_view(
    session: Session,
    playback: Playback | None = None,
    host: str = "127.0.0.1",
    port: int | None = None,
) -> None:
    """Serve a live view until SIGINT or SIGTERM.

    Args:
        session: Session that is shown.
        playback: Recording that can be played.
        host: Address to listen on; by default only this computer.
        port: Port; by default the first free one from 8080.

    Raises:
        InputError: viser is not installed, or there is no such host.
        OutputError: The port is taken.
    """
    requests: RequestQueue = SimpleQueue()
    guard = AccessGuard(host)
    with stop_on_signals(requests):
        server = start_server(guard, port)
        try:
            if not guard.is_local_only:
                warnings.warn(
                    f"it listens on {host}, not on this computer alone: whoever has "
                    "the address sees the machine and moves it, and it is sent unencrypted",
                    CraneWarning,
                    stacklevel=2,
                )
            page = LivePage(server, session, playback, requests)
            address = guard.address(server.get_port())
            print(f"live view at {address} (Ctrl+C ends it)", flush=True)
            _process_until_end(page, requests)
        finally:
            stop_server(server)


def _process_until_end(page: LivePage, requests: RequestQueue) -> None:
    """Process requests and play the recording until the end."""
    while (pending_requests := _take_requests(requests, page.is_playing)) is not None:
        page.process_requests(pending_requests)
        if page.is_playing:
            page.advance_playback()


def start_server(guard: AccessGuard, port: int | None) -> Any:
    """Start a guarded viser server that prints nothing and shares no public address."""
    viser = import_optional_library("viser", "a live view")
    port = free_port(guard.host, port)
    with redirect_stdout(io.StringIO()), guard.guard_servers():
        server: Any = viser.ViserServer(host=guard.host, port=port, verbose=False)
    restrict_widget_updates(server)
    # a page can ask for a public address on somebody else's server: not with ours
    server.request_share_url = lambda *_, **__: None
    return server


def stop_server(server: Any) -> None:
    """Stop a server and its threads."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _take_requests(requests: RequestQueue, is_playing: bool) -> list[tuple[str, float]] | None:
    """Return all pending requests; wait for one unless a recording plays; None at the end."""
    pending_requests: list[tuple[str, float]] = []
    try:
        item = requests.get(timeout=_FRAME_INTERVAL if is_playing else None)
        while item is not None:
            pending_requests.append(item)
            item = requests.get_nowait()
    except Empty:
        return pending_requests
    return None


@contextmanager
def stop_on_signals(requests: RequestQueue) -> Iterator[None]:
    """Put None into the queue on SIGINT and SIGTERM; `SimpleQueue.put` is reentrant."""
    previous_handlers = {
        number: signal.signal(number, lambda *_: requests.put(None))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def free_port(host: str, port: int | None) -> int:
    """Return a free port; viser would try other ports, or retry endlessly, silently."""
    try:
        family, _, _, _, address = socket.getaddrinfo(
            host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"host '{host}' is not known ({reason}), give one") from None
    candidates = range(_FIRST_PORT, _FIRST_PORT + _PORT_COUNT) if port is None else [port]
    failure_text = ""
    for candidate in candidates:
        with socket.socket(family, socket.SOCK_STREAM) as test_socket:
            test_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                test_socket.bind((address[0], candidate))
            except OSError as error:
                failure_text = error.strerror or str(error)
            else:
                return int(test_socket.getsockname()[1])
    port_text = (
        f"port {candidates[0]} cannot"
        if port is not None
        else f"no port from {_FIRST_PORT} on can"
    )
    raise OutputError(f"{host}: {port_text} be listened on ({failure_text}), choose another port")
