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
from crane.common.extras import library
from crane.view.live.door import Door, hear_values_alone
from crane.view.live.page import Page
from crane.view.live.playback import Playback
from crane.view.live.session import Session

_FIRST, _PORTS = 8080, 20  # to choose from where none is given
_FRAME = 1 / 30  # of a recording that plays [s]

Requests = SimpleQueue[tuple[str, float] | None]


def serve(
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
    requests: Requests = SimpleQueue()
    door = Door(host)
    with _until_signal(requests):
        server = start(door, port)
        try:
            if not door.alone:
                warnings.warn(
                    f"it listens on {host}, not on this computer alone: whoever has "
                    "the address sees the machine and moves it, and it is sent unencrypted",
                    CraneWarning,
                    stacklevel=2,
                )
            page = Page(server, session, playback, requests)
            address = door.address(server.get_port())
            print(f"live view at {address} (Ctrl+C ends it)", flush=True)
            _work(page, requests)
        finally:
            stop(server)


def _work(page: Page, requests: Requests) -> None:
    """Do what is asked for, and play, until the end."""
    while (notes := _take(requests, page.playing)) is not None:
        page.work(notes)
        if page.playing:
            page.advance()


def start(door: Door, port: int | None) -> Any:
    """A viser server behind a door, that says nothing and offers no address elsewhere."""
    viser = library("viser", "a live view")
    port = _free_port(door.host, port)
    with redirect_stdout(io.StringIO()), door.kept():
        server: Any = viser.ViserServer(host=door.host, port=port, verbose=False)
    hear_values_alone(server)
    # a page can ask for a public address on somebody else's server: not with ours
    server.request_share_url = lambda *_, **__: None
    return server


def stop(server: Any) -> None:
    """End a server and its threads."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _take(requests: Requests, playing: bool) -> list[tuple[str, float]] | None:
    """All notes there are, at least one unless a recording plays; None at the end."""
    notes: list[tuple[str, float]] = []
    try:
        item = requests.get(timeout=_FRAME if playing else None)
        while item is not None:
            notes.append(item)
            item = requests.get_nowait()
    except Empty:
        return notes
    return None


@contextmanager
def _until_signal(requests: Requests) -> Iterator[None]:
    """Let SIGINT and SIGTERM put the end into the queue, whose put may interrupt itself."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *_: requests.put(None)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
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
    candidates = range(_FIRST, _FIRST + _PORTS) if port is None else [port]
    problem = ""
    for candidate in candidates:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address[0], candidate))
            except OSError as error:
                problem = error.strerror or str(error)
            else:
                return int(probe.getsockname()[1])
    which = f"port {candidates[0]} cannot" if port is not None else f"no port from {_FIRST} on can"
    raise OutputError(f"{host}: {which} be listened on ({problem}), choose another port")
