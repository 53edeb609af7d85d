"""Validation of the messages that clients send to the viewer."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from math import isfinite
from typing import Any

import msgspec.msgpack

MAX_MESSAGE_SIZE = 65536  # [bytes]; messages of cameras and controls are far shorter
CAMERA_VECTORS = {"position": 3, "wxyz": 4, "look_at": 3, "up_direction": 3}
CAMERA_NUMBERS = ("fov", "near", "far", "image_height", "image_width")
INVALID_VALUE = "invalid value"
ControlLookup = Callable[[str], Any]  # control by id; None if there is none


def check_message(raw: bytes | str, control: ControlLookup = lambda uuid: None) -> str:
    """Return the type of a message; INVALID_VALUE if its value is not valid for the control.

    Raises:
        ValueError: It is no message of a client, or would change more of a control than its value.
        msgspec.DecodeError: It is not MessagePack.
    """
    if isinstance(raw, str) or len(raw) > MAX_MESSAGE_SIZE:
        raise ValueError("the message is text or too long")
    message = msgspec.msgpack.decode(raw)
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise ValueError("the message has no type")
    kind = message["type"]
    if kind == "GuiUpdateMessage":  # viser would set any attribute that is named here
        updates = message.get("updates")
        if not isinstance(updates, dict) or set(updates) != {"value"}:
            raise ValueError("the message must update the value of a control")
        value = updates["value"]
        if not _is_scalar(value):
            raise ValueError("the value of a control must be a finite number, text or a boolean")
        handle = control(str(message.get("uuid")))
        if handle is not None and not is_valid_for(handle._impl, value):
            return INVALID_VALUE
    if kind == "ViewerCameraMessage":
        vectors: list[Any] = [message.get(name) for name in CAMERA_VECTORS]
        lengths = [len(vector) if isinstance(vector, list) else 0 for vector in vectors]
        if lengths != list(CAMERA_VECTORS.values()):
            raise ValueError("a camera has three vectors and a quaternion")
        numbers = [*chain.from_iterable(vectors), *(message.get(name) for name in CAMERA_NUMBERS)]
        if not all(isinstance(value, int | float) and isfinite(value) for value in numbers):
            raise ValueError("a camera must hold finite numbers")
    return kind


def is_valid_for(control: Any, value: Any) -> bool:
    """Return whether a control accepts a value; viser would convert any text to True and click a button."""
    options = getattr(control.props, "options", None)
    if options is not None:
        return value in options
    if isinstance(control.value, bool):
        return isinstance(value, bool)
    if isinstance(control.value, int | float):
        if isinstance(value, bool | str):
            return False
        low, high, step = (getattr(control.props, name, None) for name in ("min", "max", "step"))
        tolerance = step or 0.0  # clients round to steps
        return (low is None or value >= low - tolerance) and (high is None or value <= high + tolerance)
    return isinstance(value, type(control.value))


def _is_scalar(value: Any) -> bool:
    return isinstance(value, bool | int | str) or (isinstance(value, float) and isfinite(value))
