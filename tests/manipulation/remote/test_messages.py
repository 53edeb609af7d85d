"""Messages survive the wire to the last bit; whatever breaks the schema is a RobotError."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manipulation.errors import RobotError
from manipulation.remote import messages as m
from manipulation.robot import RobotState
from tests.fuzzing import SHORT
from tests.manipulation.remote.conftest import a_move, an_image

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@SHORT
@given(q=st.lists(NUMBERS, min_size=1, max_size=m.MAX_JOINTS), time=NUMBERS, width=NUMBERS)
def test_states_are_exact(q, time, width):
    state = RobotState(time, np.array(q), width)
    reply = m.decode_reply(m.encode(m.Reply(3, m.State.of(state, time))))
    assert isinstance(reply.answer, m.State) and reply.number == 3
    received = reply.answer.state()
    assert (received.time, received.gripper_width) == (time, width)
    np.testing.assert_array_equal(received.positions, state.positions)


def test_trajectories_are_exact(arm):
    sent = a_move(arm)
    request = m.decode_request(m.encode(m.Request(1, m.Follow.of(sent, 0.04))))
    assert request.command.opening == 0.04 and m.Follow.of(sent).opening is None
    received = request.command.trajectory()
    assert received.period == sent.period
    for name in ("positions", "velocities", "accelerations"):
        np.testing.assert_array_equal(getattr(received, name), getattr(sent, name))


def test_images_are_exact():
    sent, state = an_image(2.0), m.State(2.0, 2.0, [0.0], 0.0)
    received = m.decode_reply(m.encode(m.Reply(1, m.Image.of(sent, state)))).answer.frame()
    for name in ("rgb", "depth", "T_world_camera"):
        np.testing.assert_array_equal(getattr(received, name), getattr(sent, name))


def test_images_of_another_size_than_their_bytes_are_refused():
    image = msgspec.structs.replace(m.Image.of(an_image(0.0), m.State(0.0, 0.0, [0.0], 0.0)), width=17)
    with pytest.raises(RobotError, match="576 bytes of colour and 768 of depth for 17x12 pixels"):
        image.frame()


def test_samples_of_different_lengths_are_refused():
    follow = m.Follow(0.01, [[0.0, 1.0]], [[0.0]], [[0.0, 1.0]])
    with pytest.raises(RobotError, match="differ in shape"):
        follow.trajectory()


@pytest.mark.parametrize(
    "request_",
    [
        {"number": -1, "command": {"type": "Bye"}},
        {"number": 1, "command": {"type": "Reboot"}},
        {"number": 1, "command": {"type": "MoveGripper", "width": -0.1}},
        {"number": 1, "command": {"type": "Follow", "period": 0.1, "positions": [[0.0]],
                                  "velocities": [[0.0]], "accelerations": [[0.0]], "opening": 1.1}},
        {"number": 1, "command": {"type": "MoveGripper", "width": float("nan")}},
        {"number": 1, "command": {"type": "MoveGripper", "width": 0.1, "force": 1e9}},
        {"number": 1, "command": {"type": "Stop", "reason": "x" * 2000}},
        {"number": 1, "command": {"type": "Follow", "period": 0, "positions": [[0.0]]}},
        {"number": 1, "command": {"type": "Follow", "period": 0.1, "positions": [], "velocities": [],
                                  "accelerations": []}},
        {"number": 1, "command": 5},
        [],
    ],
)  # fmt: skip
def test_what_breaks_the_schema_is_refused(request_):
    with pytest.raises(RobotError, match="the message is malformed"):
        m.decode_request(msgspec.msgpack.encode(request_))


@SHORT
@given(data=st.binary(max_size=400), cut=st.integers(0, 400))
def test_damaged_bytes_are_refused_or_valid(data, cut):
    whole = m.encode(m.Reply(1, m.State(1.0, 1.0, [0.1, 0.2], 0.05)))
    for damaged in (data, whole[:cut], whole[:cut] + data):
        try:
            m.decode_reply(damaged)
        except RobotError as error:
            assert str(error).startswith("the message is malformed")


def test_deeply_nested_bytes_are_refused():
    with pytest.raises(RobotError):
        m.decode_reply(b"\x91" * 100_000)


def test_the_age_of_a_time_that_is_not_finite_is_infinite():
    assert m.State(float("nan"), 1.0, [0.0], 0.0).age == np.inf
    assert m.State(1.0, 1.25, [0.0], 0.0).age == 0.25


def test_reasons_are_shortened():
    assert len(m.refusal("x" * 5000).reason) == m.MAX_TEXT


@pytest.mark.parametrize(
    "address",
    [
        "inproc://a",
        "udp://1.2.3.4:5",
        "localhost",
        "",
        "tcp://127.0.0.1",
        "tcp://127.0.0.1:65536",
        "tcp://127.0.0.1:-1",
        "tcp://h:" + 5000 * "9",
    ],
)
def test_addresses(address):
    m.check_address("tcp://127.0.0.1:5555")
    m.check_address("tcp://127.0.0.1:65535")
    m.check_address("ipc:///run/robot")
    with pytest.raises(RobotError, match="is no address: give tcp://HOST:PORT or ipc://PATH"):
        m.check_address(address)
