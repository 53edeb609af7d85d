"""The 3-D scene of a recording: lights, ground and layers."""

from __future__ import annotations

from typing import Any

import viser

from app.runs.replay import Recorder
from app.viewer.camera_layer import CameraLayer
from app.viewer.display import DisplayOptions, Layer, pose_arguments
from app.viewer.meshes import MeshCache
from app.viewer.motion_layer import MotionLayer
from app.viewer.object_layers import BodyLayer, GoalLayer, ObjectLayer
from app.viewer.obstacle_layer import ObstacleLayer
from app.viewer.snapshot import Snapshot
from app.viewer.surroundings import Surroundings


class SceneView:
    """The whole scene of one recording."""

    def __init__(self, server: viser.ViserServer, recorder: Recorder, surroundings: Surroundings) -> None:
        self._server = server
        meshes = MeshCache(recorder)
        with server.atomic():
            self._key_light = _add_lights(server.scene, surroundings)
            if not surroundings.has_floor:
                pose = pose_arguments(surroundings.T_world_ground)
                server.scene.add_grid("/ground", 2, 2, cell_size=0.1, section_size=0.5, **pose)
            self._layers: tuple[Layer, ...] = (
                BodyLayer(server, recorder),
                ObjectLayer(server, meshes),
                GoalLayer(server, meshes),
                CameraLayer(server, recorder),
                MotionLayer(server),
                ObstacleLayer(server),
            )

    def draw(self, snapshot: Snapshot, options: DisplayOptions) -> None:
        """Update the scene to a snapshot."""
        with self._server.atomic():
            if self._key_light.cast_shadow != options.shadows:
                self._key_light.cast_shadow = options.shadows
            for layer in self._layers:
                layer.draw(snapshot, options)


def _add_lights(scene: viser.SceneApi, surroundings: Surroundings) -> viser.DirectionalLightHandle:
    """Add the lights of a bright room; return the key light, which casts shadows."""
    scene.set_up_direction(surroundings.up)
    rotation: Any = surroundings.T_world_ground[:3, :3]
    scene.configure_default_lights(False)
    scene.configure_environment_map(None)  # its images would be downloaded
    scene.add_light_hemisphere(
        "/light/sky", sky_color=(235, 240, 255), ground_color=(150, 138, 125), intensity=2.2
    )
    scene.add_light_directional("/light/fill", position=rotation @ (-1.5, 1.2, 1.6), intensity=0.7)
    return scene.add_light_directional(
        "/light/key",
        position=rotation @ (1.6, -1.4, 3.0),
        intensity=2.4,
        cast_shadow=True,
        color=(255, 248, 238),
    )
