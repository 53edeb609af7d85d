"""``video.mp4``: the cell, what the wrist camera sees, and what the robot believes, side by side.

Rendering in software is what a film costs, so little is rendered: few images a second, without multisampling,
the wrist camera in every other one and without shadows, and nothing while nothing moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from app.drawing import draw_detections, draw_estimates, font
from app.movie import MovieFile, Picture
from app.task.pipeline import Watcher
from manipulation.execution import TaskEvent
from manipulation.types import Box, TaskPlan
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame
from sim_assets.cell.world import World
from sim_assets.rendering.camera import look_at

FPS = 12
SPEED = 5.0  # simulated seconds per second of film
SCENE = (720, 540)  # [px]
SIDE = (360, 270)  # of the two pictures beside it
FOOTER = 76  # together a height that the encoder need not change
WRIST = (320, 240)  # as rendered
SHOW = 1.5  # [s] for which a stage's result stands still
END = 2.0  # [s] for which the end does
STAGES = {
    "scan": "Scan",
    "detect": "Detect",
    "reconstruct": "Reconstruct",
    "plan": "Plan",
    "execute": "Execute",
    "verify": "Verify",
}
Sides = list[tuple[np.ndarray, float]]  # polygons in pixels, and how bright they are
STILL = 1e-3  # [rad], [m]: what moved less is not drawn again
_BACKGROUND, _TEXT, _FAINT, _ACCENT = (24, 26, 30), (235, 235, 235), (120, 124, 132), (86, 180, 233)


class Film(Watcher):
    """Films a run in the simulated cell; ``sample`` is to be called RATE times a simulated second or more."""

    def __init__(self, path: Path, title: str, world: World) -> None:
        super().__init__()
        self._world = world
        self._movie = MovieFile(path, FPS)
        self._title, self._stage, self._detail = title, "", ""
        self._next = world.time
        self._shown: np.ndarray | None = None  # joints and gripper width as drawn last
        self._count = 0
        self._scene = np.full((SCENE[1], SCENE[0], 3), _BACKGROUND, np.uint8)
        self._wrist = np.full((SIDE[1], SIDE[0], 3), _BACKGROUND, np.uint8)
        self._believed: dict[int, ObjectEstimate] = {}
        self._belief = _belief_picture((), None)
        self._frames: Sequence[RgbdFrame] = ()
        self._plan: TaskPlan | None = None

    def sample(self) -> None:
        """A moment of the simulation: an image of it, where one is due."""
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
    def belief(self) -> Picture:
        """What the robot believes, as drawn."""
        return self._belief

    def begin(self, stage: str) -> None:
        """What the footer says from now on."""
        self._stage, self._detail = stage, ""

    def event(self, event: TaskEvent) -> None:
        self._detail = f"{event.phase} {event.name}".replace("_", " ")
        if event.phase == "placed" and self._plan is not None:
            self._put(event.name)
        if event.plan is not None:
            self._resting = event.plan.T_world_stand_rest

    def looked(self, frame: RgbdFrame) -> None:
        """The wrist camera's own picture is there already."""
        self._wrist = np.asarray(frame.rgb)

    def made(self, name: str, value: Any) -> None:
        if name == "frames":
            self._frames = value
        elif name == "detections":
            self._hold(draw_detections(self._frames[0], value.per_frame[0]))
        elif name == "objects":
            self._believed = {estimate.id: estimate for estimate in value}
            self._belief = _belief_picture(value, None)
            self._hold(draw_estimates(self._frames[0], value))
        elif name == "plan":
            self._plan = value
            self._belief = _belief_picture(tuple(self._believed.values()), value)

    def close(self) -> None:
        """Finish the film."""
        self._movie.add(self._compose())
        self._movie.hold(END)
        self._movie.close()

    def discard(self) -> None:
        """Give it up."""
        self._movie.discard()

    def _put(self, name: str) -> None:
        """The robot believes that an object is where it was to be put."""
        assert self._plan is not None
        item = self._plan.objects[name]
        estimate = self._believed[item.id]
        T = self._resting @ np.linalg.inv(item.T_world_stand) @ estimate.T_world_object
        self._believed[item.id] = replace(estimate, T_world_object=T)
        self._belief = _belief_picture(tuple(self._believed.values()), self._plan)

    def _hold(self, wrist: Picture) -> None:
        """A stage's result over the wrist camera's picture, for a while."""
        before, self._wrist = self._wrist, wrist
        self._movie.add(self._compose())
        self._movie.hold(SHOW)
        self._wrist = before

    def _compose(self) -> Picture:
        (width, height), (side, half) = SCENE, SIDE
        canvas = np.full((height + FOOTER, width + side, 3), _BACKGROUND, np.uint8)
        canvas[:height, :width] = self._scene
        canvas[:half, width:] = cv2.resize(self._wrist, SIDE, interpolation=cv2.INTER_AREA)
        canvas[half : 2 * half, width:] = self._belief
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
            (width + 10, half + 8), "what it believes", fill=_TEXT, font=font(14), stroke_width=2,
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


def _belief_camera() -> RgbdFrame:
    """An empty picture from outside, over the table."""
    width, height = SIDE
    lens = CameraIntrinsics(width, height, 1.2 * width, 1.2 * width, (width - 1) / 2, (height - 1) / 2)
    fade = np.linspace(58, 30, height)[:, None, None] * np.array([0.95, 1.0, 1.1])
    rgb = np.ascontiguousarray(np.broadcast_to(fade, (height, width, 3)).astype(np.uint8))
    pose = look_at(np.array([1.42, -0.44, 0.86]), np.array([0.47, -0.03, 0.03]))
    return RgbdFrame(0.0, rgb, np.zeros((height, width), np.float32), lens, pose)


def _belief_picture(objects: Sequence[ObjectEstimate], plan: TaskPlan | None) -> Picture:
    """The object map as the robot has it: the table, the box or line of its plan, and every whole shape."""
    frame = _belief_camera()
    canvas = frame.rgb.copy()
    table = np.array([(0.12, -0.58, 0), (0.80, -0.58, 0), (0.80, 0.58, 0), (0.12, 0.58, 0)], dtype=np.float64)
    cv2.fillConvexPoly(canvas, _pixels(frame, table), (92, 80, 70), cv2.LINE_AA)
    if plan is not None and plan.line is not None:
        ends = np.array([(*plan.line.start, 0.0), (*plan.line.end, 0.0)])
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
    """Floor and walls of the box that are seen from inside, and those seen from outside."""
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
    """Pixel coordinates of world points before the camera, whole numbers."""
    assert frame.T_world_camera is not None
    local = (points - frame.T_world_camera[:3, 3]) @ frame.T_world_camera[:3, :3]
    lens = frame.intrinsics
    pixels = local[:, :2] / local[:, 2:] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    return np.rint(pixels).astype(np.int32)
