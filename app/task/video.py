"""``video.mp4``: the cell, the image of the wrist camera and the object map, side by side.

Software rendering dominates the cost: few images per second are rendered, without multisampling, the wrist
camera in every other one and without shadows, and none while nothing moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from app.drawing import draw_detections, draw_estimates, font
from app.movie import MovieFile, Picture
from app.task.run_observer import RunObserver, Stage
from manipulation.execution import TaskEvent
from manipulation.types import Box, TaskPlan
from perception.pipeline import Detections
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame
from sim_assets.cell.world import World
from sim_assets.rendering.camera import look_at

FPS = 12
SPEED = 5.0  # simulated seconds per second of video
SCENE = (720, 540)  # [px]
SIDE = (360, 270)  # [px] of each of the two images beside it
FOOTER = 76  # [px]; with SCENE a height that the encoder accepts unchanged
WRIST = (320, 240)  # [px] as rendered
SHOW = 1.5  # [s] that the result of a stage is shown
END = 2.0  # [s] that the last image is shown
STAGES: dict[Stage, str] = {
    "scan": "Scan",
    "detect": "Detect",
    "reconstruct": "Reconstruct",
    "plan": "Plan",
    "execute": "Execute",
    "verify": "Verify",
}
Sides = list[tuple[np.ndarray, float]]  # polygons in pixels and their brightness
STILL = 1e-3  # [rad], [m]: smaller motion is not rendered
_BACKGROUND, _TEXT, _FAINT, _ACCENT = (24, 26, 30), (235, 235, 235), (120, 124, 132), (86, 180, 233)


class RunVideo(RunObserver):
    """Video of a run in the simulated cell; call ``sample`` at least RATE times per simulated second."""

    def __init__(self, path: Path, title: str, world: World) -> None:
        super().__init__()
        self._world = world
        self._movie = MovieFile(path, FPS)
        self._title, self._stage, self._detail = title, "", ""
        self._next = world.time
        self._shown: np.ndarray | None = None  # joints and gripper width of the last image
        self._count = 0
        self._scene = np.full((SCENE[1], SCENE[0], 3), _BACKGROUND, np.uint8)
        self._wrist = np.full((SIDE[1], SIDE[0], 3), _BACKGROUND, np.uint8)
        self._objects: dict[int, ObjectEstimate] = {}
        self._found: dict[int, ObjectEstimate] = {}  # as they were perceived
        self._placed: set[int] = set()
        self._map_image = _draw_map((), None)
        self._frames: Sequence[RgbdFrame] = ()
        self._plan: TaskPlan | None = None
        self._T_world_stand_rest = np.eye(4)  # of the object that is carried

    def sample(self) -> None:
        """Append an image if one is due."""
        if self._world.time < self._next:
            return
        self._next += SPEED / FPS
        now = np.append(self._world.joint_positions(), self._world.gripper_width())
        if self._shown is None or np.abs(now - self._shown).max() > STILL:
            self._scene = self._world.overview_image(*SCENE, draft=True)
            if self._count % 2 == 0:
                self._wrist = self._world.overview_image(*WRIST, camera="wrist", draft=True, shadows=False)
            self._shown = now
            self._count += 1
        self._movie.add(self._compose())

    @property
    def map_image(self) -> Picture:
        """Image of the object map."""
        return self._map_image

    def begin_stage(self, stage: Stage) -> None:
        """Highlight a stage in the footer."""
        self._stage, self._detail = stage, ""

    def on_event(self, event: TaskEvent) -> None:
        self._detail = f"{event.phase} {event.name}".replace("_", " ")
        if event.phase == "placed" and self._plan is not None:
            self._put(event.name)
        if event.plan is not None:
            self._T_world_stand_rest = event.plan.T_world_stand_rest

    def on_image(self, frame: RgbdFrame) -> None:
        """Show the image of the wrist camera."""
        self._wrist = np.asarray(frame.rgb)

    def on_frames(self, frames: Sequence[RgbdFrame]) -> None:
        self._frames = frames

    def on_detections(self, detections: Detections) -> None:
        self._hold(draw_detections(self._frames[0], detections.per_frame[0]))

    def on_objects(self, objects: Sequence[ObjectEstimate]) -> None:
        placed = {id: self._objects[id] for id in self._placed}  # by the rounds before
        self._found = {estimate.id: estimate for estimate in objects}
        self._objects = {estimate.id: placed.get(estimate.id, estimate) for estimate in objects}
        self._map_image = _draw_map(tuple(self._objects.values()), None)
        self._hold(draw_estimates(self._frames[0], objects))

    def on_plan(self, plan: TaskPlan) -> None:
        self._plan = plan
        self._map_image = _draw_map(tuple(self._objects.values()), plan)

    def close(self) -> None:
        """Finish the file."""
        self._movie.add(self._compose())
        self._movie.hold(END)
        self._movie.close()

    def discard(self) -> None:
        """Discard the file."""
        self._movie.discard()

    def _put(self, name: str) -> None:
        """Move an object of the map to its resting pose."""
        assert self._plan is not None
        item = self._plan.objects[name]
        estimate = self._found[item.id]
        T = self._T_world_stand_rest @ np.linalg.inv(item.T_world_stand) @ estimate.T_world_object
        self._objects[item.id] = replace(estimate, T_world_object=T)
        self._placed.add(item.id)
        self._map_image = _draw_map(tuple(self._objects.values()), self._plan)

    def _hold(self, wrist: Picture) -> None:
        """Show the result of a stage in place of the wrist camera's image for a while."""
        before, self._wrist = self._wrist, wrist
        self._movie.add(self._compose())
        self._movie.hold(SHOW)
        self._wrist = before

    def _compose(self) -> Picture:
        (width, height), (side, half) = SCENE, SIDE
        canvas = np.full((height + FOOTER, width + side, 3), _BACKGROUND, np.uint8)
        canvas[:height, :width] = self._scene
        canvas[:half, width:] = cv2.resize(self._wrist, SIDE, interpolation=cv2.INTER_AREA)
        canvas[half : 2 * half, width:] = self._map_image
        image = Image.fromarray(canvas)
        pen = ImageDraw.Draw(image)
        pen.text(
            (width + 10, 8),
            "wrist camera",
            fill=_TEXT,
            font=font(14),
            stroke_width=2,
            stroke_fill=_BACKGROUND,
        )
        pen.text(
            (width + 10, half + 8), "object map", fill=_TEXT, font=font(14), stroke_width=2,
            stroke_fill=_BACKGROUND,
        )  # fmt: skip
        pen.text((20, height + 20), self._title, fill=_TEXT, font=font(24, bold=True))
        x = 130
        for name, label in STAGES.items():
            active = name == self._stage
            letters = font(18, bold=active)
            pen.text((x, height + 25), label, fill=_ACCENT if active else _FAINT, font=letters)
            x += 26 + round(pen.textlength(label, font=font(18, bold=True)))
        pen.text((width, height + 14), self._detail, fill=_TEXT, font=font(18))
        pen.text((width, height + 42), f"shown at {SPEED:g}x speed", fill=_FAINT, font=font(14))
        return np.asarray(image)


def _map_camera() -> RgbdFrame:
    """Return an empty image of a fixed camera above the table."""
    width, height = SIDE
    lens = CameraIntrinsics(width, height, 1.2 * width, 1.2 * width, (width - 1) / 2, (height - 1) / 2)
    fade = np.linspace(58, 30, height)[:, None, None] * np.array([0.95, 1.0, 1.1])
    rgb = np.ascontiguousarray(np.broadcast_to(fade, (height, width, 3)).astype(np.uint8))
    pose = look_at(np.array([1.42, -0.44, 0.86]), np.array([0.47, -0.03, 0.03]))
    return RgbdFrame(0.0, rgb, np.zeros((height, width), np.float32), lens, pose)


def _draw_map(objects: Sequence[ObjectEstimate], plan: TaskPlan | None) -> Picture:
    """Draw the object map: table, the plan's box or line, and all reconstructed shapes."""
    frame = _map_camera()
    canvas = frame.rgb.copy()
    table = np.array([(0.12, -0.58, 0), (0.80, -0.58, 0), (0.80, 0.58, 0), (0.12, 0.58, 0)], dtype=np.float64)
    cv2.fillConvexPoly(canvas, _pixels(frame, table), (92, 80, 70), cv2.LINE_AA)
    for line in plan.lines if plan is not None else ():
        ends = np.array([(*line.start, 0.0), (*line.end, 0.0)])
        cv2.polylines(canvas, [_pixels(frame, ends)], False, (86, 140, 200), 3, cv2.LINE_AA)
    inside, before = _walls(frame, plan.box) if plan is not None and plan.box is not None else ([], [])
    for wall, shade in inside:
        cv2.fillConvexPoly(canvas, wall, (190 * shade, 158 * shade, 104 * shade), cv2.LINE_AA)
    image = draw_estimates(replace(frame, rgb=canvas), objects, 1.0, labels=False)
    veiled = image.copy()
    for wall, shade in before:
        cv2.fillConvexPoly(veiled, wall, (200 * shade, 166 * shade, 110 * shade), cv2.LINE_AA)
    return cv2.addWeighted(veiled, 0.6, image, 0.4, 0)


def _walls(frame: RgbdFrame, box: Box) -> tuple[Sides, Sides]:
    """Return floor and walls of the box whose inside is visible, and walls whose outside is."""
    assert frame.T_world_camera is not None
    (x, y), (length, width, depth) = box.center, box.size
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (length / 2, width / 2) + (x, y)
    low, high = (np.column_stack([corners, np.full(4, z)]) for z in (0.0, depth))
    inside, before = [(_pixels(frame, low), 0.8)], []
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        wall = np.array([low[a], low[b], high[b], high[a]])
        outward = wall.mean(axis=0)[:2] - (x, y)
        faces_away = (frame.T_world_camera[:2, 3] - wall.mean(axis=0)[:2]) @ outward < 0
        (inside if faces_away else before).append((_pixels(frame, wall), 1.0 if a % 2 else 0.9))
    return inside, before


def _pixels(frame: RgbdFrame, points: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Return integer pixel coordinates of world points in front of the camera."""
    assert frame.T_world_camera is not None
    local = (points - frame.T_world_camera[:3, 3]) @ frame.T_world_camera[:3, :3]
    lens = frame.intrinsics
    pixels = local[:, :2] / local[:, 2:] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    return np.rint(pixels).astype(np.int32)
