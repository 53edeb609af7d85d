"""``nodeslam serve``: the simulated cell behind the network protocol of robots, in place of a real one."""

from __future__ import annotations

from rich.markup import escape

from app.errors import UsageError
from app.options import ServeOptions
from app.runs.report import Report
from app.screen import Screen
from app.task.cell import build_world
from app.task.restricted_robot import restricted
from manipulation.errors import RobotError
from manipulation.remote.server import RobotServer, check_usable


def run(options: ServeOptions, screen: Screen) -> Report:
    """Build a cell and serve its robot until the process is interrupted.

    Raises:
        UsageError: the address cannot be used.
    """
    try:
        check_usable(options.address)  # before the cell is built, which takes seconds
    except RobotError as error:
        raise UsageError(f"--address {error}") from None
    with screen.stage("Building the cell"):
        world = build_world(options, options.task)
    with world, RobotServer(restricted(world), options.address, clock=lambda: world.time) as server:
        screen.show(escape(f"robot at {server.address}; Ctrl-C ends it"))
        server.run()
    return Report("serve", options.seed, success=True)
