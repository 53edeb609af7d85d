"""Drive an arm in another process: a server beside the robot, a client that is a Robot like any other.

python examples/08_network_robot.py             both processes, with the simulated cell in place of a real arm
python examples/08_network_robot.py serve       the server alone; put your driver in the place of the cell
"""

import subprocess
import sys

import numpy as np

import nodeslam

ADDRESS = "tcp://127.0.0.1:5560"
arm = nodeslam.load_robot("panda")


def serve() -> None:
    """Beside the robot: any object with the members of Robot will do; `clock` is that of its measurements."""
    objects = nodeslam.draw_objects({"can": 1}, "test", np.random.default_rng(0))
    cell = nodeslam.World(nodeslam.CellConfig(objects, seed=1, robot=arm))
    with cell, nodeslam.RobotServer(cell, ADDRESS, clock=lambda: cell.time) as server:
        print("ready", flush=True)
        server.run()


def pack() -> None:
    """Beside the planner: scan, reconstruct, plan, execute; a fault stops the robot and raises the reason."""
    with nodeslam.RemoteRobot(arm.description, ADDRESS) as robot:
        scanner = nodeslam.ViewpointScanner(robot, nodeslam.Kinematics(robot.arm))
        scene = nodeslam.reconstruct(scanner.capture(nodeslam.SCAN_VIEWPOINTS[:3]))
        plan = nodeslam.plan_pack(scene.objects, nodeslam.Box(), robot.arm)
        for outcome in nodeslam.execute(plan, robot):
            print(f"{outcome.name}: {'packed' if outcome.placed else outcome.reason}")
        robot.stop("the example is over")
        try:
            robot.move_gripper(0.0)
        except nodeslam.RobotStoppedError as error:
            print(f"stopped: {error}")


if sys.argv[1:] == ["serve"]:
    serve()
else:
    with subprocess.Popen([sys.executable, __file__, "serve"], stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None and server.stdout.readline() == "ready\n"
            pack()
        finally:
            server.terminate()
