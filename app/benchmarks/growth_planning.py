"""Planning of packing tasks over the number of objects, from reconstructed shapes, with the arm at rest."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from app.options import TaskOptions
from app.task.cell import build_world
from app.task.episode import request_of
from app.task.pipeline import run as run_pipeline
from app.task.restricted_robot import restricted
from manipulation.errors import NoPlanError
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import plan_pack
from manipulation.types import Box
from perception.pipeline import Perception


@dataclass(frozen=True)
class PlanningTimes:
    """Processor times of planning a task.

    Attributes:
        layout: Of the layout in the box with all grasp candidates, in seconds.
        objects: Of all motions of each object, in seconds, whether there is a plan or not.
    """

    layout: float
    objects: tuple[float, ...]


def planning_times(networks: Perception, n_objects: int, seed: int) -> PlanningTimes:
    """Scan and reconstruct the objects of a cell, then plan to pack them one after the other.

    Objects without a plan stay where they are; with least effort, others are not tried again.
    """
    options = TaskOptions(objects=str(n_objects), seed=seed)
    with build_world(options, "pack") as world:
        request = replace(request_of(world, "pack", options), perceive_only=True)
        objects = run_pipeline(restricted(world), networks, request).objects
        arm, box = world.arm, request.box or Box()
    kinematics = Kinematics(arm, request.manipulation.pick_place.ik)
    settings = request.workspace.adapted(request.manipulation).for_arm(arm)
    begin = time.process_time()
    plan = plan_pack(objects, box, arm, settings, kinematics)
    layout = time.process_time() - begin
    obstacles = (TABLE, *box_obstacles(box))
    planner = PickPlacePlanner(kinematics, plan.objects, obstacles, settings.pick_place, plan.grasps)
    q, seconds = np.asarray(arm.q_home, dtype=np.float64), []
    for placement in plan.placements:
        begin = time.process_time()
        try:
            motions = planner.plan(placement, q)
        except NoPlanError:
            motions = None
        seconds.append(time.process_time() - begin)
        if motions is not None:
            planner.scene.moved(placement.name, motions.T_world_stand_rest)
            q = motions.retreat.positions[-1]
    return PlanningTimes(layout, tuple(seconds))
