"""The server: gives a robot to one client at a time, and checks the limits of what the client sends.

One thread owns the socket: it answers stops at once, and stops the robot if its client disappears during a
motion. The robot's commands run one after the other in the thread that calls ``run``.
"""

from __future__ import annotations

import importlib
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from manipulation.errors import RobotError, RobotStoppedError
from manipulation.remote import messages as m
from manipulation.remote.client import DEFAULT_ADDRESS
from manipulation.remote.limits import MotionLimits
from manipulation.robot import Robot, follow_opening
from perception.errors import PerceptionError

zmq: Any = importlib.import_module("zmq")

logger = logging.getLogger(__name__)

_TO_ROBOT, _END = b"robot", b"end"  # inner socket between the threads, and the message that ends it


def check_usable(address: str) -> None:
    """Raise RobotError unless a server can use the address at present."""
    m.check_address(address)
    with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        _bind(socket, address)


def _bind(socket: Any, address: str) -> None:
    try:
        socket.bind(address)
    except zmq.ZMQError as error:
        raise RobotError(f"{address} cannot be used ({error}): give another address") from None


class RobotServer:
    """Serves a robot over ZeroMQ.

    Args:
        robot: the robot; its ``stop`` is called from another thread than its other members.
        address: ``tcp://HOST:PORT`` or ``ipc://PATH``; port 0 is a free one.
        clock: present time in [s] on the clock of the robot's states and images.
        limits: limits of trajectories; those of the arm's description if None.

    Attributes:
        address: address with the port that is used.

    Raises:
        RobotError: the address cannot be used.
    """

    def __init__(
        self,
        robot: Robot,
        address: str = DEFAULT_ADDRESS,
        clock: Callable[[], float] = time.monotonic,
        limits: MotionLimits | None = None,
    ) -> None:
        m.check_address(address)
        self._robot, self._clock = robot, clock
        self._limits = limits or MotionLimits.of(robot.arm)
        self._context = zmq.Context()
        self._clients = self._context.socket(zmq.ROUTER)
        self._clients.setsockopt(zmq.ROUTER_MANDATORY, 1)  # sending to a client that is gone is an error
        self._clients.setsockopt(zmq.MAXMSGSIZE, m.MAX_REQUEST_BYTES)
        self._clients.setsockopt(zmq.HEARTBEAT_IVL, 500)
        self._clients.setsockopt(zmq.HEARTBEAT_TIMEOUT, 1500)
        try:
            _bind(self._clients, address)
        except RobotError:
            self._context.destroy()
            raise
        self.address = self._clients.getsockopt_string(zmq.LAST_ENDPOINT)
        self._commands, self._inner = (self._context.socket(zmq.PAIR) for _ in range(2))
        self._inner.bind("inproc://robot")
        self._commands.connect("inproc://robot")
        self._owner = b""
        self._running: m.Request | None = None
        self._thread = threading.Thread(target=self._serve_clients, name="robot server", daemon=True)
        self._thread.start()

    def run(self, until: threading.Event | None = None) -> None:
        """Carry out commands until the event is set; for ever if None."""
        while until is None or not until.is_set():
            if self._commands.poll(100):
                request = m.decode_request(self._commands.recv())
                self._commands.send(self._reply_to(request))

    def close(self) -> None:
        """End the server."""
        if not self._context.closed:
            self._commands.send(_END)
            self._thread.join()
            self._context.destroy(linger=500)

    def __enter__(self) -> RobotServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # In the thread of the robot.

    def _reply_to(self, request: m.Request) -> bytes:
        try:
            return m.encode(m.Reply(request.number, self._execute(request.command)))
        except RobotStoppedError as error:
            answer = m.refusal(error, stopped=True)
        except (RobotError, PerceptionError) as error:
            answer = m.refusal(error)
        except Exception as error:  # of a driver: the state of the robot is unknown
            logger.exception("the robot failed")
            reason = f"the robot failed: {type(error).__name__}: {error}"
            self._robot.stop(reason)
            answer = m.refusal(reason, stopped=True)
        return m.encode(m.Reply(request.number, answer))

    def _execute(self, command: m.Command) -> m.Answer:
        robot = self._robot
        match command:
            case m.Capture():
                frame = robot.capture()
                return m.Image.of(frame, m.State.of(robot.state(), self._clock()))
            case m.Follow():
                trajectory = command.trajectory()
                self._limits.check(trajectory, robot.joint_positions())
                if command.opening is None:
                    robot.follow(trajectory)
                else:
                    follow_opening(robot, trajectory, command.opening)
            case m.MoveGripper():
                robot.move_gripper(command.width)
        return m.State.of(robot.state(), self._clock())

    # In the thread of the socket.

    def _serve_clients(self) -> None:
        poller = zmq.Poller()
        poller.register(self._clients, zmq.POLLIN)
        poller.register(self._inner, zmq.POLLIN)
        while True:
            ready = dict(poller.poll(1e3 * m.BUSY_PERIOD))
            if self._inner in ready:
                reply = self._inner.recv()
                if reply == _END:
                    return
                self._running = None
                self._send(self._owner, reply)
            if self._clients in ready:
                self._receive(self._clients.recv_multipart())
            if self._running is not None and not self._reply(self._owner, self._running.number, m.Busy()):
                self._stop("its client has disappeared")

    def _receive(self, parts: list[bytes]) -> None:
        if len(parts) != 2:
            return
        client, data = parts
        try:
            request = m.decode_request(data)
        except RobotError as error:
            self._reply(client, 0, m.refusal(error))
            return
        answer = self._answer_at_once(client, request)
        if answer is None:
            self._running = request
            self._inner.send(data)
        else:
            self._reply(client, request.number, answer)

    def _answer_at_once(self, client: bytes, request: m.Request) -> m.Answer | None:
        """Return the answer to a command that the robot is not needed for; None for the others."""
        command = request.command
        if isinstance(command, m.Stop):
            self._stop(command.reason)
            return m.Done()
        if isinstance(command, m.Hello):
            return self._welcome(client, command)
        if client != self._owner:
            return m.refusal("the robot belongs to another client, or Hello is missing")
        if isinstance(command, m.Bye):
            if self._running is not None:
                self._stop("its client has left during a command")
            self._owner = b""
            return m.Done()
        return m.refusal("a command is being carried out") if self._running is not None else None

    def _welcome(self, client: bytes, hello: m.Hello) -> m.Answer:
        if hello.version != m.VERSION:
            return m.refusal(f"version {hello.version} of the protocol is not {m.VERSION}")
        if self._owner not in (b"", client) and self._reply(self._owner, 0, m.Busy()):
            return m.refusal("another client has the robot")
        if self._running is not None:
            return m.refusal("a command of the client before is being carried out")
        self._owner = client
        return m.Welcome(m.VERSION, list(self._robot.arm.joint_names), self._robot.arm.max_width)

    def _stop(self, reason: str) -> None:
        logger.warning("the robot is stopped: %s", reason)
        self._robot.stop(reason)

    def _reply(self, client: bytes, number: int, answer: m.Answer) -> bool:
        return self._send(client, m.encode(m.Reply(number, answer)))

    def _send(self, client: bytes, data: bytes) -> bool:
        """Send a message; return whether the client is still connected."""
        try:
            self._clients.send_multipart([client, data], zmq.NOBLOCK)
            return True
        except zmq.ZMQError:
            return False
