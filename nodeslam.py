"""NodeSLAM: complete object shapes and poses from RGB-D images, and an arm that packs and sorts the objects.

Reconstruct one image, given as numpy arrays, and compute grasps for your own planner::

    import cv2
    import nodeslam

    color = cv2.cvtColor(cv2.imread("rgb.png"), cv2.COLOR_BGR2RGB)  # (H, W, 3) uint8
    depth = cv2.imread("depth.png", cv2.IMREAD_UNCHANGED)  # (H, W) uint16 in mm, or float in metres
    K = [[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]]

    scene = nodeslam.reconstruct_image(color, depth, K)
    for item in scene.objects:
        print(item.name, item.T_world_object, item.mesh, item.surface_sigma)
    grasps = nodeslam.find_grasps(scene)  # best first; T_world_camera=... adds the world frame
    print(grasps[0].T_camera_tcp, grasps[0].opening)

This module is the public interface; every name is imported on first access. Conventions: metres, radians,
seconds; ``T_world_camera`` maps camera to world coordinates; cameras have x right, y down, z forward.
``python -m nodeslam`` is the command line.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from app.environments import register_environments as register_environments
    from manipulation import SCAN_VIEWPOINTS as SCAN_VIEWPOINTS
    from manipulation import ArmDescription as ArmDescription
    from manipulation import Box as Box
    from manipulation import Grasp as Grasp
    from manipulation import GraspPose as GraspPose
    from manipulation import GripperGeometry as GripperGeometry
    from manipulation import HandClearance as HandClearance
    from manipulation import HandEye as HandEye
    from manipulation import JointTrajectory as JointTrajectory
    from manipulation import Kinematics as Kinematics
    from manipulation import Line as Line
    from manipulation import ManipulationConfig as ManipulationConfig
    from manipulation import ManipulationError as ManipulationError
    from manipulation import ObjectOutcome as ObjectOutcome
    from manipulation import Placement as Placement
    from manipulation import PlanningError as PlanningError
    from manipulation import RemoteRobot as RemoteRobot
    from manipulation import Robot as Robot
    from manipulation import RobotError as RobotError
    from manipulation import RobotServer as RobotServer
    from manipulation import RobotState as RobotState
    from manipulation import RobotStoppedError as RobotStoppedError
    from manipulation import StandingObject as StandingObject
    from manipulation import TaskEvent as TaskEvent
    from manipulation import TaskPlan as TaskPlan
    from manipulation import Viewpoint as Viewpoint
    from manipulation import ViewpointScanner as ViewpointScanner
    from manipulation import execute as execute
    from manipulation import find_grasps as find_grasps
    from manipulation import plan_pack as plan_pack
    from manipulation import plan_sort as plan_sort
    from manipulation import read_hand_eye as read_hand_eye
    from manipulation import to_standing as to_standing
    from perception import CATEGORIES as CATEGORIES
    from perception import CameraIntrinsics as CameraIntrinsics
    from perception import Category as Category
    from perception import Detections as Detections
    from perception import FrameResult as FrameResult
    from perception import InvalidInputError as InvalidInputError
    from perception import LeftOut as LeftOut
    from perception import ObjectDetection as ObjectDetection
    from perception import ObjectEstimate as ObjectEstimate
    from perception import Perception as Perception
    from perception import PerceptionError as PerceptionError
    from perception import Reconstruction as Reconstruction
    from perception import RgbdFrame as RgbdFrame
    from perception import RgbdSequence as RgbdSequence
    from perception import Scan as Scan
    from perception import Slam as Slam
    from perception import SlamConfig as SlamConfig
    from perception import SupportPlane as SupportPlane
    from perception import SupportSurface as SupportSurface
    from perception import Trajectory as Trajectory
    from perception import TriangleMesh as TriangleMesh
    from perception import detect as detect
    from perception import find_surfaces as find_surfaces
    from perception import fit_support_plane as fit_support_plane
    from perception import load_perception as load_perception
    from perception import open_sequence as open_sequence
    from perception import read_object_map as read_object_map
    from perception import read_scan as read_scan
    from perception import reconstruct as reconstruct
    from perception import reconstruct_image as reconstruct_image
    from perception import reconstruct_scan as reconstruct_scan
    from perception import write_object_map as write_object_map
    from perception import write_scan as write_scan
    from perception import write_trajectory as write_trajectory
    from sim_assets.cell.config import CellConfig as CellConfig
    from sim_assets.cell.scene import BoxConfig as BoxConfig
    from sim_assets.cell.world import World as World
    from sim_assets.datasets.sequences import SequenceConfig as SequenceConfig
    from sim_assets.datasets.sequences import TableSequence as TableSequence
    from sim_assets.errors import SimAssetsError as SimAssetsError
    from sim_assets.objects import ObjectModel as ObjectModel
    from sim_assets.objects.sampling import draw_objects as draw_objects
    from sim_assets.objects.user import load_user_objects as load_user_objects
    from sim_assets.robots import load_robot as load_robot
    from sim_assets.robots.simulated_arm import SimulatedArm as SimulatedArm

    __version__: str

_MODULES = {
    # From RGB-D images to objects.
    "perception": (
        # Data: images, and what is found in them. Objects stand on support planes.
        "RgbdFrame", "CameraIntrinsics", "SupportPlane", "SupportSurface", "Category", "CATEGORIES",
        "ObjectDetection", "ObjectEstimate", "TriangleMesh", "Reconstruction",
        # Everything in one call: arrays, frames or a scan folder in, a Reconstruction out.
        "reconstruct_image", "reconstruct", "reconstruct_scan",
        # The stages one by one, and the networks that they share.
        "Perception", "load_perception", "fit_support_plane", "find_surfaces", "Detections", "detect",
        "LeftOut",
        # Object-level SLAM: Slam.load(), then process() for each frame.
        "Slam", "SlamConfig", "FrameResult",
        # Files: scan folders (BOP layout), object maps, sequences (scan folder or TUM RGB-D), trajectories.
        "Scan", "read_scan", "write_scan", "read_object_map", "write_object_map",
        "RgbdSequence", "open_sequence", "Trajectory", "write_trajectory",
        # Errors: the root, and unusable input.
        "PerceptionError", "InvalidInputError",
    ),
    # From objects to motions.
    "manipulation": (
        # Grasps for a planner of your own; no robot model is needed.
        "find_grasps", "GraspPose", "Grasp", "GripperGeometry", "HandClearance",
        # Whole tasks: plan_pack or plan_sort, then execute on a Robot (extra `sim`: mink, ruckig).
        "Box", "Line", "StandingObject", "Placement", "TaskPlan", "ManipulationConfig",
        "to_standing", "plan_pack", "plan_sort", "execute", "TaskEvent", "ObjectOutcome",
        # The robot: implement the Protocol Robot for your arm.
        "Robot", "RobotState", "ArmDescription", "JointTrajectory", "Kinematics",
        "Viewpoint", "SCAN_VIEWPOINTS", "ViewpointScanner",
        # A robot in another process (extra `remote`): its server, and the client that implements Robot.
        "RobotServer", "RemoteRobot", "HandEye", "read_hand_eye",
        # Errors: the root, an impossible plan, a command that the robot refused, a robot that has stopped.
        "ManipulationError", "PlanningError", "RobotError", "RobotStoppedError",
    ),
    # The simulated cell (extra `sim`): World implements Robot.
    "sim_assets.robots": ("load_robot",),
    "sim_assets.robots.simulated_arm": ("SimulatedArm",),
    "sim_assets.objects": ("ObjectModel",),
    "sim_assets.objects.sampling": ("draw_objects",),
    "sim_assets.objects.user": ("load_user_objects",),
    "sim_assets.cell.config": ("CellConfig",),
    "sim_assets.cell.scene": ("BoxConfig",),
    "sim_assets.cell.world": ("World",),
    "sim_assets.datasets.sequences": ("TableSequence", "SequenceConfig"),
    "sim_assets.errors": ("SimAssetsError",),
    # The cell as Gymnasium environments nodeslam/Pack-v0 and nodeslam/Sort-v0 (extra `gym`).
    "app.environments": ("register_environments",),
}  # fmt: skip
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = ["__version__", *_MODULE_OF]  # pyright: ignore[reportUnsupportedDunderAll]

_FOLDER = Path(__file__).resolve().parent


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("nodeslam")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'nodeslam' has no attribute '{name}'")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return __all__


def main() -> None:
    """Run the command line."""
    # First on the path, so that a module of the caller named `app` is not mistaken for the package; child
    # processes of multiprocessing inherit the path.
    sys.path.insert(0, str(_FOLDER))
    from app.__main__ import main

    main()


def _found_at(name: str) -> str | None:
    """Return where Python finds a package: None if nowhere, empty for a folder without code."""
    spec = importlib.util.find_spec(name)
    return None if spec is None else spec.origin or ""


def _is_own(name: str) -> bool:
    """Return whether a package of this project is not hidden by a module of another one."""
    found = _found_at(name)
    return bool(found) and Path(found).resolve() == _FOLDER / name / "__init__.py"


def _refuse_foreign_packages() -> None:
    """Raise ImportError if a module of another project hides one of the packages."""
    for name in ("perception", "manipulation", "sim_assets"):
        if not _is_own(name):
            origin = _found_at(name)
            found = "missing" if origin is None else f"hidden by {origin or 'a folder of that name'}"
            raise ImportError(
                f"nodeslam's package '{name}' is {found}: rename that file, or take its folder off sys.path",
                name=name,
            )


def _register_with_gymnasium() -> None:
    """Register the environments if Gymnasium is loaded; since 1.0 it looks for no entry points by itself."""
    if sys.modules.get("gymnasium") is not None and _is_own("app"):
        from app.environments import register_environments

        register_environments()


if __name__ == "__main__":
    main()
else:
    _refuse_foreign_packages()
    _register_with_gymnasium()
