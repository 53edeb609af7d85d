"""Messages between the client and the server of a robot: MessagePack maps, validated on arrival.

The client sends a ``Request`` (a number and a command), the server answers with a ``Reply`` that carries the
same number. While a command runs, the server sends ``Busy`` every ``BUSY_PERIOD``. Units are SI, angles in
radians, images row by row; all times are on the clock of the robot's controller.

A server in another language sends maps with the field names below, and the class name in the entry ``type``.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from manipulation.errors import RobotError
from manipulation.robot import JointTrajectory, RobotState
from perception.types import CameraIntrinsics, RgbdFrame

VERSION = 2
BUSY_PERIOD = 0.5  # [s]
MAX_PORT = 65535
MAX_REQUEST_BYTES = 16 * 2**20
MAX_REPLY_BYTES = 64 * 2**20
MAX_JOINTS, MAX_SAMPLES, MAX_SIDE, MAX_TEXT = 32, 60_000, 4096, 1000

Joints = Annotated[list[float], Meta(min_length=1, max_length=MAX_JOINTS)]
Samples = Annotated[list[Joints], Meta(min_length=1, max_length=MAX_SAMPLES)]
Side = Annotated[int, Meta(gt=0, le=MAX_SIDE)]
Width = Annotated[float, Meta(ge=0, le=1)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]


class _Message(msgspec.Struct, frozen=True, tag=True, forbid_unknown_fields=True):
    pass


class Hello(_Message, frozen=True):
    """First message of a client; the robot belongs to it until ``Bye`` or the end of its connection."""

    version: int = VERSION


class GetState(_Message, frozen=True):
    """Ask for a ``State``."""


class Capture(_Message, frozen=True):
    """Ask for an ``Image``."""


class Follow(_Message, frozen=True):
    """Execute a joint trajectory with a sample every ``period``; answered by ``State`` when the arm rests.

    With an ``opening``, the pads move toward it [m] at the same time, or before.
    """

    period: Annotated[float, Meta(gt=0, le=1)]
    positions: Samples
    velocities: Samples
    accelerations: Samples
    opening: Width | None = None

    @staticmethod
    def of(trajectory: JointTrajectory, opening: float | None = None) -> Follow:
        arrays = (trajectory.positions, trajectory.velocities, trajectory.accelerations)
        return Follow(trajectory.period, *(array.tolist() for array in arrays), opening=opening)

    def trajectory(self) -> JointTrajectory:
        """Return the trajectory.

        Raises:
            RobotError: its samples differ in length.
        """
        lengths = {len(row) for rows in (self.positions, self.velocities, self.accelerations) for row in rows}
        counts = {len(self.positions), len(self.velocities), len(self.accelerations)}
        if len(lengths) > 1 or len(counts) > 1:
            raise RobotError("positions, velocities and accelerations of the trajectory differ in shape")
        arrays = (np.array(rows) for rows in (self.positions, self.velocities, self.accelerations))
        return JointTrajectory(self.period, *arrays)


class MoveGripper(_Message, frozen=True):
    """Move the pads toward a width; answered by ``State``."""

    width: Width


class Stop(_Message, frozen=True):
    """Stop all motion; answered by ``Done`` at once, also while another command runs, and to any client."""

    reason: Text


class Bye(_Message, frozen=True):
    """Last message of a client; a motion that is under way is stopped."""


class Welcome(_Message, frozen=True):
    """Answer to ``Hello``: which robot it is."""

    version: int
    joint_names: Annotated[list[Text], Meta(max_length=MAX_JOINTS)]
    max_width: float


class State(_Message, frozen=True):
    """Measured state; ``time`` is that of the measurement, ``now`` that of the message."""

    time: float
    now: float
    positions: Joints
    gripper_width: float

    @staticmethod
    def of(state: RobotState, now: float) -> State:
        return State(state.time, now, state.positions.tolist(), state.gripper_width)

    def state(self) -> RobotState:
        return RobotState(self.time, np.array(self.positions), self.gripper_width)

    @property
    def age(self) -> float:
        """Time since the measurement in [s]; infinite if a time is not finite."""
        age = self.now - self.time
        return age if math.isfinite(age) else math.inf


class Image(_Message, frozen=True):
    """A registered RGB-D image with the state of the arm at its exposure.

    ``rgb`` has 3 bytes a pixel, ``depth`` float32 in little-endian order, in metres, 0 for none. The camera's
    pose ``T_world_camera`` (16 numbers, row by row) is None where the client has the hand-eye calibration.
    """

    time: float
    state: State
    width: Side
    height: Side
    fx: float
    fy: float
    cx: float
    cy: float
    rgb: bytes
    depth: bytes
    T_world_camera: Annotated[list[float], Meta(min_length=16, max_length=16)] | None = None

    @staticmethod
    def of(frame: RgbdFrame, state: State) -> Image:
        camera, T = frame.intrinsics, frame.T_world_camera
        return Image(
            frame.time, state, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
            frame.rgb.tobytes(), frame.depth.astype("<f4").tobytes(),
            None if T is None else T.ravel().tolist(),
        )  # fmt: skip

    def frame(self) -> RgbdFrame:
        """Return the frame.

        Raises:
            RobotError: an array has another size than the image.
            InvalidInputError: the values are no image.
        """
        shape = (self.height, self.width)
        if len(self.rgb) != 3 * math.prod(shape) or len(self.depth) != 4 * math.prod(shape):
            raise RobotError(
                f"the image has {len(self.rgb)} bytes of colour and {len(self.depth)} of depth for "
                f"{self.width}x{self.height} pixels"
            )
        # NumPy computes float32 images with Python's float in single, with a float64 in double precision, as
        # with the frames of the simulated cell.
        pinhole = (np.float64(value) for value in (self.fx, self.fy, self.cx, self.cy))
        camera = CameraIntrinsics(self.width, self.height, *pinhole)
        T = None if self.T_world_camera is None else np.array(self.T_world_camera).reshape(4, 4)
        rgb = np.frombuffer(self.rgb, np.uint8).reshape(*shape, 3)
        depth = np.frombuffer(self.depth, "<f4").reshape(shape).astype(np.float32)
        return RgbdFrame(self.time, rgb, depth, camera, T)


class Done(_Message, frozen=True):
    """The command was carried out."""


class Busy(_Message, frozen=True):
    """A command is being carried out."""


class Refused(_Message, frozen=True):
    """The command was refused or failed; ``stopped`` if the robot accepts no further motion."""

    reason: Text
    stopped: bool = False


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A command with its number, which the reply repeats."""

    number: Annotated[int, Meta(ge=0)]
    command: Hello | GetState | Capture | Follow | MoveGripper | Stop | Bye


class Reply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The answer to the request of that number."""

    number: Annotated[int, Meta(ge=0)]
    answer: Welcome | State | Image | Done | Busy | Refused


Command = Hello | GetState | Capture | Follow | MoveGripper | Stop | Bye
Answer = Welcome | State | Image | Done | Busy | Refused

_encoder = msgspec.msgpack.Encoder(enc_hook=lambda number: number.item())  # of numpy
_request_decoder = msgspec.msgpack.Decoder(Request)
_reply_decoder = msgspec.msgpack.Decoder(Reply)


def check_address(address: str) -> None:
    """Raise RobotError unless the address has one of the two forms that are supported."""
    port = address.rpartition(":")[2]
    has_port = port.isascii() and port.isdigit() and len(port) <= 5 and int(port) <= MAX_PORT
    if not address.startswith("ipc://") and not (address.startswith("tcp://") and has_port):
        raise RobotError(
            f"{address!r} is no address: give tcp://HOST:PORT or ipc://PATH; ports are 0 to {MAX_PORT}"
        )


def encode(message: Request | Reply) -> bytes:
    """Return a message as MessagePack."""
    return _encoder.encode(message)


def decode_request(data: bytes) -> Request:
    """Return a request.

    Raises:
        RobotError: the bytes are not a valid request.
    """
    return _decode(_request_decoder, data)


def decode_reply(data: bytes) -> Reply:
    """Return a reply.

    Raises:
        RobotError: the bytes are not a valid reply.
    """
    return _decode(_reply_decoder, data)


def refusal(reason: object, stopped: bool = False) -> Refused:
    """Return a refusal whose reason is shortened to the longest text."""
    return Refused(str(reason)[:MAX_TEXT], stopped)


def _decode(decoder: msgspec.msgpack.Decoder[Any], data: bytes) -> Any:
    try:
        return decoder.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise RobotError(f"the message is malformed: {error}") from None
