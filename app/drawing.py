"""Drawings of perception results: masks and reconstructed meshes over camera images."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from jaxtyping import Float, UInt8

from perception.detection.geometry import project
from perception.detection.left_out import LeftOut
from perception.obstacles.obstacle import PerceivedObstacle
from perception.support.surface import SupportSurface
from perception.types import CATEGORIES, Category, ObjectDetection, ObjectEstimate, RejectedObject, RgbdFrame

Image = UInt8[np.ndarray, "h w 3"]

# The colour-blind safe palette of Okabe and Ito (2008), then lighter colours.
PALETTE = (
    (0, 158, 115), (230, 159, 0), (86, 180, 233), (213, 94, 0), (204, 121, 167),
    (0, 114, 178), (240, 228, 66), (148, 103, 189), (140, 200, 90), (220, 150, 150),
)  # fmt: skip
CLASS_COLORS: dict[Category, tuple[int, int, int]] = {
    category: color for category, color in zip(CATEGORIES, PALETTE, strict=False)
}
_REJECTED = (200, 60, 60)
_LEFT_OUT = (190, 190, 190)
_SURFACE = (240, 228, 66)
_OBSTACLE = (90, 90, 96)
_STEPS = 24  # of a side of an outline: parts of it may be behind the camera
_LIGHT = np.array([0.3, -0.5, 0.81])


def color_of(object_id: int) -> tuple[int, int, int]:
    """Return the colour of an object by id, the same in every image of a run."""
    return PALETTE[object_id % len(PALETTE)]


@cache
def font(size: int, bold: bool = False) -> PIL.ImageFont.FreeTypeFont:
    """Return the font that matplotlib ships, at a size in pixels; importing it would take 0.2 s."""
    found = importlib.util.find_spec("matplotlib")
    assert found is not None and found.origin is not None
    fonts = Path(found.origin).parent / "mpl-data" / "fonts" / "ttf"
    return PIL.ImageFont.truetype(str(fonts / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf")), size)


def draw_detections(frame: RgbdFrame, detections: Sequence[ObjectDetection], by_class: bool = False) -> Image:
    """Return the image with each mask tinted by object or class and labelled with its score."""
    image = np.array(frame.rgb)
    for order, found in enumerate(detections):
        color = color_of(found.instance_id if found.instance_id is not None else order)
        if by_class:
            color = CLASS_COLORS[found.category]
        image[found.mask] = (0.55 * image[found.mask] + 0.45 * np.array(color)).astype(np.uint8)
        contours = cv2.findContours(found.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[
            0
        ]
        cv2.drawContours(image, contours, -1, color, 2, cv2.LINE_AA)
    for found in detections:
        v, u = np.nonzero(found.mask)
        _label(image, f"{found.category} {100 * found.score:.0f}%", (int(u.mean()), int(v.min()) - 6))
    return image


def draw_estimates(
    frame: RgbdFrame, estimates: Sequence[ObjectEstimate], opacity: float = 0.85, labels: bool = True
) -> Image:
    """Return the image with the shaded meshes at their estimated poses."""
    painted = np.array(frame.rgb)
    triangles, depths, colors = [], [], []
    for estimate in estimates:
        corners, depth, shade = _visible_triangles(frame, estimate)
        triangles.append(corners)
        depths.append(depth)
        colors.append(shade[:, None] * np.array(color_of(estimate.id), dtype=np.float64))
    if triangles:
        flat, depth, color = np.concatenate(triangles), np.concatenate(depths), np.concatenate(colors)
        fraction = 3  # cv2 takes fixed-point corners
        fixed = np.rint(np.clip(flat, -1e4, 1e4) * 2**fraction).astype(np.int32)
        for i in np.argsort(-depth):  # the painter's algorithm: far to near
            cv2.fillConvexPoly(painted, fixed[i], color[i].tolist(), cv2.LINE_8, fraction)
    changed = (painted != frame.rgb).any(axis=-1, keepdims=True)
    image = np.where(changed, opacity * painted + (1 - opacity) * frame.rgb, frame.rgb).astype(np.uint8)
    for estimate in estimates if labels else ():
        _label_estimate(image, frame, estimate)
    return image


def draw_rejected(
    image: Image, detections: Sequence[ObjectDetection], rejected: Sequence[RejectedObject]
) -> Image:
    """Return the image with the masks of objects that are left out outlined, and the reason above each."""
    reasons = {item.id: f"no {item.category}: {item.reason}" for item in rejected}
    image = np.array(image)
    for found in detections:
        if found.instance_id not in reasons:
            continue
        outline = cv2.findContours(found.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(image, outline[0], -1, _REJECTED, 2, cv2.LINE_AA)
        v, u = np.nonzero(found.mask)
        _label(image, reasons[found.instance_id], (int(u.mean()), int(v.min()) - 6), size=12)
    return image


def draw_left_out(image: Image, candidates: Sequence[LeftOut]) -> Image:
    """Return the image with the candidates that are no objects outlined thinly, and the reason in each."""
    image = np.array(image)
    for candidate in candidates:
        outline = cv2.findContours(
            candidate.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
        )
        cv2.drawContours(image, outline[0], -1, _LEFT_OUT, 1, cv2.LINE_AA)
    for candidate in candidates:
        v, u = np.nonzero(candidate.mask)
        _label(image, candidate.text, (int(u.mean()), int(v.mean()) + 5), size=10, bold=False)
    return image


def draw_obstacles(image: Image, frame: RgbdFrame, obstacles: Sequence[PerceivedObstacle]) -> Image:
    """Return the image with the silhouettes of things of no class tinted, outlined and named."""
    image = np.array(image)
    for obstacle in obstacles:
        silhouette = np.zeros(image.shape[:2], dtype=np.uint8)
        for piece in obstacle.pieces:
            pixels, depth = project(frame, piece)
            if depth.min() > 0.05:
                corners = cv2.convexHull(np.clip(pixels, -10_000, 10_000).astype(np.int32))
                cv2.fillConvexPoly(silhouette, corners, 1)
        if not silhouette.any():
            continue
        shown = silhouette > 0
        image[shown] = (0.6 * image[shown] + 0.4 * np.array(_OBSTACLE)).astype(np.uint8)
        outlines = cv2.findContours(silhouette, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
        cv2.drawContours(image, outlines, -1, _OBSTACLE, 2, cv2.LINE_AA)
        v, u = np.nonzero(shown)
        _label(image, f"{obstacle.name.replace('_', ' ')}: no class", (int(u.mean()), int(v.mean())), 13)
    return image


def draw_surfaces(image: Image, frame: RgbdFrame, surfaces: Sequence[SupportSurface]) -> Image:
    """Return the image with the outlines of the support surfaces, that of the main one solid."""
    image = np.array(image)
    for number, surface in enumerate(surfaces):
        corners = surface.corners
        for start, end in zip(corners, np.roll(corners, -1, axis=0)):
            line = start + np.linspace(0, 1, _STEPS + 1)[:, None] * (end - start)
            pixels, depth = project(frame, line)
            for k in range(0, _STEPS, 1 if number == 0 else 2):
                if min(depth[k], depth[k + 1]) > 0.05:
                    a, b = np.clip(pixels[k : k + 2], -10_000, 10_000).tolist()
                    cv2.line(image, a, b, _SURFACE, 1, cv2.LINE_AA)
    return image


def _visible_triangles(
    frame: RgbdFrame, estimate: ObjectEstimate
) -> tuple[Float[np.ndarray, "n 3 2"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return corners [px], depth [m] and brightness 0..1 of the triangles that face the camera."""
    assert frame.T_world_camera is not None
    mesh = estimate.mesh_world
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    middle = corners.mean(axis=1)
    facing = ((middle - frame.T_world_camera[:3, 3]) * normals).sum(axis=1) < 0
    points = (corners[facing] - frame.T_world_camera[:3, 3]) @ frame.T_world_camera[:3, :3]
    in_front = (points[..., 2] > 0.05).all(axis=1)
    points = points[in_front]
    pixels = _project(frame, points.reshape(-1, 3)).reshape(-1, 3, 2)
    shade = 0.45 + 0.55 * np.clip(normals[facing][in_front] @ _LIGHT, 0, 1)
    return pixels, points[..., 2].mean(axis=1), shade


def _project(frame: RgbdFrame, points_camera: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    camera = frame.intrinsics
    x, y, z = points_camera.T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)


def _label_estimate(image: Image, frame: RgbdFrame, estimate: ObjectEstimate) -> None:
    assert frame.T_world_camera is not None
    vertices = estimate.mesh_world.vertices
    points = (vertices - frame.T_world_camera[:3, 3]) @ frame.T_world_camera[:3, :3]
    if (points[:, 2] < 0.05).any():
        return
    pixels = _project(frame, points)
    u, v = pixels[:, 0].mean(), pixels[:, 1].min()
    if 0 <= u < frame.intrinsics.width and -40 <= v < frame.intrinsics.height:
        _label(image, estimate.name.replace("_", " "), (int(u), int(v) - 6))


def _label(image: Image, text: str, at: tuple[int, int], size: int = 17, bold: bool = True) -> None:
    """Draw outlined text with its bottom centred at a pixel, kept inside the image."""
    picture = PIL.Image.fromarray(image)
    pen = PIL.ImageDraw.Draw(picture)
    letters = font(size, bold)
    left, _, right, bottom = pen.textbbox((0, 0), text, font=letters)
    x = float(np.clip(at[0] - (right - left) / 2, 3, max(3, image.shape[1] - right - 3)))
    y = float(np.clip(at[1] - bottom, 3, max(3, image.shape[0] - bottom - 3)))
    pen.text(
        (x, y),
        text,
        fill=(255, 255, 255),
        font=letters,
        stroke_width=2 if bold else 1,
        stroke_fill=(25, 25, 25),
    )
    image[:] = np.asarray(picture)
