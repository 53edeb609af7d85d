"""Records a run in the simulated cell for viewers: motion, images, intermediate results.

The true poses of the objects come from ``scoring``: they are shown to people and never reach the pipeline.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.runs.replay import NoteKind, Recorder
from app.task.run_observer import RunObserver, Stage
from app.task.scoring import read_truth
from manipulation.execution import TaskEvent
from manipulation.kinematics import Kinematics
from manipulation.types import PickPlacePlan, TaskPlan
from perception.inference.optimisation import FitStep
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import Category, ObjectEstimate, RgbdFrame
from sim_assets.cell import viewer_meshes
from sim_assets.cell.world import World

PATH_POINTS = 16  # points drawn of each motion of a planned path
RATE = 30.0  # samples per simulated second


class CellRecorder(RunObserver):
    """Fills a ``Recorder`` from a simulated cell.

    Attributes:
        world: Simulated cell.
        recorder: The recording.
    """

    def __init__(self, world: World) -> None:
        super().__init__()
        self.world = world
        self._kinematics = Kinematics(world.arm)
        self._lock = threading.Lock()  # fits report their steps from several threads
        truth = read_truth(world)
        objects = [f"object{number}" for number in truth.models]
        objects += [f"unknown{number}" for number in truth.unknown]
        self.recorder = Recorder(
            bodies=(*viewer_meshes.moving_bodies(world), *objects), meshes=viewer_meshes.body_meshes(world)
        )
        self.sample()

    def sample(self) -> None:
        """Append the current poses."""
        world = self.world
        truth = read_truth(world)
        free = (*truth.poses.values(), *truth.unknown.values())
        poses = np.concatenate([viewer_meshes.poses(world), _positions_wxyz(free)])
        with self._lock:
            self.recorder.sample(world.time, world.joint_positions(), world.gripper_width(), poses)

    def begin_stage(self, stage: Stage) -> None:
        self._note("stage", name=stage)

    def end_stage(self, stage: Stage, seconds: float) -> None:
        self._note("done", name=stage, seconds=round(seconds, 2))

    def on_image(self, frame: RgbdFrame) -> None:
        self.sample()
        self.recorder.frames.append(frame)
        self._note("look", index=len(self.recorder.frames) - 1)

    def on_fit_step(self, object_id: int, category: Category, step: FitStep) -> None:
        self._note(
            "fit",
            id=object_id,
            category=category,
            iteration=step.iteration,
            code=step.code,
            T_world_object=step.pose.T_world_object,
            scale=step.pose.scale,
            residual=step.residual if np.isfinite(step.residual) else None,
        )

    def on_event(self, event: TaskEvent) -> None:
        details: dict[str, Any] = {}
        if event.plan is not None:
            plan = event.plan
            details = {
                "T_stand_tcp": plan.grasp.T_stand_tcp,
                "T_world_stand_rest": plan.T_world_stand_rest,
                "grasps": [grasp.T_stand_tcp for grasp in event.candidates],
            }
            self._note("path", name=plan.name, points=self._path(plan))
        counts = {"done": event.done, "total": event.total}
        self._note("action", phase=event.phase, name=event.name, message=event.message, **counts, **details)

    def on_detections(self, detections: Detections) -> None:
        self.recorder.detections = detections.per_frame
        for index, found in enumerate(detections.per_frame):
            self._note("found", index=index, count=len(found))

    def on_objects(self, objects: Sequence[ObjectEstimate]) -> None:
        self.recorder.objects = tuple(objects)
        self._note("objects", covariances=_covariances(objects))

    def on_obstacles(self, obstacles: Sequence[PerceivedObstacle]) -> None:
        self._note("obstacles", pieces={obstacle.name: list(obstacle.pieces) for obstacle in obstacles})

    def on_plan(self, plan: TaskPlan) -> None:
        self._note("plan", placements=_placements(plan), left_out=dict(plan.left_out))

    def _note(self, kind: NoteKind, **data: Any) -> None:
        with self._lock:
            self.recorder.note(kind, **data)

    def _path(self, plan: PickPlacePlan) -> Float[np.ndarray, "n 3"]:
        """Return points of the tool's path, in metres."""
        points = []
        for motion in (plan.transit, plan.approach, plan.lift, plan.carry, plan.lowering, plan.retreat):
            if motion is None:
                continue
            rows = np.linspace(0, len(motion.positions) - 1, PATH_POINTS).astype(int)
            points += [self._kinematics.forward(motion.positions[row])[:3, 3] for row in rows]
        return np.array(points)


def _positions_wxyz(poses: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "n 7"]:
    if not poses:
        return np.zeros((0, 7))
    T = np.array(poses)
    rotations = Rotation.from_matrix(T[:, :3, :3])
    return np.concatenate([T[:, :3, 3], rotations.as_quat(scalar_first=True)], axis=1)


def _covariances(estimates: Sequence[ObjectEstimate]) -> dict[str, Any]:
    """Return the upper triangles of the covariances by object id."""
    upper = np.triu_indices(25)
    return {
        str(estimate.id): [float(f"{value:.3g}") for value in estimate.covariance[upper]]
        for estimate in estimates
        if estimate.covariance is not None
    }


def _placements(plan: TaskPlan) -> list[dict[str, Any]]:
    return [
        {
            "name": placement.name,
            "T_world_stand": plan.objects[placement.name].T_world_stand,
            "position": placement.position,
            "yaws": placement.yaws,
            "stack": placement.stack,
        }
        for placement in plan.placements
    ]
