"""Snapshots of a recording at any show time; independent of the viewer's drawing."""

from __future__ import annotations

import bisect
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from app.runs.replay import Recorder
from app.viewer.run_state import RunState
from app.viewer.snapshot import CAMERA, TASK_STAGES, TCP, Snapshot, StageSpan

MAX_PATH_POINTS = 150  # of the camera's path in a SLAM run


class Timeline:
    """Random access to the snapshots of a recording, which may still grow.

    Attributes:
        recorder: The recording.
    """

    def __init__(self, recorder: Recorder) -> None:
        self.recorder = recorder
        self._n_applied = 0  # notes contained in the current state
        self._state = RunState()
        self._path = np.zeros((0, 3))

    @property
    def end(self) -> float:
        """Show time of the end of the recording so far, in seconds."""
        return self.recorder.now

    @property
    def stages(self) -> list[StageSpan]:
        """Time spans of the stages so far."""
        spans: list[StageSpan] = []
        for note in list(self.recorder.notes):
            if note.kind == "stage":
                spans.append(StageSpan(note.data["name"], note.time))
            elif note.kind == "done" and spans:
                spans[-1] = replace(spans[-1], end=note.time, seconds=note.data["seconds"])
        return spans

    @property
    def stage_titles(self) -> Mapping[str, str]:
        """Titles by name: all stages of a task, including those to come; else the recorded stages."""
        recorded = {span.name: span.title for span in self.stages}
        return TASK_STAGES if TCP in self.recorder.bodies or not recorded else recorded

    def at(self, time: float) -> Snapshot:
        """Return the snapshot at a show time in seconds."""
        notes = self.recorder.notes
        count = bisect.bisect_right(notes, time, key=lambda note: note.time)
        if count < self._n_applied:  # states only advance: start again
            self._n_applied, self._state = 0, RunState()
        for note in notes[self._n_applied : count]:
            self._state.apply(note, self.recorder)
        self._n_applied = count
        snapshot = self._state.snapshot(time, self._poses(time), self.recorder.bodies)
        path = self._camera_path(bisect.bisect_right(self.recorder.show_times, time))
        return snapshot if path is None else replace(snapshot, path=path)

    def residuals(self, object_id: int, until: float) -> tuple[list[int], list[float]]:
        """Return iterations and depth residuals [m] of an object's fit up to a show time in seconds."""
        fits = [
            note.data
            for note in list(self.recorder.notes)
            if note.kind == "fit" and note.data["id"] == object_id and note.time <= until
        ]
        fits = [fit for fit in fits if fit["residual"] is not None]
        return [fit["iteration"] for fit in fits], [fit["residual"] for fit in fits]

    def _camera_path(self, count: int) -> Float[np.ndarray, "n 3"] | None:
        """Return the camera's path [m] over the first ``count`` samples; None if the recording has an arm.

        The array is replaced only when the path has grown, so that an unchanged path is not sent again.
        """
        if TCP in self.recorder.bodies or CAMERA not in self.recorder.bodies:
            return None
        row = self.recorder.bodies.index(CAMERA)
        step = max(1, len(self.recorder.poses) // MAX_PATH_POINTS)
        if len(self._path) != count // step:
            poses = self.recorder.poses[:count:step][: count // step]
            self._path = np.array([pose[row, :3] for pose in poses])
        return self._path if len(self._path) > 1 else None

    def _poses(self, time: float) -> Float[np.ndarray, "b 7"]:
        times = self.recorder.show_times
        if not times:
            return np.zeros((0, 7))
        index = min(max(bisect.bisect_right(times, time) - 1, 0), len(self.recorder.poses) - 1)
        return self.recorder.poses[index]
