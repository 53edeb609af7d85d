"""A task of your own: swap the goal positions, keep grasping, motion planning, execution and recovery.

    python examples/07_custom_task.py

Every object is placed on a circle around a point of the table, the tallest first.
"""

import numpy as np

import nodeslam

CENTRE, RADIUS = np.array([0.50, 0.27]), 0.10

objects = nodeslam.draw_objects({"can": 1, "bottle": 1}, "test", np.random.default_rng(3))
with nodeslam.World(nodeslam.CellConfig(objects, box=None, seed=3)) as robot:
    frames = nodeslam.ViewpointScanner(robot, nodeslam.Kinematics(robot.arm)).capture(
        nodeslam.SCAN_VIEWPOINTS[:3]
    )
    scene = nodeslam.reconstruct(frames)
    standing = {item.name: nodeslam.to_standing(item, scene.plane) for item in scene.objects}

    tallest_first = sorted(standing.values(), key=lambda item: -item.top)
    placements = []
    for index, item in enumerate(tallest_first):
        angle = 2 * np.pi * index / len(tallest_first)
        x, y = CENTRE + RADIUS * np.array([np.cos(angle), np.sin(angle)])
        placements.append(nodeslam.Placement(item.name, (float(x), float(y), 0.0), yaws=(0.0, np.pi / 2)))

    plan = nodeslam.TaskPlan("sort", standing, tuple(placements))
    outcomes = nodeslam.execute(plan, robot, on_event=lambda event: print(event.phase, event.name))

for outcome in outcomes:
    print(f"{outcome.name}: {'placed' if outcome.placed else outcome.reason}")
