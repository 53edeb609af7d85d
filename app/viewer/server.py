"""A viser server that only this machine's own page may talk to.

viser listens on every interface, accepts websockets from any web page, opens a public tunnel when any client
asks for one, and moves to another port in silence. Here it listens on the loopback interface unless told
otherwise; requests must name this server as their host (no DNS rebinding) and, where a browser says which
page they come from, that page must be ours; the tunnel is shut; what is no message of a viewer ends its own
connection and nothing else.
"""

from __future__ import annotations

import contextlib
import functools
import http
import io
import logging
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from math import isfinite
from typing import Any, cast
from urllib.parse import urlsplit

import msgspec.msgpack
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from app.errors import UsageError

_log = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080
MAX_MESSAGE = 65536  # [bytes]; cameras and clicks are far shorter
# What pages send that anybody here listens to; everything else, share requests first, is dropped unread.
HANDLED = frozenset({"ViewerCameraMessage", "GuiUpdateMessage"})
PORTS_TRIED = 20  # from the default one on
_LOOPBACK_NAMES = {"localhost", "127.0.0.1", "[::1]", "::1"}
_ANYWHERE = {"0.0.0.0", "::", ""}
_starting = threading.Lock()


def open_server(host: str = LOOPBACK, port: int | None = None) -> ViewerServer:
    """Start to listen.

    Args:
        host: interface to listen on.
        port: which one; None takes the default or the next free one after it, 0 any.

    Raises:
        UsageError: the port is taken, or there is no such interface.
    """
    return ViewerServer(host, _free_port(host, port))


def _free_port(host: str, port: int | None) -> int:
    candidates = [port] if port is not None else range(DEFAULT_PORT, DEFAULT_PORT + PORTS_TRIED)
    problem: OSError | None = None
    for candidate in candidates:
        try:
            family = socket.getaddrinfo(host or None, candidate, type=socket.SOCK_STREAM)[0][0]
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, candidate))
                return int(probe.getsockname()[1])
        except socket.gaierror:
            raise UsageError(f"--host {host} is no address of this machine: leave it out") from None
        except (OSError, OverflowError) as error:
            problem = error if isinstance(error, OSError) else OSError(0, "no such port")
    assert problem is not None
    reason = (problem.strerror or str(problem)).lower()
    if port is None:
        raise UsageError(f"ports {DEFAULT_PORT} to {DEFAULT_PORT + PORTS_TRIED - 1}: {reason}: give --port")
    raise UsageError(f"--host {host} --port {port}: {reason}; give another --port, or none for the next free")


class ViewerServer(viser.ViserServer):
    """viser's server behind a guard."""

    def __init__(self, host: str, port: int) -> None:
        guard = Guard(host)
        with _starting, _guarded(guard), _silence():
            super().__init__(host=host, port=port, label="NodeSLAM", verbose=False)
        guard.control = lambda uuid: self.gui._gui_input_handle_from_uuid.get(uuid)
        self.get_event_loop().set_exception_handler(_contain)

    @property
    def url(self) -> str:
        """Where a browser on this machine finds it."""
        host = self.get_host()
        shown = "localhost" if host in _ANYWHERE | _LOOPBACK_NAMES else host
        return f"http://{shown}:{self.get_port()}"

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused: nobody may publish this server, neither a client nor a program."""
        _log.warning("a client asked for a public tunnel to the viewer; refused")
        return None

    def stop(self) -> None:
        with _silence():
            super().stop()


def _contain(loop: Any, context: dict[str, Any]) -> None:
    """What a message sets off in a task of its own, such as a word where a number belongs."""
    _log.info("a viewer's message was dropped: %s", context.get("exception") or context.get("message"))


def _silence() -> contextlib.redirect_stdout[io.StringIO]:
    """For the banners that viser prints."""
    return contextlib.redirect_stdout(io.StringIO())


class Guard:
    """Decides which requests are answered, and which messages are passed on.

    Attributes:
        control: finds a control of the viewer by its id; None where there is none.
    """

    def __init__(self, host: str) -> None:
        self.control: Callable[[str], Any] = lambda uuid: None
        self.names = set(_LOOPBACK_NAMES) | {host.lower()}
        self.any_host = host in _ANYWHERE

    def refusal(self, request: Request) -> str | None:
        """Why a request is refused, or None."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or len(origins) > 1:
            return "malformed headers"
        if not self.any_host and _name(f"//{hosts[0]}") not in self.names:
            return f"this server is not called {hosts[0][:80]!r}"
        if not _is_websocket(request):
            return None
        if origins and urlsplit(origins[0]).netloc.lower() != hosts[0].lower():
            return f"pages of {origins[0][:80]!r} may not connect"
        protocols = ", ".join(request.headers.get_all("Sec-WebSocket-Protocol"))
        if f"viser-v{viser.__version__}" not in [entry.strip() for entry in protocols.split(",")]:
            return "not a page of this version: reload it"
        return None


def _is_websocket(request: Request) -> bool:
    return request.headers.get("Upgrade", "").lower() == "websocket"


def _name(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


@contextlib.contextmanager
def _guarded(guard: Guard) -> Iterator[None]:
    """While viser starts to listen, it does so behind the guard: it has no setting for that."""
    listen = websockets.asyncio.server.serve

    def guarded_listen(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        return listen(
            _contained(handler, guard),
            *args,
            process_request=functools.partial(_answer, guard, process_request),
            **options,
        )

    websockets.asyncio.server.serve = guarded_listen  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = listen


def _answer(
    guard: Guard, next_answer: Any, connection: ServerConnection, request: Request
) -> Response | None:
    reason = guard.refusal(request)
    if reason is None:
        return next_answer(connection, request)
    _log.warning("a connection to the viewer was refused: %s", reason)
    return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", Headers(), f"{reason}\n".encode())


def _contained(
    handler: Callable[[ServerConnection], Awaitable[None]], guard: Guard
) -> Callable[[ServerConnection], Awaitable[None]]:
    """The handler; what a client breaks is its own connection."""

    async def contained(connection: ServerConnection) -> None:
        try:
            await handler(cast(ServerConnection, _Checked(connection, guard)))
        except Exception as error:  # whatever a message sets off
            _log.info("a viewer's connection is closed (%s: %s)", type(error).__name__, error)
            await connection.close(1007, "malformed message")

    return contained


class _Checked:
    """A connection that hands on only what pages of this viewer send; anything else ends it."""

    def __init__(self, connection: ServerConnection, guard: Guard) -> None:
        self._connection, self._guard = connection, guard

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        while True:
            raw = await self._connection.recv()
            message = checked_message(raw, self._guard.control)
            if message in HANDLED:
                assert isinstance(raw, bytes)
                return raw


def checked_message(raw: bytes | str, control: Callable[[str], Any] = lambda uuid: None) -> str:
    """The kind of a message; "misfit" where it asks a control for what that cannot be.

    Raises:
        ValueError: it is none, or tries to change more of a control than its value.
    """
    if isinstance(raw, str) or len(raw) > MAX_MESSAGE:
        raise ValueError("text, or too long")
    message = msgspec.msgpack.decode(raw)
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise ValueError("not a message")
    kind = message["type"]
    if kind == "GuiUpdateMessage":  # viser would set any attribute that is named here
        updates = message.get("updates")
        if not isinstance(updates, dict) or set(updates) != {"value"}:
            raise ValueError("not the value of a control")
        if not _is_plain(updates["value"]):
            raise ValueError("not a value")
        handle = control(str(message.get("uuid")))
        if handle is not None and not _fits(handle._impl, updates["value"]):
            return "misfit"
    if kind == "ViewerCameraMessage":
        numbers = [message.get(name) for name in ("position", "wxyz", "look_at", "up_direction")]
        flat = [value for vector in numbers for value in (vector if isinstance(vector, list) else [None])]
        if not all(isinstance(value, int | float) and isfinite(value) for value in flat):
            raise ValueError("not a camera")
    return kind


def _is_plain(value: Any) -> bool:
    return isinstance(value, bool | int | str) or (isinstance(value, float) and isfinite(value))


def _fits(state: Any, value: Any) -> bool:
    """Whether a control may have a value: viser would cast any word to True and press a button with it."""
    options = getattr(state.props, "options", None)
    if options is not None:
        return value in options
    if isinstance(state.value, bool):
        return isinstance(value, bool)
    if isinstance(state.value, int | float):
        if isinstance(value, bool | str):
            return False
        low, high, step = (getattr(state.props, name, None) for name in ("min", "max", "step"))
        slack = step or 0.0  # pages round to steps
        return (low is None or value >= low - slack) and (high is None or value <= high + slack)
    return isinstance(value, type(state.value))
