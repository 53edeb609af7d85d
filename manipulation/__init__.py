"""From an object map to motions: where objects go, how to grasp them, how to move, and how to recover.

The names below are the public interface; each is imported on first access. Read in this order: ``types`` (the
data), ``planner`` (a whole task), ``planning_scene`` (what is where), ``pick_place`` (one object),
``execution`` (carrying it out). ``robot`` is the interface to an arm, simulated or real; ``scene_grasps``
needs no arm at all.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from manipulation.errors import ManipulationError as ManipulationError
    from manipulation.errors import PlanningError as PlanningError
    from manipulation.errors import RobotError as RobotError
    from manipulation.errors import RobotStoppedError as RobotStoppedError
    from manipulation.execution import TaskEvent as TaskEvent
    from manipulation.execution import execute as execute
    from manipulation.hand_collision import HandClearance as HandClearance
    from manipulation.kinematics import Kinematics as Kinematics
    from manipulation.planner import ManipulationConfig as ManipulationConfig
    from manipulation.planner import plan_pack as plan_pack
    from manipulation.planner import plan_sort as plan_sort
    from manipulation.remote.calibration import HandEye as HandEye
    from manipulation.remote.calibration import read_hand_eye as read_hand_eye
    from manipulation.remote.client import RemoteRobot as RemoteRobot
    from manipulation.remote.server import RobotServer as RobotServer
    from manipulation.robot import ArmDescription as ArmDescription
    from manipulation.robot import GripperGeometry as GripperGeometry
    from manipulation.robot import JointTrajectory as JointTrajectory
    from manipulation.robot import Robot as Robot
    from manipulation.robot import RobotState as RobotState
    from manipulation.scene_grasps import GraspPose as GraspPose
    from manipulation.scene_grasps import find_grasps as find_grasps
    from manipulation.standing import to_standing as to_standing
    from manipulation.types import Box as Box
    from manipulation.types import Grasp as Grasp
    from manipulation.types import Line as Line
    from manipulation.types import ObjectOutcome as ObjectOutcome
    from manipulation.types import Placement as Placement
    from manipulation.types import StandingObject as StandingObject
    from manipulation.types import TaskPlan as TaskPlan
    from manipulation.viewpoints import SCAN_VIEWPOINTS as SCAN_VIEWPOINTS
    from manipulation.viewpoints import Viewpoint as Viewpoint
    from manipulation.viewpoints import ViewpointScanner as ViewpointScanner

_MODULES = {
    "manipulation.types": (
        "Box", "Grasp", "Line", "ObjectOutcome", "Placement", "StandingObject", "TaskPlan",
    ),
    "manipulation.errors": ("ManipulationError", "PlanningError", "RobotError", "RobotStoppedError"),
    "manipulation.robot": ("ArmDescription", "GripperGeometry", "JointTrajectory", "Robot", "RobotState"),
    "manipulation.remote.calibration": ("HandEye", "read_hand_eye"),
    "manipulation.remote.client": ("RemoteRobot",),
    "manipulation.remote.server": ("RobotServer",),
    "manipulation.hand_collision": ("HandClearance",),
    "manipulation.scene_grasps": ("GraspPose", "find_grasps"),
    "manipulation.standing": ("to_standing",),
    "manipulation.kinematics": ("Kinematics",),
    "manipulation.viewpoints": ("SCAN_VIEWPOINTS", "Viewpoint", "ViewpointScanner"),
    "manipulation.planner": ("ManipulationConfig", "plan_pack", "plan_sort"),
    "manipulation.execution": ("TaskEvent", "execute"),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'manipulation' has no attribute '{name}'")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
