"""Layer of the 3-D scene for things of no class. World frame, in metres."""

from __future__ import annotations

import itertools

import numpy as np
import viser
from jaxtyping import Float, UInt32
from scipy.spatial import ConvexHull, QhullError

from app.viewer.display import DisplayOptions
from app.viewer.snapshot import Snapshot
from manipulation.hulls import hull_faces

COLOR = (128, 128, 134)
OPACITY = 0.45
LABEL_HEIGHT = 0.02  # [m] above the thing


def surface(points: Float[np.ndarray, "k 3"]) -> UInt32[np.ndarray, "f 3"]:
    """Return the triangles of the convex hull; of flat points both sides, of points in a line none."""
    try:
        return hull_faces(points).reshape(-1, 3).astype(np.uint32)
    except QhullError:
        pass
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    try:
        ring = ConvexHull(points @ axes[:2].T).vertices.astype(np.uint32)
    except QhullError:
        return np.zeros((0, 3), np.uint32)
    fan = np.array([(ring[0], b, c) for b, c in itertools.pairwise(ring[1:])], np.uint32)
    return np.concatenate([fan, fan[:, ::-1]])


class ObstacleLayer:
    """Convex pieces of the things of no class, as planning avoids them."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: dict[str, object] = {}
        self._handles: dict[str, list[viser.SceneNodeHandle]] = {}

    def draw(self, snapshot: Snapshot, options: DisplayOptions) -> None:
        for name in [name for name in self._shown if name not in snapshot.obstacles]:
            self._remove(name)
        for name, pieces in snapshot.obstacles.items():
            if self._shown.get(name) is not pieces:
                if name in self._shown:
                    self._remove(name)
                self._shown[name], self._handles[name] = pieces, self._add(name, pieces)
            *solids, label = self._handles[name]
            for solid in solids:
                solid.visible = options.objects != "true"
            label.visible = options.labels

    def _add(self, name: str, pieces: tuple[np.ndarray, ...]) -> list[viser.SceneNodeHandle]:
        scene = self._server.scene
        handles: list[viser.SceneNodeHandle] = [
            scene.add_mesh_simple(
                f"/obstacles/{name}/{index}",
                points.astype(np.float32),
                surface(points),
                color=COLOR,
                opacity=OPACITY,
                flat_shading=True,
                cast_shadow=False,
                receive_shadow=False,
            )
            for index, points in enumerate(pieces)
        ]
        corners = np.concatenate(pieces)
        top = (corners.min(axis=0) + corners.max(axis=0)) / 2
        top[2] = corners[:, 2].max() + LABEL_HEIGHT
        text = f"{name.replace('_', ' ')} · of no class"
        label = scene.add_label(
            f"/obstacles/{name}/label", text, anchor="bottom-center", font_screen_scale=0.8, position=top
        )
        return [*handles, label]

    def _remove(self, name: str) -> None:
        self._shown.pop(name)
        for handle in self._handles.pop(name):
            handle.remove()
