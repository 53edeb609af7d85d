"""Layers of the 3-D scene for bodies, reconstructed objects and goal poses. World frame, in metres."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import viser

from app.drawing import CLASS_COLORS
from app.runs.replay import Recorder
from app.viewer.display import DisplayOptions, pose_arguments, set_pose
from app.viewer.meshes import MeshCache
from app.viewer.snapshot import ObjectState, Snapshot
from perception.types import TriangleMesh

POSE_TOLERANCE = 2e-5  # [m] and quaternion units; smaller motions are not sent
FIT_OPACITY, GHOST_OPACITY = 0.8, 0.25
LABEL_HEIGHT = 0.02  # [m] above the object


class BodyLayer:
    """The arm, the cell, and the true objects of the simulator."""

    def __init__(self, server: viser.ViserServer, recorder: Recorder) -> None:
        self._rows = {body: row for row, body in enumerate(recorder.bodies)}
        self._frames: dict[str, viser.FrameHandle] = {}
        self._sent = np.empty((0, 7))  # poses known to the browsers
        for body, parts in recorder.meshes.items():
            self._frames[body] = server.scene.add_frame(f"/cell/{body}", show_axes=False)
            for index, mesh in enumerate(parts):
                server.scene.add_mesh_trimesh(
                    f"/cell/{body}/{index}", mesh, cast_shadow=body != "world", receive_shadow=True
                )

    def draw(self, snapshot: Snapshot, options: DisplayOptions) -> None:
        poses = snapshot.poses
        if self._sent.shape != poses.shape:
            self._sent = np.full(poses.shape, np.inf)
        moved = np.abs(poses - self._sent).max(axis=1, initial=0.0) > POSE_TOLERANCE
        self._sent[moved] = poses[moved]
        for body, frame in self._frames.items():
            row = self._rows.get(body)
            if row is None or row >= len(poses):
                continue
            if body.startswith("object"):  # until objects are reconstructed the true ones are shown
                frame.visible = options.objects != "reconstructed" or not snapshot.objects
            if moved[row]:
                frame.position, frame.wxyz = poses[row][:3], poses[row][3:]


class ObjectLayer:
    """Reconstructed objects with their names."""

    def __init__(self, server: viser.ViserServer, meshes: MeshCache) -> None:
        self._server, self._meshes = server, meshes
        self._appearances: dict[int, tuple[object, ...]] = {}
        self._handles: dict[int, Any] = {}
        self._labels: dict[int, viser.LabelHandle] = {}

    def draw(self, snapshot: Snapshot, options: DisplayOptions) -> None:
        for id in [id for id in self._handles if id not in snapshot.objects]:
            self._remove(id)
        for id, state in snapshot.objects.items():
            mesh = self._meshes.mesh(state)
            if mesh is None:
                continue
            appearance = (state.iteration, options.coloring, options.objects)
            if self._appearances.get(id) != appearance:
                self._appearances[id] = appearance
                self._handles[id] = self._add(state, mesh, options)
            set_pose(self._handles[id], state.T_world_object)
            self._handles[id].visible = options.objects != "true"
            self._draw_label(state, mesh, options)

    def _add(self, state: ObjectState, mesh: TriangleMesh, options: DisplayOptions) -> Any:
        path = f"/objects/{state.id}"
        colors = self._meshes.uncertainty_colors(state) if options.coloring == "uncertainty" else None
        if colors is not None and options.objects != "both":
            painted = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
            return self._server.scene.add_mesh_trimesh(path, painted)
        return self._server.scene.add_mesh_simple(
            path,
            mesh.vertices.astype(np.float32),
            mesh.faces.astype(np.uint32),
            color=CLASS_COLORS[state.category],
            opacity=FIT_OPACITY if state.iteration is not None else None,
            side="double",
            wireframe=options.objects == "both",  # coincident solid surfaces would flicker
            receive_shadow=False,  # self-shadowing of thin walls causes streaks
        )

    def _draw_label(self, state: ObjectState, mesh: TriangleMesh, options: DisplayOptions) -> None:
        height = float(mesh.vertices[:, 2].max()) + LABEL_HEIGHT
        if state.id not in self._labels:
            self._labels[state.id] = self._server.scene.add_label(
                f"/labels/{state.id}", "", anchor="bottom-center", font_screen_scale=0.8
            )
        label = self._labels[state.id]
        label.position, label.visible = state.T_world_object[:3, 3] + (0, 0, height), options.labels
        text = state.name.replace("_", " ")
        if state.iteration is not None:
            text += f" · iteration {state.iteration}"
        if label.text != text:
            label.text = text

    def _remove(self, id: int) -> None:
        self._handles.pop(id).remove()
        self._labels.pop(id).remove()
        self._appearances.pop(id)


class GoalLayer:
    """Ghosts of the objects at the goal poses of the plan."""

    def __init__(self, server: viser.ViserServer, meshes: MeshCache) -> None:
        self._server, self._meshes = server, meshes
        self._handles: dict[str, viser.MeshHandle] = {}

    def draw(self, snapshot: Snapshot, options: DisplayOptions) -> None:
        states = {state.name: state for state in snapshot.objects.values()}
        for name in [name for name in self._handles if name not in snapshot.goals]:
            self._handles.pop(name).remove()
        for name, T_world_object in snapshot.goals.items():
            mesh = self._meshes.mesh(states[name]) if name in states else None
            if name not in self._handles and mesh is not None:
                self._handles[name] = self._server.scene.add_mesh_simple(
                    f"/goals/{name}",
                    mesh.vertices.astype(np.float32),
                    mesh.faces.astype(np.uint32),
                    color=CLASS_COLORS[states[name].category],
                    opacity=GHOST_OPACITY,
                    cast_shadow=False,
                    receive_shadow=False,
                    **pose_arguments(T_world_object),
                )
            if name in self._handles:
                set_pose(self._handles[name], T_world_object)  # plans may be revised
                self._handles[name].visible = options.goals
