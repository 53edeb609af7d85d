"""Layer of the 3-D scene for things of no class. World frame, in metres."""

from __future__ import annotations

import numpy as np
import trimesh
import viser

from app.viewer.display import DisplayOptions
from app.viewer.snapshot import Snapshot

COLOR = (128, 128, 134)
OPACITY = 0.45
LABEL_HEIGHT = 0.02  # [m] above the thing


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
                mesh.vertices.astype(np.float32),
                mesh.faces.astype(np.uint32),
                color=COLOR,
                opacity=OPACITY,
                flat_shading=True,
                cast_shadow=False,
                receive_shadow=False,
            )
            for index, mesh in enumerate(map(trimesh.convex.convex_hull, pieces))
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
