"""Draws the moments of a story in viser's 3-D scene: one class for each kind of thing, drawn in one place.

Everything is drawn where the world frame says, in [m]; only what has changed is sent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import viser
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.drawing import CLASS_COLORS, draw_detections
from app.runs.replay import Recorder
from app.viewer.meshes import Meshes
from app.viewer.snapshot import Believed, Moment
from app.viewer.surroundings import Surroundings
from perception.types import RgbdFrame, TriangleMesh

Coloring = Literal["class", "uncertainty"]
Objects = Literal["reconstructed", "true", "both"]
PICTURE_WIDTH = 160  # [px] of the image in a frustum
_PATH, _CHOSEN, _CANDIDATE, _FRUSTUM, _NOW = (
    (32, 120, 220), (20, 150, 90), (150, 155, 165), (110, 116, 128), (235, 120, 20)
)  # fmt: skip
# Outline of a gripper in the TCP frame [m]: palm, two fingers, wrist; pairs of points.
_GRIPPER = np.array([
    [(0, -0.03, -0.05), (0, 0.03, -0.05)], [(0, -0.03, -0.05), (0, -0.03, 0.0)],
    [(0, 0.03, -0.05), (0, 0.03, 0.0)], [(0, 0, -0.05), (0, 0, -0.09)],
])  # fmt: skip
MAX_CANDIDATES = 24  # grasps drawn at a time


@dataclass(frozen=True)
class Shown:
    """What a person chose to see."""

    objects: Objects = "reconstructed"
    goals: bool = True
    cameras: bool = True
    motion: bool = True
    labels: bool = True
    shadows: bool = True
    coloring: Coloring = "class"


class SceneView:
    """The whole scene of one recording."""

    def __init__(
        self, server: viser.ViserServer, recorder: Recorder, meshes: Meshes, around: Surroundings
    ) -> None:
        self._server = server
        with server.atomic():
            self._key = _light(server, around)
            if not around.known:
                server.scene.add_grid(
                    "/ground", 2, 2, cell_size=0.1, section_size=0.5, **_look_of(around.T_world_ground)
                )
            self._parts: tuple[Any, ...] = (
                _Bodies(server, recorder),
                _Objects(server, meshes),
                _Goals(server, meshes),
                _Cameras(server, recorder),
                _Motion(server),
            )

    def draw(self, moment: Moment, shown: Shown) -> None:
        """Bring the scene to a moment."""
        with self._server.atomic():
            if self._key.cast_shadow != shown.shadows:
                self._key.cast_shadow = shown.shadows
            for part in self._parts:
                part.draw(moment, shown)


def _light(server: viser.ViserServer, around: Surroundings) -> viser.DirectionalLightHandle:
    """Light the scene as a bright room would; returns the light that casts shadows."""
    scene = server.scene
    scene.set_up_direction(around.up)
    turn: Any = around.T_world_ground[:3, :3]
    scene.configure_default_lights(False)
    scene.configure_environment_map(None)  # its pictures would come from elsewhere
    scene.add_light_hemisphere(
        "/light/sky", sky_color=(235, 240, 255), ground_color=(150, 138, 125), intensity=2.2
    )
    scene.add_light_directional("/light/fill", position=turn @ (-1.5, 1.2, 1.6), intensity=0.7)
    return scene.add_light_directional(
        "/light/key",
        position=turn @ (1.6, -1.4, 3.0),
        intensity=2.4,
        cast_shadow=True,
        color=(255, 248, 238),
    )


def _look_of(T: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """viser's words for a pose."""
    return {"position": T[:3, 3], "wxyz": Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)}


def _put(handle: Any, T: Float[np.ndarray, "4 4"]) -> None:
    for name, value in _look_of(T).items():
        setattr(handle, name, value)


class _Bodies:
    """Arm, table, box, and the objects as they really are."""

    def __init__(self, server: viser.ViserServer, recorder: Recorder) -> None:
        self._rows = {body: row for row, body in enumerate(recorder.bodies)}
        self._frames = {}
        self._drawn = np.empty((0, 7))  # poses as the browsers know them
        for body, parts in recorder.meshes.items():
            self._frames[body] = server.scene.add_frame(f"/cell/{body}", show_axes=False)
            for index, mesh in enumerate(parts):
                server.scene.add_mesh_trimesh(
                    f"/cell/{body}/{index}", mesh, cast_shadow=body != "world", receive_shadow=True
                )

    def draw(self, moment: Moment, shown: Shown) -> None:
        if self._drawn.shape != moment.poses.shape:
            self._drawn = np.full(moment.poses.shape, np.inf)
        moved = np.abs(moment.poses - self._drawn).max(axis=1, initial=0.0) > 2e-5
        self._drawn[moved] = moment.poses[moved]
        for body, frame in self._frames.items():
            row = self._rows.get(body)
            if row is None or row >= len(moment.poses):
                continue
            if body.startswith("object"):
                frame.visible = shown.objects != "reconstructed" or not moment.objects
            if moved[row]:
                pose = moment.poses[row]
                frame.position, frame.wxyz = pose[:3], pose[3:]


class _Objects:
    """Reconstructions, as they improve and as they are carried, with their names."""

    def __init__(self, server: viser.ViserServer, meshes: Meshes) -> None:
        self._server, self._meshes = server, meshes
        self._drawn: dict[int, tuple[object, ...]] = {}
        self._handles: dict[int, Any] = {}
        self._labels: dict[int, Any] = {}

    def draw(self, moment: Moment, shown: Shown) -> None:
        for number in [number for number in self._handles if number not in moment.objects]:
            self._remove(number)
        for believed in moment.objects.values():
            mesh = self._meshes.mesh(believed)
            if mesh is None:
                continue
            look = (believed.iteration, shown.coloring, shown.objects)
            if self._drawn.get(believed.id) != look:
                self._drawn[believed.id] = look
                self._handles[believed.id] = self._add(believed, mesh, shown)
            _put(self._handles[believed.id], believed.T_world_object)
            self._handles[believed.id].visible = shown.objects != "true"
            self._label(believed, mesh, shown)

    def _add(self, believed: Believed, mesh: TriangleMesh, shown: Shown) -> Any:
        path = f"/objects/{believed.id}"
        colors = self._meshes.uncertainty_colors(believed) if shown.coloring == "uncertainty" else None
        if colors is not None and shown.objects != "both":
            import trimesh

            painted = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
            return self._server.scene.add_mesh_trimesh(path, painted)
        return self._server.scene.add_mesh_simple(
            path,
            mesh.vertices.astype(np.float32),
            mesh.faces.astype(np.uint32),
            color=CLASS_COLORS[believed.category],
            opacity=0.8 if believed.iteration is not None else None,
            side="double",
            wireframe=shown.objects == "both",  # two solid surfaces in one place would flicker
            receive_shadow=False,  # thin walls would shade themselves in streaks
        )

    def _label(self, believed: Believed, mesh: TriangleMesh, shown: Shown) -> None:
        top = believed.T_world_object[:3, 3] + (0, 0, float(mesh.vertices[:, 2].max()) + 0.02)
        if believed.id not in self._labels:
            self._labels[believed.id] = self._server.scene.add_label(
                f"/labels/{believed.id}", "", anchor="bottom-center", font_screen_scale=0.8
            )
        label = self._labels[believed.id]
        label.position, label.visible = top, shown.labels
        text = believed.name.replace("_", " ")
        if believed.iteration is not None:
            text += f" · fit {believed.iteration}"
        if label.text != text:
            label.text = text

    def _remove(self, number: int) -> None:
        self._handles.pop(number).remove()
        self._labels.pop(number).remove()
        self._drawn.pop(number)


class _Goals:
    """Where the plan wants the objects: faint copies."""

    def __init__(self, server: viser.ViserServer, meshes: Meshes) -> None:
        self._server, self._meshes = server, meshes
        self._handles: dict[str, Any] = {}

    def draw(self, moment: Moment, shown: Shown) -> None:
        by_name = {believed.name: believed for believed in moment.objects.values()}
        for name in [name for name in self._handles if name not in moment.placements]:
            self._handles.pop(name).remove()
        for name, T_world_goal in moment.placements.items():
            if name not in self._handles and name in by_name:
                mesh = self._meshes.mesh(by_name[name])
                if mesh is None:
                    continue
                self._handles[name] = self._server.scene.add_mesh_simple(
                    f"/goals/{name}",
                    mesh.vertices.astype(np.float32),
                    mesh.faces.astype(np.uint32),
                    color=CLASS_COLORS[by_name[name].category],
                    opacity=0.25,
                    cast_shadow=False,
                    receive_shadow=False,
                    **_look_of(T_world_goal),
                )
            if name in self._handles:
                self._handles[name].visible = shown.goals


class _Cameras:
    """A frustum with its picture for every image, the newest one marked."""

    def __init__(self, server: viser.ViserServer, recorder: Recorder) -> None:
        self._server, self._recorder = server, recorder
        self._handles: list[Any] = []
        self._n_found: list[bool] = []

    def draw(self, moment: Moment, shown: Shown) -> None:
        frames = self._recorder.frames[: moment.n_frames]
        while len(self._handles) > len(frames):
            self._handles.pop().remove()
            self._n_found.pop()
        for index, frame in enumerate(frames):
            if frame.T_world_camera is None:
                continue
            found = index < moment.n_found
            if index >= len(self._handles):
                self._handles.append(self._add(index, frame, found))
                self._n_found.append(found)
            elif self._n_found[index] != found:
                self._handles[index], self._n_found[index] = self._add(index, frame, found), found
            handle = self._handles[index]
            handle.color = _NOW if index == self._latest(moment) else _FRUSTUM
            handle.visible = shown.cameras and moment.stage != "execute"

    def _latest(self, moment: Moment) -> int:
        return (moment.n_found if moment.stage == "detect" else moment.n_frames) - 1

    def _add(self, index: int, frame: RgbdFrame, found: bool) -> Any:
        assert frame.T_world_camera is not None
        image = frame.rgb
        if found and index < len(self._recorder.detections):
            image = draw_detections(frame, self._recorder.detections[index], by_class=True)
        camera = frame.intrinsics
        height = round(PICTURE_WIDTH * camera.height / camera.width)
        return self._server.scene.add_camera_frustum(
            f"/cameras/{index}",
            fov=2 * float(np.arctan(camera.height / 2 / camera.fy)),
            aspect=camera.width / camera.height,
            scale=0.05,
            thickness=0.0012,
            color=_FRUSTUM,
            image=cv2.resize(np.asarray(image), (PICTURE_WIDTH, height), interpolation=cv2.INTER_AREA),
            format="jpeg",
            cast_shadow=False,
            **_look_of(frame.T_world_camera),
        )


class _Motion:
    """The planned way of the tool, and the grasps that were weighed."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._path: Any = None
        self._points: np.ndarray | None = None
        self._grasps: list[Any] = []
        self._poses: np.ndarray | None = None

    def draw(self, moment: Moment, shown: Shown) -> None:
        path = moment.path if shown.motion else None
        if path is not self._points:
            self._points = path
            self._path = self._replace(self._path, path is not None and self._add_path(path))
        poses = moment.grasps if shown.motion else None
        if (poses is None) != (self._poses is None) or (
            poses is not None and self._poses is not None and not np.array_equal(poses, self._poses)
        ):
            self._poses = poses
            for handle in self._grasps:
                handle.remove()
            self._grasps = [] if poses is None else self._add_grasps(poses)

    def _replace(self, old: Any, new: Any) -> Any:
        if old and not new:
            old.remove()
        return new or None

    def _add_path(self, points: np.ndarray) -> Any:
        pairs = np.stack([points[:-1], points[1:]], axis=1)
        return self._server.scene.add_line_segments("/motion/path", pairs, np.array(_PATH), thickness=0.004)

    def _add_grasps(self, poses: np.ndarray) -> list[Any]:
        chosen, others = poses[:1], poses[1:]
        some = others[:: max(1, len(others) // MAX_CANDIDATES)]
        drawn = (("chosen", chosen, _CHOSEN, 0.004), ("candidates", some, _CANDIDATE, 0.0012))
        return [
            self._server.scene.add_line_segments(
                f"/motion/{name}", _grippers(Ts), np.array(color), thickness=thickness
            )
            for name, Ts, color, thickness in drawn
            if len(Ts)
        ]


def _grippers(Ts_world_tcp: Float[np.ndarray, "k 4 4"]) -> Float[np.ndarray, "n 2 3"]:
    points = np.einsum("kij,spj->kspi", Ts_world_tcp[:, :3, :3], _GRIPPER)
    return (points + Ts_world_tcp[:, None, None, :3, 3]).reshape(-1, 2, 3)
