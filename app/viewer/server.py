"""A viser server with restricted network access.

viser listens on all interfaces, accepts websockets from any web page, opens a public tunnel at any client's
request, and silently moves to another port. This server listens on the loopback interface by default, is
protected by a ``Guard``, never opens a tunnel, and reports ports in use.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import io
import logging
import socket
import threading
from typing import Any

import viser
from viser.infra import WebsockMessageHandler

from app.errors import UsageError
from app.memory import limit_arenas
from app.viewer.guard import LOOPBACK_NAMES, WILDCARD_HOSTS, Guard, guarded_listening

logger = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080
MAX_PORT = 65535
PORTS_TRIED = 20  # from the default port on
_starting = threading.Lock()


def open_server(host: str = LOOPBACK, port: int | None = None) -> ViewerServer:
    """Start to listen.

    Args:
        host: Interface to listen on.
        port: Port to listen on; None for the default or the next free one after it, 0 for any free one.

    Raises:
        UsageError: The port is invalid or in use, or there is no such interface.
    """
    return ViewerServer(host, _free_port(host, port))


def _free_port(host: str, port: int | None) -> int:
    if port is not None and not 0 <= port <= MAX_PORT:
        raise UsageError(f"--port {port} must be between 0 and {MAX_PORT}; 0 selects a free port")
    candidates = [port] if port is not None else range(DEFAULT_PORT, DEFAULT_PORT + PORTS_TRIED)
    problem = ""
    for candidate in candidates:
        try:
            return _probe(host, candidate)
        except OSError as error:
            if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                raise UsageError(f"--host {host} is not an address of this machine: omit it") from None
            problem = (error.strerror or str(error)).lower()
    if port is None:
        raise UsageError(f"ports {DEFAULT_PORT} to {DEFAULT_PORT + PORTS_TRIED - 1}: {problem}; give --port")
    raise UsageError(
        f"--host {host} --port {port}: {problem}; give another --port, or omit it for the next free one"
    )


def _probe(host: str, port: int) -> int:
    """Bind a port for a moment and return its number.

    Raises:
        OSError: The port cannot be bound.
    """
    family = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM)[0][0]
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((host, port))
        return int(probe.getsockname()[1])


class ViewerServer(viser.ViserServer):
    """viser's server behind a guard."""

    def __init__(self, host: str, port: int) -> None:
        guard = Guard(host)
        limit_arenas()  # callbacks run in up to 32 threads: the memory of a live cell grew by a quarter
        with _starting, guarded_listening(guard), _stdout_suppressed():
            super().__init__(host=host, port=port, label="NodeSLAM", verbose=False)
        guard.control = lambda uuid: self.gui._gui_input_handle_from_uuid.get(uuid)
        self.get_event_loop().set_exception_handler(_log_exception)
        _send_from_any_thread(self._websock_server)
        self._websock_server.on_client_connect(_send_from_any_thread)

    @property
    def url(self) -> str:
        """Address for a browser on this machine."""
        host = self.get_host()
        name = "localhost" if host in WILDCARD_HOSTS | LOOPBACK_NAMES else host
        return f"http://{name}:{self.get_port()}"

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse to open a public tunnel."""
        logger.warning("a client requested a public tunnel to the viewer; refused")
        return None

    def stop(self) -> None:
        with _stdout_suppressed():
            super().stop()


class _ThreadSafeEvent(asyncio.Event):
    """An event that any thread may set; asyncio's own may be set in the thread of its loop only."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._event_loop = loop

    def set(self) -> None:
        if not self.is_set():
            with contextlib.suppress(RuntimeError):  # the loop has ended: nobody waits
                self._event_loop.call_soon_threadsafe(super().set)


def _send_from_any_thread(sender: WebsockMessageHandler) -> None:
    """Let any thread send messages, to all clients or to one.

    viser sets the asyncio event of a message buffer in the thread that adds a message. With many clients, the
    waiters of the event change while it iterates over them, and the drawing call that sent the message fails.
    """
    buffer = sender.get_message_buffer()
    before, buffer.message_event = buffer.message_event, _ThreadSafeEvent(buffer.event_loop)
    buffer.event_loop.call_soon_threadsafe(before.set)  # clients that connected while the server started


def _log_exception(loop: Any, context: dict[str, Any]) -> None:
    """Log the exception of a task that handles a message, such as a value of a wrong type."""
    logger.info("a message was dropped: %s", context.get("exception") or context.get("message"))


def _stdout_suppressed() -> contextlib.redirect_stdout[io.StringIO]:
    """Suppress the banners that viser prints."""
    return contextlib.redirect_stdout(io.StringIO())
