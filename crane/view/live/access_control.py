"""Who may look at a live view and move it, and what they may say.

A page of somebody else, open in the same browser, can send requests to this computer, too. It
cannot know the token in the address; the browser tells where it comes from (`Origin`); and where
its own name was made to lead here (DNS rebinding) that name is in `Host`.
"""

import hmac
import ipaddress
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

_REFUSAL_MESSAGE = (
    "Refused: open the address that crane live has told, by the number of its host.\n"
)


class AccessGuard:
    """What a request has to have before anything is sent.

    Args:
        host: Name or number that is listened on.

    Attributes:
        host: The same.
        token: First part of the path, drawn for this view.
    """

    def __init__(self, host: str):
        self.host, self.token = host, secrets.token_urlsafe(16)

    @property
    def is_local_only(self) -> bool:
        """Whether only this computer is let in."""
        return self.host.lower() == "localhost" or _is_loopback(self.host)

    def address(self, port: int) -> str:
        """What to open in a browser."""
        host_text = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host_text}:{port}/{self.token}/"

    def authorized_path(self, path: str, hosts: list[str], origins: list[str]) -> str | None:
        """The path behind the token; None where the request is refused.

        Args:
            path: That was asked for.
            hosts: All headers `Host`.
            origins: All headers `Origin`, which programs that are no browsers leave out.
        """
        if len(hosts) != 1 or not self._is_known_host(hosts[0]):
            return None
        if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
            return None
        path_token, slash, inner_path = path.partition("?")[0].removeprefix("/").partition("/")
        if not hmac.compare_digest(path_token.encode(), self.token.encode()):
            return None
        return "/" + inner_path

    def _is_known_host(self, host: str) -> bool:
        """Whether a header `Host` names what is listened on, which a foreign name does not."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
            if name in ("localhost", self.host.lower()):
                return True
            number = ipaddress.ip_address(name)
        except ValueError:
            return False
        return number.is_loopback or not self.is_local_only

    @contextmanager
    def guard_servers(self) -> Iterator[None]:
        """Servers that viser begins meanwhile ask this door first, by HTTP and by websocket."""
        from websockets.asyncio import server

        serve: Any = server.serve

        def guarded_serve(*arguments: Any, process_request: Callable, **options: Any) -> Any:
            def check_request(connection: Any, request: Any) -> Any:
                header_values = request.headers.get_all
                path = self.authorized_path(
                    request.path, header_values("Host"), header_values("Origin")
                )
                if path is None:
                    return connection.respond(403, _REFUSAL_MESSAGE)
                request.path = path
                return process_request(connection, request)

            return serve(*arguments, process_request=check_request, **options)

        server.serve = guarded_serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            server.serve = serve  # type: ignore[misc]


def restrict_widget_updates(server: Any) -> None:
    """Let windows say of sliders a number within their range, of buttons that they are pressed.

    viser would take anything, for any property, and tell it to all other windows.
    """
    from viser._messages import GuiUpdateMessage

    gui = server.gui
    interface, update = gui._websock_interface, gui._handle_gui_updates

    async def checked(client: Any, message: Any) -> None:
        widgets, name = gui._gui_input_handle_from_uuid, message.uuid
        if (
            isinstance(name, str)
            and name in widgets
            and _is_valid_update(widgets[name], message.updates)
        ):
            await update(client, message)

    interface.unregister_handler(GuiUpdateMessage, update)
    interface.register_handler(GuiUpdateMessage, checked)


def _is_valid_update(widget: Any, updates: Any) -> bool:
    """Whether an update is one of a value that a widget can have."""
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
