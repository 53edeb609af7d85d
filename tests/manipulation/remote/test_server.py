"""The server against clients that are not ours: damaged messages, second clients, clients that disappear."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import zmq

from manipulation.errors import RobotError, RobotStoppedError
from manipulation.remote import messages as m
from manipulation.remote.client import RemoteRobot
from manipulation.remote.server import RobotServer, check_usable
from tests.manipulation.remote.conftest import QUICK, FakeRobot, a_move, serving


class Raw:
    """A socket without the client's care."""

    def __init__(self, address):
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.connect(address)

    def send(self, data):
        self.socket.send(data)

    def ask(self, command, number=1):
        self.send(m.encode(m.Request(number, command)))
        return self.receive()

    def receive(self):
        assert self.socket.poll(2000), "no answer"
        return m.decode_reply(self.socket.recv())

    def close(self):
        self.context.destroy(linger=0)


@pytest.fixture
def raw(served):
    raw = Raw(served.address)
    yield raw
    raw.close()


def wait_for(condition, seconds=4.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    assert condition()


def test_it_listens_on_the_loopback_interface_alone(robot):
    with RobotServer(robot, "tcp://127.0.0.1:0") as server:
        assert server.address.startswith("tcp://127.0.0.1:")


def test_an_address_is_usable_until_a_server_has_it(robot, tmp_path):
    with RobotServer(robot, f"ipc://{tmp_path}/robot") as server:
        check_usable("tcp://127.0.0.1:0")
        with RobotServer(robot, "tcp://127.0.0.1:0") as other, pytest.raises(RobotError, match="in use"):
            check_usable(other.address)
        with pytest.raises(RobotError, match="is no address"):
            check_usable("udp://127.0.0.1:1")
        assert server.address == f"ipc://{tmp_path}/robot"


def test_any_bytes_are_refused_and_the_server_goes_on(raw, robot):
    rng = np.random.default_rng(0)
    whole = m.encode(m.Request(1, m.Follow.of(a_move(robot.arm))))
    assert isinstance(raw.ask(m.Hello()).answer, m.Welcome)
    for length in rng.integers(0, 300, 100):
        for data in (rng.bytes(length), whole[:length] + rng.bytes(8)):
            raw.send(data)
            assert isinstance(raw.receive().answer, m.Refused)
    assert isinstance(raw.ask(m.Hello()).answer, m.Welcome)
    assert robot.calls == []


def test_commands_without_hello_and_of_other_versions_are_refused(raw, robot):
    assert "Hello is missing" in raw.ask(m.MoveGripper(0.01)).answer.reason
    assert "version 99" in raw.ask(m.Hello(99)).answer.reason
    assert robot.calls == []


def test_one_client_at_a_time(raw, client, robot):
    assert "another client has the robot" in raw.ask(m.Hello()).answer.reason
    assert "another client" in raw.ask(m.MoveGripper(0.01)).answer.reason
    client.close()  # its farewell and the next greeting arrive in any order
    wait_for(lambda: isinstance(raw.ask(m.Hello()).answer, m.Welcome))
    raw.close()
    assert robot.calls == []


def test_anyone_may_stop(raw, client, robot):
    assert isinstance(raw.ask(m.Stop("a person is near")).answer, m.Done)
    assert robot.stopped == "a person is near"


def test_stop_is_answered_during_a_motion(arm):
    slow = FakeRobot(arm, seconds=30)
    with serving(slow) as server, RemoteRobot(arm, server.address, config=QUICK) as client:
        raw = Raw(server.address)
        threading.Timer(0.3, lambda: raw.send(m.encode(m.Request(1, m.Stop("a person is near"))))).start()
        begin = time.monotonic()
        with pytest.raises(RobotStoppedError, match="a person is near"):
            client.follow(a_move(arm))
        assert time.monotonic() - begin < 3
        raw.close()


def test_a_client_that_disappears_during_a_motion_stops_the_robot(arm):
    slow = FakeRobot(arm, seconds=30)
    with serving(slow) as server:
        raw = Raw(server.address)
        raw.ask(m.Hello())
        raw.send(m.encode(m.Request(2, m.Follow.of(a_move(arm)))))
        wait_for(lambda: "follow" in slow.calls)
        raw.close()  # without a word
        wait_for(lambda: bool(slow.stopped))
        assert slow.stopped == "its client has disappeared"


def test_a_client_that_leaves_during_a_motion_stops_the_robot(arm):
    slow = FakeRobot(arm, seconds=30)
    with serving(slow) as server:
        raw = Raw(server.address)
        raw.ask(m.Hello())
        raw.send(m.encode(m.Request(2, m.Follow.of(a_move(arm)))))
        raw.send(m.encode(m.Request(3, m.Bye())))
        wait_for(lambda: bool(slow.stopped))
        assert slow.stopped == "its client has left during a command"
        raw.close()


def test_a_second_command_during_one_is_refused(arm):
    slow = FakeRobot(arm, seconds=0.5)
    with serving(slow) as server:
        raw = Raw(server.address)
        raw.ask(m.Hello())
        raw.send(m.encode(m.Request(2, m.Follow.of(a_move(arm)))))
        wait_for(lambda: slow.calls == ["follow"])
        raw.send(m.encode(m.Request(3, m.MoveGripper(0.0))))
        answers = {}
        while 2 not in answers:
            reply = raw.receive()
            if not isinstance(reply.answer, m.Busy):
                answers[reply.number] = reply.answer
        assert answers[3].reason == "a command is being carried out"
        assert isinstance(answers[2], m.State) and slow.calls == ["follow"]
        raw.close()


def test_limits_hold_whatever_the_client_sends(client, robot):
    move = a_move(robot.arm)
    with pytest.raises(RobotError, match="too fast for joint1"):
        client.follow(replace(move, velocities=move.velocities * 30))
    with pytest.raises(RobotError, match=r"leaves by .* the range of joint4"):
        client.follow(a_move(robot.arm, joint=3, angle=2.6, samples=601))
    with pytest.raises(RobotError, match="not finite"):
        client.follow(replace(move, positions=np.full_like(move.positions, np.nan)))
    assert robot.calls == []


def test_an_address_in_use_is_named(robot, served):
    with pytest.raises(RobotError, match="Address already in use"):
        RobotServer(robot, served.address)
    with pytest.raises(RobotError, match="is no address"):
        RobotServer(robot, "inproc://robot")
