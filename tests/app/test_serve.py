import pytest

import app.serve as serve
from app.errors import UsageError
from app.options import ServeOptions
from app.screen import Screen
from manipulation.robot import Robot
from sim_assets.cell.world import World
from sim_assets.robots import panda


def test_the_robot_of_the_cell_is_served_without_the_cell(monkeypatch, capsys):
    made = []

    class Cell(World):
        time = 2.5
        _robot = panda()

        def __init__(self):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            made.append("closed")

    class Server:
        def __init__(self, robot, address, clock):
            self.address = address
            made.append((isinstance(robot, Robot), hasattr(robot, "time"), clock()))

        __enter__, __exit__ = Cell.__enter__, Cell.__exit__

        def run(self):
            made.append("ran")

    monkeypatch.setattr(serve, "build_world", lambda options, task: made.append(task) or Cell())
    monkeypatch.setattr(serve, "RobotServer", Server)
    report = serve.run(ServeOptions(task="sort", address="tcp://127.0.0.1:0"), Screen())
    assert made == ["sort", (True, False, 2.5), "ran", "closed", "closed"] and report.success
    assert "robot at tcp://127.0.0.1:0" in capsys.readouterr().out


@pytest.mark.parametrize("address", ["nonsense", "tcp://no.such.host:1", "tcp://127.0.0.1:99999"])
def test_a_bad_address_is_refused_before_the_cell_is_built(monkeypatch, address):
    monkeypatch.setattr(serve, "build_world", lambda *_: pytest.fail("the cell was built"))
    with pytest.raises(UsageError, match=f"^--address '?{address}"):
        serve.run(ServeOptions(address=address), Screen(quiet=True))
