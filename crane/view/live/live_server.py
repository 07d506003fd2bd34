"""Serving a live view until it is interrupted."""

import io
import signal
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from queue import Empty, SimpleQueue
from typing import Any

from crane.common.errors import CraneWarning, InputError, OutputError
from crane.common.optional_libraries import import_optional_library
from crane.view.live.access_control import AccessGuard, restrict_widget_updates
from crane.view.live.live_page import LivePage
from crane.view.live.live_session import Session
from crane.view.live.playback import Playback

_FIRST_PORT, _PORT_COUNT = 8080, 20  # to choose from where none is given
_FRAME_INTERVAL = 1 / 30  # of a recording that plays [s]

RequestQueue = SimpleQueue[tuple[str, float] | None]


def serve_live_view(
    session: Session,
    playback: Playback | None = None,
    host: str = "127.0.0.1",
    port: int | None = None,
) -> None:
    """Serve a live view until SIGINT or SIGTERM, and leave nothing running.

    Args:
        session: What is shown.
        playback: A recording to play.
        host: Address to listen on; the default is this computer alone.
        port: Where; the first free one from 8080 on if not given.

    Raises:
        InputError: viser is not installed, or there is no such host.
        OutputError: The port is taken.
    """
    requests: RequestQueue = SimpleQueue()
    guard = AccessGuard(host)
    with _stop_on_signals(requests):
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
    """Do what is asked for, and play, until the end."""
    while (pending_requests := _take_requests(requests, page.is_playing)) is not None:
        page.process_requests(pending_requests)
        if page.is_playing:
            page.advance_playback()


def start_server(guard: AccessGuard, port: int | None) -> Any:
    """A viser server behind a door, that says nothing and offers no address elsewhere."""
    viser = import_optional_library("viser", "a live view")
    port = _free_port(guard.host, port)
    with redirect_stdout(io.StringIO()), guard.guard_servers():
        server: Any = viser.ViserServer(host=guard.host, port=port, verbose=False)
    restrict_widget_updates(server)
    # a page can ask for a public address on somebody else's server: not with ours
    server.request_share_url = lambda *_, **__: None
    return server


def stop_server(server: Any) -> None:
    """End a server and its threads."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _take_requests(requests: RequestQueue, is_playing: bool) -> list[tuple[str, float]] | None:
    """All notes there are, at least one unless a recording plays; None at the end."""
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
def _stop_on_signals(requests: RequestQueue) -> Iterator[None]:
    """Let SIGINT and SIGTERM put the end into the queue, whose put may interrupt itself."""
    signal_numbers = (signal.SIGINT, signal.SIGTERM)
    previous_handlers = {
        signal_number: signal.signal(signal_number, lambda *_: requests.put(None))
        for signal_number in signal_numbers
    }
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _free_port(host: str, port: int | None) -> int:
    """A port that can be listened on; viser would try others, or for ever, without a word."""
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
