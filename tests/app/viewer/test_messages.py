"""Validation of messages and of the values of controls."""

from types import SimpleNamespace

import msgspec.msgpack
import pytest

from app.viewer.messages import INVALID_VALUE, MAX_MESSAGE_SIZE, check_message, is_valid_for

CAMERA = {
    "position": [0, 0, 1], "wxyz": [1, 0, 0, 0], "look_at": [0, 0, 0], "up_direction": [0, 0, 1.0],
    "fov": 1.0, "near": 0.1, "far": 9.0, "image_height": 10, "image_width": 10,
}  # fmt: skip


def encoded(**message):
    return msgspec.msgpack.encode(message)


def control(value, **props):
    return SimpleNamespace(value=value, props=SimpleNamespace(**props))


def test_messages_of_a_page_are_valid():
    assert (
        check_message(encoded(type="GuiUpdateMessage", uuid="a", updates={"value": 2})) == "GuiUpdateMessage"
    )
    assert check_message(encoded(type="ViewerCameraMessage", **CAMERA)) == "ViewerCameraMessage"
    assert check_message(encoded(type="ShareUrlRequest")) == "ShareUrlRequest"


@pytest.mark.parametrize(
    "message",
    [
        "text",
        b"",
        b"\xc1",
        bytes(70_000),
        encoded(type=3),
        encoded(kind="GuiUpdateMessage"),
        msgspec.msgpack.encode([1, 2]),
        encoded(type="GuiUpdateMessage", uuid="a", updates={"update_cb": []}),
        encoded(type="GuiUpdateMessage", uuid="a", updates={"value": float("nan")}),
        encoded(type="GuiUpdateMessage", uuid="a", updates={"value": [1]}),
        encoded(type="ViewerCameraMessage", **CAMERA | {"position": [0, 0, float("inf")]}),
        encoded(type="ViewerCameraMessage", **CAMERA | {"look_at": None}),
        encoded(type="ViewerCameraMessage", **CAMERA | {"wxyz": []}),
        encoded(type="ViewerCameraMessage", **CAMERA | {"position": [1.0] * 1000}),
        encoded(type="ViewerCameraMessage", **CAMERA | {"fov": "wide"}),
        encoded(type="ViewerCameraMessage", **CAMERA | {"fov": float("nan")}),
    ],
)
def test_other_messages_are_refused(message):
    with pytest.raises((ValueError, msgspec.DecodeError)):
        check_message(message)


def test_the_size_of_messages_is_limited():
    fits = encoded(type="a", padding="x" * (MAX_MESSAGE_SIZE - 20))
    assert len(fits) <= MAX_MESSAGE_SIZE and check_message(fits) == "a"
    with pytest.raises(ValueError, match="text or too long"):
        check_message(encoded(type="a", padding="x" * MAX_MESSAGE_SIZE))


def test_an_update_is_checked_against_its_control():
    handles = {"a": SimpleNamespace(_impl=control(True))}

    def kind(uuid, value):
        return check_message(
            encoded(type="GuiUpdateMessage", uuid=uuid, updates={"value": value}), handles.get
        )

    assert kind("a", False) == "GuiUpdateMessage" and kind("a", "text") == INVALID_VALUE
    assert kind("b", "text") == "GuiUpdateMessage"  # unknown controls are left to viser
    with pytest.raises(ValueError, match="must update the value of a control"):
        check_message(encoded(type="GuiUpdateMessage", uuid="a", updates={"value": 1, "visible": False}))


@pytest.mark.parametrize(
    ("state", "valid", "invalid"),
    [
        (control(True), [True, False], [0, 1, "", "yes"]),
        (control(3, min=0, max=9, step=1), [0, 9, 4.5, -1, 10], ["7", True, -1.1, 10.1]),
        (control(0.5, min=None, max=None), [-1e300, 0], ["0", False]),
        (control("1x", options=("1x", "2x")), ["1x", "2x"], ["3x", 0, True]),
        (control("text"), ["", "other"], [0, True]),
    ],
)
def test_controls_accept_values_of_their_type_and_range(state, valid, invalid):
    assert [is_valid_for(state, value) for value in valid] == [True] * len(valid)
    assert [is_valid_for(state, value) for value in invalid] == [False] * len(invalid)
