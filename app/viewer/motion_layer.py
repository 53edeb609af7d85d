"""Layer of the 3-D scene for planned paths and grasp candidates."""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Float

from app.viewer.display import DisplayOptions
from app.viewer.snapshot import Snapshot

PATH_COLOR, SELECTED_COLOR, CANDIDATE_COLOR = (32, 120, 220), (20, 150, 90), (150, 155, 165)
PATH_THICKNESS, SELECTED_THICKNESS, CANDIDATE_THICKNESS = 0.004, 0.004, 0.0012  # [m]
MAX_CANDIDATES = 24  # about this many candidates are drawn
# Outline of a gripper in the TCP frame [m]: palm, two fingers, wrist; pairs of points.
GRIPPER_OUTLINE = np.array([
    [(0, -0.03, -0.05), (0, 0.03, -0.05)], [(0, -0.03, -0.05), (0, -0.03, 0.0)],
    [(0, 0.03, -0.05), (0, 0.03, 0.0)], [(0, 0, -0.05), (0, 0, -0.09)],
])  # fmt: skip


class MotionLayer:
    """The path of the tool or camera, and the grasp candidates of the approach."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._path: viser.LineSegmentsHandle | None = None
        self._points: np.ndarray | None = None
        self._outlines: list[viser.LineSegmentsHandle] = []
        self._grasps: np.ndarray | None = None

    def draw(self, snapshot: Snapshot, options: DisplayOptions) -> None:
        path = snapshot.path if options.motion else None
        if path is not self._points:
            self._points = path
            if path is None and self._path is not None:
                self._path.remove()
            self._path = None if path is None else self._add_path(path)  # replaces a node of the same name
        grasps = snapshot.grasps if options.motion else None
        if not _equal(grasps, self._grasps):
            self._grasps = grasps
            for handle in self._outlines:
                handle.remove()
            self._outlines = [] if grasps is None else self._add_grasps(grasps)

    def _add_path(self, points: Float[np.ndarray, "n 3"]) -> viser.LineSegmentsHandle:
        pairs = np.stack([points[:-1], points[1:]], axis=1)
        return self._server.scene.add_line_segments(
            "/motion/path", pairs, np.array(PATH_COLOR), thickness=PATH_THICKNESS
        )

    def _add_grasps(self, Ts_world_tcp: Float[np.ndarray, "k 4 4"]) -> list[viser.LineSegmentsHandle]:
        selected, others = Ts_world_tcp[:1], Ts_world_tcp[1:]
        subset = others[:: max(1, len(others) // MAX_CANDIDATES)]
        groups = (
            ("selected", selected, SELECTED_COLOR, SELECTED_THICKNESS),
            ("candidates", subset, CANDIDATE_COLOR, CANDIDATE_THICKNESS),
        )
        return [
            self._server.scene.add_line_segments(
                f"/motion/{name}", gripper_outlines(Ts), np.array(color), thickness=thickness
            )
            for name, Ts, color, thickness in groups
            if len(Ts)
        ]


def gripper_outlines(Ts_world_tcp: Float[np.ndarray, "k 4 4"]) -> Float[np.ndarray, "n 2 3"]:
    """Return line segments [m] that outline grippers at the given poses."""
    points = np.einsum("kij,spj->kspi", Ts_world_tcp[:, :3, :3], GRIPPER_OUTLINE)
    return (points + Ts_world_tcp[:, None, None, :3, 3]).reshape(-1, 2, 3)


def _equal(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    if a is None or b is None:
        return a is b
    return np.array_equal(a, b)
