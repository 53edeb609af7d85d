"""State of a run, accumulated from the notes of its recording in order of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from app.runs.replay import Note, Recorder
from app.viewer.captions import action_caption, stage_caption
from app.viewer.snapshot import SLAM_STAGES, TCP, ObjectState, Snapshot, pose_matrix
from perception.geometry import pose_from_yaw
from perception.types import ObjectEstimate

HELD_PHASES = ("grasp", "transfer", "place")  # phases in which the object moves with the gripper


@dataclass
class RunState:
    """The accumulated effect of the notes applied so far.

    Attributes:
        stage, caption: Current stage and its caption.
        n_frames, n_searched: Numbers of images captured, and searched for objects.
        objects: Object states by id.
        obstacles: Vertices of the convex pieces of each thing of no class by name, in metres.
        Ts_world_stand: Frames on the support below the objects when the plan was made, by object name.
        goals: Goal poses T_world_stand of the plan by object name.
        action: Data of the latest ``action`` note of the stage; empty before the first.
        approach: Data of the latest approach.
        path: (n, 3) planned path of the tool in metres while it is followed.
        Ts_stand_object: Object poses in those frames, by object name.
    """

    stage: str = ""
    caption: str = ""
    n_frames: int = 0
    n_searched: int = 0
    objects: dict[int, ObjectState] = field(default_factory=dict)
    obstacles: dict[str, tuple[Float[np.ndarray, "_k 3"], ...]] = field(default_factory=dict)
    Ts_world_stand: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    goals: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    action: Mapping[str, Any] = field(default_factory=dict)
    approach: Mapping[str, Any] = field(default_factory=dict)
    path: Float[np.ndarray, "n 3"] | None = None
    Ts_stand_object: dict[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)

    def apply(self, note: Note, recorder: Recorder) -> None:
        """Advance the state by one note of the recording."""
        data = note.data
        if note.kind == "stage":
            self.stage, self.caption = data["name"], stage_caption(data["name"])
            self.action, self.path = {}, None
        elif note.kind == "look":
            self.n_frames = data["index"] + 1
            if self.stage in SLAM_STAGES:  # keyframes are searched when they are captured
                self.n_searched = self.n_frames
        elif note.kind == "found":
            self.n_searched = data["index"] + 1
        elif note.kind == "fit":
            self.objects[data["id"]] = _fitted_state(data)
        elif note.kind == "objects":
            placed = {id: state for id, state in self.objects.items() if state.status == "placed"}
            found = {estimate.id: _reconstructed_state(estimate) for estimate in recorder.objects}
            # The map of a further round has those too that were placed before.
            self.objects = {id: placed.get(id, state) for id, state in found.items()}
        elif note.kind == "obstacles":
            self.obstacles = {name: _vertices(pieces) for name, pieces in data["pieces"].items()}
        elif note.kind == "plan":
            self._apply_plan(data)
        elif note.kind == "path":
            self.path = np.asarray(data["points"], dtype=np.float64)
        elif note.kind == "action":
            self._apply_action(data)

    def snapshot(self, time: float, poses: Float[np.ndarray, "b 7"], bodies: Sequence[str]) -> Snapshot:
        """Return the snapshot at a show time [s] with the given poses of the bodies."""
        objects = dict(self.objects)
        phase, name = self.action.get("phase"), self.action.get("name", "")
        T_stand_tcp = self.approach.get("T_stand_tcp")
        if phase in HELD_PHASES and T_stand_tcp is not None and TCP in bodies:
            T_world_tcp = pose_matrix(poses[list(bodies).index(TCP)])
            T_world_stand = T_world_tcp @ np.linalg.inv(np.asarray(T_stand_tcp))
            for id, state in objects.items():
                if state.name == name:
                    T_world_object = T_world_stand @ self._T_stand_object(name)
                    objects[id] = replace(state, T_world_object=T_world_object)
        grasps = None
        if phase == "approach" and self.approach.get("grasps") and name in self.Ts_world_stand:
            Ts_stand_tcp = [self.approach["T_stand_tcp"], *self.approach["grasps"]]
            grasps = self.Ts_world_stand[name] @ np.asarray(Ts_stand_tcp, dtype=np.float64)
        goals = {} if self.stage == "verify" else self.goals
        return Snapshot(
            time=time,
            stage=self.stage,
            caption=self.caption,
            poses=poses,
            n_frames=self.n_frames,
            n_searched=self.n_searched,
            objects=objects,
            obstacles=self.obstacles,
            goals={goal: T_world_stand @ self._T_stand_object(goal) for goal, T_world_stand in goals.items()},
            path=self.path,
            grasps=grasps,
        )

    def _apply_plan(self, plan: Mapping[str, Any]) -> None:
        placed = {state.name for state in self.objects.values() if state.status == "placed"}
        for placement in plan["placements"]:
            name = placement["name"]
            if name in placed:
                continue
            self.Ts_world_stand[name] = np.asarray(placement["T_world_stand"], dtype=np.float64)
            yaw = placement["yaws"][0] if placement["yaws"] else 0.0
            self.goals[name] = pose_from_yaw(float(yaw), np.asarray(placement["position"], dtype=np.float64))
        for name, reason in plan["left_out"].items():
            self._update_object(name, status="not placed", reason=reason)

    def _apply_action(self, action: Mapping[str, Any]) -> None:
        name, phase = action["name"], action["phase"]
        self.action = action
        self.caption = action_caption(action)
        if phase == "approach":
            self.approach = action
            self._update_object(name, status="next")
        elif phase in HELD_PHASES:
            self._update_object(name, status="held")
        elif phase in ("retreat", "placed"):
            T_world_stand = self.approach.get("T_world_stand_rest")
            if phase == "retreat" and T_world_stand is not None:
                T_world_object = np.asarray(T_world_stand) @ self._T_stand_object(name)
                self._update_object(name, T_world_object=T_world_object)
            self._update_object(name, status="placed")
            self.goals.pop(name, None)
        elif phase in ("failed", "deferred", "retry"):
            self._update_object(name, status="not placed", reason=action["message"])
        if phase not in ("plan", "approach", *HELD_PHASES):
            self.path = None

    def _update_object(self, name: str, **changes: Any) -> None:
        for id, state in self.objects.items():
            if state.name == name:
                self.objects[id] = replace(state, **changes)

    def _T_stand_object(self, name: str) -> Float[np.ndarray, "4 4"]:
        """Return an object's pose in its frame on the support, computed once, before the object moves."""
        if name not in self.Ts_stand_object:
            found = [state for state in self.objects.values() if state.name == name]
            T_world_stand = self.Ts_world_stand.get(name)
            if not found or T_world_stand is None:
                return np.eye(4)
            self.Ts_stand_object[name] = np.linalg.inv(T_world_stand) @ found[0].T_world_object
        return self.Ts_stand_object[name]


def _vertices(pieces: Sequence[Any]) -> tuple[Float[np.ndarray, "_k 3"], ...]:
    return tuple(np.asarray(piece, dtype=np.float64) for piece in pieces)


def _fitted_state(fit: Mapping[str, Any]) -> ObjectState:
    """Return the object state of a ``fit`` note."""
    return ObjectState(
        id=fit["id"],
        category=fit["category"],
        iteration=fit["iteration"],
        T_world_object=np.asarray(fit["T_world_object"], dtype=np.float64),
        scale=np.asarray(fit["scale"], dtype=np.float64),
        code=np.asarray(fit["code"], dtype=np.float64),
        residual=fit["residual"],
    )


def _reconstructed_state(estimate: ObjectEstimate) -> ObjectState:
    """Return the object state of an entry of the object map."""
    return ObjectState(
        id=estimate.id,
        category=estimate.category,
        iteration=None,
        T_world_object=estimate.T_world_object,
        scale=estimate.scale,
        code=np.asarray(estimate.code, dtype=np.float64),
        residual=estimate.residual,
        status="reconstructed",
    )
