"""Tells the moments of a recording from its notes; no viewer in here."""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.runs.replay import Note, Recorder
from app.viewer.snapshot import CAMERA, MAPPING, STAGE_NAMES, TCP, Believed, Moment, StageSpan

HELD_PHASES = ("grasp", "transfer", "place")
WAY_POINTS = 150  # of such a camera's way, at most
SENTENCES = {
    "scan": "The wrist camera looks at the table from several sides",
    "detect": "Every image is searched for objects; one colour is one object",
    "reconstruct": "The optimiser bends a learned shape until it explains what was seen",
    "plan": "Where everything shall go, and in which order",
    "execute": "The arm carries one object after another",
    "verify": "The camera looks again: does everything stand where it should?",
    "slam": "The camera moves; from what it sees come whole objects, and from them its own way",
    "lost": "The camera has lost its way and looks for objects that it knows",
}


ACTIONS = {
    "plan": "How to take {}?",
    "approach": "The hand reaches for {}; grey are the grasps that were weighed",
    "grasp": "The hand closes on {}",
    "transfer": "The arm carries {} along the blue path",
    "place": "The hand lets go of {}",
    "retreat": "The hand withdraws from {}",
    "placed": "{} is where it shall be",
    "retry": "{} slipped away",
    "deferred": "{} has to wait",
    "failed": "{} is left",
}


class Story:
    """Tells the moments of a recording, which may still grow."""

    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder
        self._told = 0  # notes that the present chapter holds
        self._chapter = _Chapter()
        self._points = np.zeros((0, 3))

    @property
    def end(self) -> float:
        """Show time of the last thing recorded so far in [s]."""
        return self.recorder.now

    @property
    def stages(self) -> list[StageSpan]:
        """The stages so far."""
        spans: list[StageSpan] = []
        for note in list(self.recorder.notes):
            if note.kind == "stage":
                spans.append(StageSpan(note.data["name"], note.time))
            elif note.kind == "done" and spans:
                spans[-1] = replace(spans[-1], end=note.time, seconds=note.data["seconds"])
        return spans

    def at(self, time: float) -> Moment:
        """What there is to see at a show time in [s]."""
        notes = self.recorder.notes
        count = bisect.bisect_right(notes, time, key=lambda note: note.time)
        if count < self._told:
            self._told, self._chapter = 0, _Chapter()
        for note in notes[self._told : count]:
            self._chapter.tell(note, self.recorder)
        self._told = count
        moment = self._chapter.moment(time, self._poses(time), self.recorder.bodies)
        way = self._way(bisect.bisect_right(self.recorder.show_times, time))
        return moment if way is None else replace(moment, path=way)

    @property
    def stage_titles(self) -> dict[str, str]:
        """By name, the stages that there are, and of a task that still goes on, those to come."""
        there = {span.name: span.title for span in self.stages}
        if TCP in self.recorder.bodies or not there:
            return STAGE_NAMES
        return there

    def _way(self, count: int) -> Float[np.ndarray, "n 3"] | None:
        """Where the camera has been in [m], where nothing else moves; the same array until it is longer."""
        if TCP in self.recorder.bodies or CAMERA not in self.recorder.bodies:
            return None
        row = self.recorder.bodies.index(CAMERA)
        step = max(1, len(self.recorder.poses) // WAY_POINTS)
        if len(self._points) != count // step:
            self._points = np.array(
                [pose[row, :3] for pose in self.recorder.poses[:count:step]][: count // step]
            )
        return self._points if len(self._points) > 1 else None

    def residuals(self, object_id: int, until: float) -> tuple[list[int], list[float]]:
        """The fit of an object so far: iterations, and residuals in [m]."""
        fits = [
            note.data
            for note in list(self.recorder.notes)
            if note.kind == "fit" and note.data["id"] == object_id and note.time <= until
        ]
        fits = [fit for fit in fits if fit["residual"] is not None]
        return [fit["iteration"] for fit in fits], [fit["residual"] for fit in fits]

    def _poses(self, time: float) -> Float[np.ndarray, "b 7"]:
        times = self.recorder.show_times
        if not times:
            return np.zeros((0, 7))
        index = min(max(bisect.bisect_right(times, time) - 1, 0), len(self.recorder.poses) - 1)
        return self.recorder.poses[index]


@dataclass
class _Chapter:
    """What the notes told so far add up to."""

    stage: str = ""
    caption: str = ""
    n_frames: int = 0
    n_found: int = 0
    objects: dict[int, Believed] = field(default_factory=dict)
    T_world_stand: dict[str, np.ndarray] = field(default_factory=dict)  # at first
    goals: dict[str, np.ndarray] = field(default_factory=dict)
    action: Mapping[str, Any] = field(default_factory=dict)
    approach: Mapping[str, Any] = field(default_factory=dict)
    path: np.ndarray | None = None
    carried: dict[str, np.ndarray] = field(default_factory=dict)  # T_stand_object, by name

    def tell(self, note: Note, recorder: Recorder) -> None:
        data = note.data
        if note.kind == "stage":
            self.stage, self.caption = data["name"], SENTENCES.get(data["name"], "")
            self.action, self.path = {}, None
        elif note.kind == "look":
            self.n_frames = data["index"] + 1
            if self.stage in MAPPING:  # searched as it was taken
                self.n_found = self.n_frames
        elif note.kind == "found":
            self.n_found = data["index"] + 1
        elif note.kind == "fit":
            self.objects[data["id"]] = _fitted(data)
        elif note.kind == "objects":
            self.objects = {
                estimate.id: Believed(
                    estimate.id, estimate.category, None, estimate.T_world_object, estimate.scale,
                    np.asarray(estimate.code, dtype=np.float64), estimate.residual, "reconstructed",
                )
                for estimate in recorder.objects
            }  # fmt: skip
        elif note.kind == "plan":
            self._plan(data)
        elif note.kind == "path":
            self.path = np.asarray(data["points"], dtype=np.float64)
        elif note.kind == "action":
            self._act(data)

    def _plan(self, plan: Mapping[str, Any]) -> None:
        for placement in plan["placements"]:
            name = placement["name"]
            self.T_world_stand[name] = np.asarray(placement["T_world_stand"], dtype=np.float64)
            yaw = placement["yaws"][0] if placement["yaws"] else 0.0
            self.goals[name] = _upright(yaw, placement["position"])
        for name, reason in plan["left_out"].items():
            self._set(name, status="left", reason=reason)

    def _act(self, action: Mapping[str, Any]) -> None:
        name, phase = action["name"], action["phase"]
        self.action = action
        self.caption = _sentence(action)
        if phase == "approach":
            self.approach = action
            self._set(name, status="next")
        elif phase in HELD_PHASES:
            self._set(name, status="in the hand")
        elif phase in ("retreat", "placed"):
            rest = self.approach.get("T_world_stand_rest")
            if phase == "retreat" and rest is not None:
                self._set(name, T_world_object=np.asarray(rest) @ self._in_stand(name))
            self._set(name, status="put down")
            self.goals.pop(name, None)
        elif phase in ("failed", "deferred", "retry"):
            self._set(name, status="left", reason=action["message"])
        if phase not in ("plan", "approach", *HELD_PHASES):
            self.path = None

    def _set(self, name: str, **changes: Any) -> None:
        for number, believed in self.objects.items():
            if believed.name == name:
                self.objects[number] = replace(believed, **changes)

    def _in_stand(self, name: str) -> Float[np.ndarray, "4 4"]:
        """T_stand_object: remembered from where it stood when the plan was made."""
        if name not in self.carried:
            found = [one for one in self.objects.values() if one.name == name]
            T_world_stand = self.T_world_stand.get(name)
            if not found or T_world_stand is None:
                return np.eye(4)
            self.carried[name] = np.linalg.inv(T_world_stand) @ found[0].T_world_object
        return self.carried[name]

    def moment(self, time: float, poses: np.ndarray, bodies: Sequence[str]) -> Moment:
        objects = dict(self.objects)
        phase, name = self.action.get("phase"), self.action.get("name", "")
        T_stand_tcp = self.approach.get("T_stand_tcp")
        if phase in HELD_PHASES and T_stand_tcp is not None and TCP in bodies:
            T_world_tcp = matrix(poses[list(bodies).index(TCP)])
            T_world_stand = T_world_tcp @ np.linalg.inv(np.asarray(T_stand_tcp))
            for number, believed in objects.items():
                if believed.name == name:
                    T = T_world_stand @ self._in_stand(name)
                    objects[number] = replace(believed, T_world_object=T)
        grasps = None
        if phase == "approach" and self.approach.get("grasps") and name in self.T_world_stand:
            every = [self.approach["T_stand_tcp"], *self.approach["grasps"]]
            grasps = self.T_world_stand[name] @ np.asarray(every, dtype=np.float64)
        return Moment(
            time=time,
            stage=self.stage,
            caption=self.caption,
            poses=poses,
            n_frames=self.n_frames,
            n_found=self.n_found,
            objects=objects,
            placements={
                goal: T @ self._in_stand(goal) for goal, T in self.goals.items() if self.stage != "verify"
            },
            path=self.path,
            grasps=grasps,
        )


def _sentence(action: Mapping[str, Any]) -> str:
    sentence = ACTIONS.get(action["phase"], f"{action['phase']} {{}}").format(
        action["name"].replace("_", " ")
    )
    return f"{sentence}: {action['message']}" if action["message"] else sentence


def matrix(pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 4"]:
    """The transform of a position and a quaternion wxyz."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(pose[3:], scalar_first=True).as_matrix()
    T[:3, 3] = pose[:3]
    return T


def _upright(yaw: float, position: Sequence[float]) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = position
    return T


def _fitted(data: Mapping[str, Any]) -> Believed:
    return Believed(
        id=data["id"],
        category=data["category"],
        iteration=data["iteration"],
        T_world_object=np.asarray(data["T_world_object"], dtype=np.float64),
        scale=np.asarray(data["scale"], dtype=np.float64),
        code=np.asarray(data["code"], dtype=np.float64),
        residual=data["residual"],
    )
