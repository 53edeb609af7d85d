"""The client: a robot in another process as an implementation of ``Robot``.

Every wait has a limit. Measurements that are lost, late or damaged are requested again; motions never are. A
fault that remains stops the robot and raises ``RobotStoppedError``, which ends the task with that reason.
"""

from __future__ import annotations

import importlib
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from manipulation.errors import RobotError, RobotStoppedError
from manipulation.kinematics import Kinematics
from manipulation.remote import messages as m
from manipulation.remote.calibration import HandEye
from manipulation.robot import ArmDescription, JointTrajectory, RobotState
from perception.errors import InvalidInputError
from perception.types import RgbdFrame

zmq: Any = importlib.import_module("zmq")

logger = logging.getLogger(__name__)

DEFAULT_ADDRESS = "tcp://127.0.0.1:5555"
WIDTH_TOLERANCE = 1e-3  # [m] between the openings that client and server know

Measured = TypeVar("Measured", RobotState, RgbdFrame)


@dataclass(frozen=True)
class LinkConfig:
    """Limits of the connection.

    Attributes:
        connect: time for the first answer in [s].
        silence: time without any message after which the robot counts as lost in [s]; busy servers send some.
        reading: time for a state or an image in [s].
        motion: time for a motion in [s], added to ``slowdown`` times its duration.
        slowdown: largest ratio of a motion's time to its duration; simulations can be slower than robots.
        attempts: number of times that a measurement is asked for.
        max_age: largest age of a state in [s].
        max_frame_age: largest age of an image in [s].
        max_skew: largest time between an image and the joint state it is sent with in [s].
    """

    connect: float = 5.0
    silence: float = 5.0
    reading: float = 20.0
    motion: float = 60.0
    slowdown: float = 20.0
    attempts: int = 3
    max_age: float = 0.1
    max_frame_age: float = 0.5
    max_skew: float = 0.02


class RemoteRobot:
    """A robot behind a server; implements ``manipulation.robot.Robot``."""

    def __init__(
        self,
        arm: ArmDescription,
        address: str = DEFAULT_ADDRESS,
        hand_eye: HandEye | None = None,
        config: LinkConfig = LinkConfig(),
    ) -> None:
        """Connect to a server.

        Args:
            arm: description of the arm; its joints must be those of the server's robot.
            address: ``tcp://HOST:PORT`` or ``ipc://PATH``.
            hand_eye: calibration of the camera; None if the server sends the camera's pose with each image.
            config: limits of the connection.

        Raises:
            RobotError: the address is invalid, nothing answers, or another robot or client is there.
        """
        self._arm, self._config, self._hand_eye = arm, config, hand_eye
        self._kinematics = Kinematics(arm) if hand_eye is not None else None
        self._number = 0
        self._stopped = ""
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 500)  # [ms] in which a last stop is sent
        self._socket.setsockopt(zmq.MAXMSGSIZE, m.MAX_REPLY_BYTES)
        for option in (zmq.HEARTBEAT_IVL, zmq.HEARTBEAT_TIMEOUT):
            self._socket.setsockopt(option, 1000)
        try:
            self._connect(address)
        except BaseException:
            self._context.destroy()
            raise

    def _connect(self, address: str) -> None:
        m.check_address(address)
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            raise RobotError(f"{address} is no address ({error}): give tcp://HOST:PORT") from None
        limit = self._config.connect
        answer = self._ask(m.Hello(), limit, limit)
        if answer is None:
            raise RobotError(f"no robot answers at {address} within {limit:g} s: start its server")
        if isinstance(answer, m.Refused):
            raise RobotError(f"{address}: {answer.reason}")
        if not isinstance(answer, m.Welcome) or answer.version != m.VERSION:
            raise RobotError(f"{address} speaks another version of the protocol than {m.VERSION}")
        if tuple(answer.joint_names) != self._arm.joint_names:
            raise RobotError(
                f"the robot at {address} has the joints {', '.join(answer.joint_names)}, the robot file "
                f"{', '.join(self._arm.joint_names)}"
            )
        if not abs(answer.max_width - self._arm.max_width) < WIDTH_TOLERANCE:
            raise RobotError(
                f"the gripper at {address} opens {answer.max_width:.4f} m, that of the robot file "
                f"{self._arm.max_width:.4f} m"
            )

    # The Robot protocol.

    @property
    def arm(self) -> ArmDescription:
        return self._arm

    def state(self) -> RobotState:
        return self._measure(m.GetState(), self._read_state)

    def joint_positions(self) -> Float[np.ndarray, "n"]:
        return self.state().positions

    def gripper_width(self) -> float:
        return self.state().gripper_width

    def follow(self, trajectory: JointTrajectory) -> None:
        self._move(m.Follow.of(trajectory), trajectory.duration)

    def move_gripper(self, width: float) -> float:
        return self._move(m.MoveGripper(float(width)), 1.0).gripper_width

    def follow_opening(self, trajectory: JointTrajectory, width: float) -> float:
        command = m.Follow.of(trajectory, float(width))
        return self._move(command, trajectory.duration + 1.0).gripper_width

    def capture(self) -> RgbdFrame:
        return self._measure(m.Capture(), self._read_image)

    def stop(self, reason: str) -> None:
        if not self._stopped:
            self._stopped = reason
            self._ask(m.Stop(reason[: m.MAX_TEXT]), self._config.silence, self._config.silence)

    def close(self) -> None:
        """End the session; a motion that is under way is stopped."""
        if not self._context.closed:
            self._send(m.Bye())
            self._context.destroy(linger=500)

    def __enter__(self) -> RemoteRobot:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Commands.

    def _move(self, command: m.Follow | m.MoveGripper, duration: float) -> RobotState:
        """Send a motion and wait for its end; it is never sent twice."""
        self._require_running()
        limit = self._config.motion + self._config.slowdown * duration
        answer = self._ask(command, limit, self._config.silence)
        if isinstance(answer, m.State):
            return answer.state()
        if isinstance(answer, m.Refused):
            self._raise(answer)
        raise self._fail(f"no answer to a motion within {limit if answer else self._config.silence:g} s")

    def _measure(self, command: m.GetState | m.Capture, read: Callable[[m.Answer], Measured]) -> Measured:
        """Ask for a measurement until it is usable, ``attempts`` times at most; then stop the robot."""
        self._require_running()
        problem = ""
        for _ in range(self._config.attempts):
            answer = self._ask(command, self._config.reading, self._config.silence)
            if answer is None:
                problem = f"no {_NAMES[type(command)]} within {self._config.silence:g} s"
                continue
            if isinstance(answer, m.Refused) and answer.stopped:
                self._raise(answer)
            try:
                if isinstance(answer, m.Refused):
                    raise RobotError(answer.reason)
                return read(answer)
            except (RobotError, InvalidInputError) as error:
                problem = str(error)
                logger.info("asked again for an image or a state: %s", problem)
        raise self._fail(problem)

    def _read_state(self, answer: m.Answer) -> RobotState:
        if not isinstance(answer, m.State):
            raise RobotError(f"the answer is {type(answer).__name__}, not State")
        if not 0 <= answer.age <= self._config.max_age:
            raise RobotError(f"the joint state is {answer.age:.2f} s old, {self._config.max_age:g} s at most")
        state = answer.state()
        if state.positions.shape != (len(self._arm.joint_names),):
            raise RobotError(f"the state has {len(state.positions)} joints of {len(self._arm.joint_names)}")
        if not (np.isfinite(state.positions).all() and math.isfinite(state.gripper_width)):
            raise RobotError("the joint state is not finite")
        return state

    def _read_image(self, answer: m.Answer) -> RgbdFrame:
        if not isinstance(answer, m.Image):
            raise RobotError(f"the answer is {type(answer).__name__}, not Image")
        config, state = self._config, answer.state
        q = self._read_state(m.State(state.now, state.now, state.positions, state.gripper_width)).positions
        age, skew = state.now - answer.time, abs(state.time - answer.time)
        if not 0 <= age <= config.max_frame_age:
            raise RobotError(f"the image is {age:.2f} s old, {config.max_frame_age:g} s at most")
        if not skew <= config.max_skew:
            raise RobotError(f"image and joint state are {skew:.3f} s apart, {config.max_skew:g} s at most")
        frame = answer.frame()
        if self._hand_eye is not None and self._kinematics is not None:
            frame = replace(frame, T_world_camera=self._kinematics.forward(q) @ self._hand_eye.T_tcp_camera)
        if frame.T_world_camera is None:
            raise RobotError("the image has no camera pose: give a hand-eye calibration")
        return frame

    # Failures.

    def _require_running(self) -> None:
        if self._stopped:
            raise RobotStoppedError(self._stopped)

    def _raise(self, refusal: m.Refused) -> None:
        if not refusal.stopped:
            raise RobotError(refusal.reason)
        self._stopped = refusal.reason
        raise RobotStoppedError(refusal.reason)

    def _fail(self, reason: str) -> RobotStoppedError:
        """Stop the robot; return the error to raise."""
        self.stop(reason)
        return RobotStoppedError(f"the robot was stopped: {reason}")

    # Messages.

    def _send(self, command: m.Command) -> None:
        self._number += 1
        try:
            self._socket.send(m.encode(m.Request(self._number, command)), zmq.NOBLOCK)
        except zmq.Again:  # nobody is connected, and the queue is full
            logger.warning("a message could not be sent")

    def _ask(self, command: m.Command, limit: float, silence: float) -> m.Answer | None:
        """Send a command and wait for its answer; None if there is none in time.

        Args:
            command: the command.
            limit: largest time until the answer in [s].
            silence: largest time without a message in [s].
        """
        self._send(command)
        begin = heard = time.monotonic()
        while True:
            now = time.monotonic()
            left = min(begin + limit, heard + silence) - now
            if left <= 0:
                return None
            if not self._socket.poll(math.ceil(1e3 * left)):
                continue
            reply = _valid_reply(self._socket.recv_multipart())
            if reply is None or reply.number != self._number:  # damaged, or the answer to an earlier request
                continue
            heard = time.monotonic()
            if not isinstance(reply.answer, m.Busy):
                return reply.answer


_NAMES = {m.GetState: "joint state", m.Capture: "image"}


def _valid_reply(parts: list[bytes]) -> m.Reply | None:
    try:
        return m.decode_reply(parts[0]) if len(parts) == 1 else None
    except RobotError as error:
        logger.warning("a reply was dropped: %s", error)
        return None
