"""Access control of the viewer's server: accepted hosts, origins and messages.

A request must name this server in its ``Host`` header, which defeats DNS rebinding, and a websocket opened
by a web page must come from this server's own page. A malformed message closes its own connection only.
"""

from __future__ import annotations

import contextlib
import functools
import http
import logging
from collections.abc import Awaitable, Callable, Iterator
from typing import Any, cast
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from app.viewer.messages import ControlLookup, check_message

logger = logging.getLogger(__name__)

LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "[::1]", "::1"})
WILDCARD_HOSTS = frozenset({"0.0.0.0", "::", ""})
# The only messages that are passed on; all others, above all requests for a public tunnel, are dropped.
HANDLED_MESSAGES = frozenset({"ViewerCameraMessage", "GuiUpdateMessage"})
MAX_QUOTED = 80  # characters of a header in a log message
Handler = Callable[[ServerConnection], Awaitable[None]]


class Guard:
    """Decides which requests are answered.

    Attributes:
        host: Interface on which the server listens.
        control: Looks up a control of the viewer by its id.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.control: ControlLookup = lambda uuid: None

    def refusal(self, request: Request) -> str | None:
        """Return the reason for refusing a request; None to answer it."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or len(origins) > 1:
            return "malformed headers"
        if self.host not in WILDCARD_HOSTS and _host_name(hosts[0]) not in LOOPBACK_NAMES | {
            self.host.lower()
        }:
            return f"{hosts[0][:MAX_QUOTED]!r} is not a name of this server"
        if request.headers.get("Upgrade", "").lower() != "websocket":
            return None
        if origins and _network_location(origins[0]) != hosts[0].lower():
            return f"pages of {origins[0][:MAX_QUOTED]!r} may not connect"
        protocols = ", ".join(request.headers.get_all("Sec-WebSocket-Protocol"))
        if f"viser-v{viser.__version__}" not in [entry.strip() for entry in protocols.split(",")]:
            return "the page belongs to another version of the viewer: reload it"
        return None


def _host_name(host: str) -> str | None:
    try:
        return urlsplit(f"//{host}").hostname
    except ValueError:
        return None


def _network_location(origin: str) -> str | None:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return None


@contextlib.contextmanager
def guarded_listening(guard: Guard) -> Iterator[None]:
    """Put the guard in front of every server that starts to listen; viser has no setting for this."""
    listen = websockets.asyncio.server.serve

    def guarded_listen(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        return listen(
            _isolated(handler, guard),
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
    logger.warning("a connection to the viewer was refused: %s", reason)
    return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", Headers(), f"{reason}\n".encode())


def _isolated(handler: Handler, guard: Guard) -> Handler:
    """Return a handler whose errors close their own connection only."""

    async def isolated(connection: ServerConnection) -> None:
        try:
            await handler(cast(ServerConnection, _CheckedConnection(connection, guard)))
        except Exception as error:  # messages may cause errors of any type
            logger.info("a connection to the viewer was closed (%s: %s)", type(error).__name__, error)
            await connection.close(1007, "malformed message")

    return isolated


class _CheckedConnection:
    """A connection that passes on valid messages only."""

    def __init__(self, connection: ServerConnection, guard: Guard) -> None:
        self._connection, self._guard = connection, guard

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        while True:
            raw = await self._connection.recv()
            if check_message(raw, self._guard.control) in HANDLED_MESSAGES:
                assert isinstance(raw, bytes)
                return raw
