"""The viewer of one server: scene, panel and player of the recording that is shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from app.runs.replay import Recorder
from app.viewer.meshes import Meshes
from app.viewer.panel import CAMERAS, Panel
from app.viewer.player import Player
from app.viewer.scene import SceneView
from app.viewer.server import ViewerServer
from app.viewer.snapshot import CAMERA, TCP, Moment
from app.viewer.surroundings import FIELD_OF_VIEW, Surroundings, surroundings_of
from app.viewer.timeline import Story, matrix

PANEL_EVERY = 3  # pictures of the scene for one of the panel


def look_from_home(server: ViewerServer, around: Surroundings) -> None:
    """Where new viewers look from."""
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up = around.position, around.target, around.up
    camera.fov = FIELD_OF_VIEW


class Viewer:
    """Shows one recording at a time to everybody who is connected."""

    def __init__(self, server: ViewerServer, recorder: Recorder | None = None, live: bool = False) -> None:
        self.server = server
        recorder = recorder or Recorder()
        look_from_home(server, surroundings_of(recorder))
        self.player = Player(Story(recorder), self._draw, live)
        self.panel = Panel(server, self.player)
        self._scene: SceneView | None = None
        self._next: Recorder | None = self.player.story.recorder
        self._count = 0
        self.player.playing = live  # a replay begins when somebody looks
        self._seen = live
        server.on_client_connect(self._welcome)
        self._hand: np.ndarray | None = None

    def start(self) -> None:
        self.player.start()

    def close(self) -> None:
        self.player.close()
        self.server.stop()

    def _welcome(self, _: object) -> None:
        if not self._seen:
            self._seen = True
            self.player.play()

    def show(self, recorder: Recorder, live: bool) -> None:
        """From now on another recording."""
        self.player.tell(Story(recorder), live)
        self._next = recorder

    def title(self, title: str, subtitle: str, objects: Sequence[Mapping[str, Any]] = ()) -> None:
        """What is shown; ``objects`` are the report's entries."""
        results = {entry["id"]: entry for entry in objects if isinstance(entry.get("id"), int)}
        self.panel.title(title, subtitle, results)

    def _draw(self) -> None:
        fresh, self._next = self._next, None
        if fresh is not None:
            self.server.scene.reset()
            self._scene = SceneView(self.server, fresh, Meshes(fresh), surroundings_of(fresh))
        assert self._scene is not None
        moment = self.player.story.at(self.player.time)
        self._scene.draw(moment, self.panel.shown)
        self._move_cameras(moment)
        self._count += 1
        if self._count % PANEL_EVERY == 0:
            self.panel.draw(moment)

    def _move_cameras(self, moment: Moment) -> None:
        """Let the views of all clients follow the hand, or see what the wrist camera sees."""
        choice, bodies = self.panel.camera, self.player.story.recorder.bodies
        name = {CAMERAS[1]: TCP if TCP in bodies else CAMERA, CAMERAS[2]: CAMERA}.get(choice)
        if name not in bodies or len(moment.poses) <= bodies.index(name):
            self._hand = None
            return
        T = matrix(moment.poses[bodies.index(name)])
        moved = np.zeros(3) if self._hand is None else T[:3, 3] - self._hand
        self._hand = T[:3, 3]
        for client in self.server.get_clients().values():
            camera = client.camera
            if choice == CAMERAS[2]:
                with client.atomic():
                    camera.up_direction = -T[:3, 1]
                    camera.position = T[:3, 3]
                    camera.look_at = T[:3, 3] + 0.4 * T[:3, 2]
            elif np.linalg.norm(moved) > 1e-4:
                with client.atomic():
                    camera.position = camera.position + moved
                    camera.look_at = camera.look_at + moved
