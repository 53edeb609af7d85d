"""The viewer of one server: scene, panel and player of the current recording."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from app.runs.replay import Recorder
from app.viewer.panel import FOLLOW, THROUGH_CAMERA, Panel
from app.viewer.player import Player
from app.viewer.scene import SceneView
from app.viewer.server import ViewerServer
from app.viewer.snapshot import CAMERA, TCP, ObjectOutcome, Snapshot, pose_matrix
from app.viewer.surroundings import FIELD_OF_VIEW, Surroundings, surroundings_of
from app.viewer.timeline import Timeline

PANEL_INTERVAL = 3  # the panel is drawn once per this many images of the scene
MIN_MOTION = 1e-4  # [m] of the gripper that moves the view
TARGET_DISTANCE = 0.4  # [m] of the view's target from the wrist camera


def set_initial_view(server: ViewerServer, surroundings: Surroundings) -> None:
    """Set the view of new clients."""
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up = surroundings.position, surroundings.target, surroundings.up
    camera.fov = FIELD_OF_VIEW


class Viewer:
    """Shows one recording at a time to all connected clients.

    Attributes:
        server, player, panel: Its parts.
    """

    def __init__(self, server: ViewerServer, recorder: Recorder | None = None, live: bool = False) -> None:
        self.server = server
        recorder = recorder or Recorder()
        set_initial_view(server, surroundings_of(recorder))
        self.player = Player(Timeline(recorder), self._draw, live)
        self.panel = Panel(server, self.player)
        self._scene: SceneView | None = None
        self._pending: Recorder | None = recorder  # its scene has not been built
        self._count = 0
        self._tracked: np.ndarray | None = None  # position that the view followed last
        self.player.playing = live  # a replay begins when the first client connects
        self._connected = live
        server.on_client_connect(self._on_connect)

    def start(self) -> None:
        """Start drawing."""
        self.player.start()

    def close(self) -> None:
        """Stop drawing and serving."""
        self.player.close()
        self.server.stop()

    def show(self, recorder: Recorder, live: bool) -> None:
        """Show another recording."""
        self.player.load(Timeline(recorder), live)
        self._pending = recorder

    def set_title(
        self, title: str, subtitle: str, outcomes: Mapping[int, ObjectOutcome] | None = None
    ) -> None:
        """Set the header of the panel, and the outcomes of the objects by id."""
        self.panel.set_title(title, subtitle, outcomes or {})

    def _on_connect(self, _: object) -> None:
        if not self._connected:
            self._connected = True
            self.player.play()

    def _draw(self) -> None:
        recorder, self._pending = self._pending, None
        if recorder is not None:
            self.server.scene.reset()
            self._scene = SceneView(self.server, recorder, surroundings_of(recorder))
        assert self._scene is not None
        snapshot = self.player.timeline.at(self.player.time)
        self._scene.draw(snapshot, self.panel.options)
        self._move_views(snapshot)
        self._count += 1
        if self._count % PANEL_INTERVAL == 0:
            self.panel.draw(snapshot)

    def _move_views(self, snapshot: Snapshot) -> None:
        """Move the views of all clients with the gripper, or to the wrist camera, if selected."""
        view, bodies = self.panel.view, self.player.timeline.recorder.bodies
        body = {FOLLOW: TCP if TCP in bodies else CAMERA, THROUGH_CAMERA: CAMERA}.get(view)
        if body not in bodies or len(snapshot.poses) <= bodies.index(body):
            self._tracked = None
            return
        T = pose_matrix(snapshot.poses[bodies.index(body)])
        motion = np.zeros(3) if self._tracked is None else T[:3, 3] - self._tracked
        self._tracked = T[:3, 3]
        for client in self.server.get_clients().values():
            camera = client.camera
            if view == THROUGH_CAMERA:
                with client.atomic():
                    camera.up_direction = -T[:3, 1]
                    camera.position = T[:3, 3]
                    camera.look_at = T[:3, 3] + TARGET_DISTANCE * T[:3, 2]
            elif np.linalg.norm(motion) > MIN_MOTION:
                with client.atomic():
                    camera.position = camera.position + motion
                    camera.look_at = camera.look_at + motion
