"""``overview.png``: a one-page summary of a run, from the initial scene to the result."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from scipy.spatial import ConvexHull

from app.drawing import (
    color_of,
    draw_detections,
    draw_estimates,
    draw_left_out,
    draw_obstacles,
    draw_surfaces,
)
from app.runs.report import ObjectReport
from manipulation.types import TaskPlan
from perception.geometry import pose_from_yaw
from perception.io.files import write_atomically
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import ObjectEstimate, RgbdFrame

Image = UInt8[np.ndarray, "h w 3"]

_INK, _FAINT = "#22252b", "#7a7f8a"
_GOOD, _BAD = "#1b7f5c", "#c23b22"


@dataclass(frozen=True)
class Overview:
    """Content of the overview; results of stages that were not reached are None or empty.

    Attributes:
        title, subtitle: Heading.
        before, after: Images of the cell before and after the run.
        after_close: Image of the goal region after the run.
        frames, detections, objects, plan: Results of the stages.
        reports: Outcome of each object.
        obstacles: Things of no class.
    """

    title: str
    subtitle: str
    before: Image | None = None
    after: Image | None = None
    after_close: Image | None = None
    frames: Sequence[RgbdFrame] = ()
    detections: Detections | None = None
    objects: Sequence[ObjectEstimate] = ()
    plan: TaskPlan | None = None
    reports: Sequence[ObjectReport] = ()
    obstacles: Sequence[PerceivedObstacle] = ()


def write_overview(path: Path, overview: Overview) -> None:
    """Draw the overview and write it as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16.2, 13.6), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        3, 3, left=0.015, right=0.985, top=0.915, bottom=0.015, hspace=0.12, wspace=0.03
    )
    figure.text(0.015, 0.968, overview.title, fontsize=25, fontweight="bold", color=_INK)
    figure.text(0.015, 0.943, overview.subtitle, fontsize=14, color=_FAINT)
    axes = [[figure.add_subplot(grid[row, column]) for column in range(3)] for row in range(3)]
    views = _clearest_views(overview)
    _picture(axes[0][0], "1  The table before", overview.before)
    for column, view in enumerate(views, start=1):
        frame = overview.frames[view]
        note = f"2  Found by the wrist camera (view {view + 1} of {len(overview.frames)})"
        _picture(axes[0][column], note, _seen(frame, view, overview.detections))
        if overview.objects:
            note = f"3  Whole shapes reconstructed (view {view + 1})"
            shapes = draw_estimates(frame, overview.objects)
            _picture(axes[1][column], note, draw_obstacles(shapes, frame, overview.obstacles))
    _draw_plan(axes[1][0], overview.plan)
    _picture(axes[2][0], "5  After", overview.after)
    _picture(axes[2][1], "    After, from near", overview.after_close)
    _table(axes[2][2], overview.reports)
    for axis in (axis for row in axes for axis in row if not axis.has_data()):
        axis.set_axis_off()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", pil_kwargs={"compress_level": 3})
    write_atomically(path, buffer.getvalue())


def _seen(frame: RgbdFrame, view: int, detections: Detections | None) -> Image:
    """Return the image with its detections, the candidates that are no objects, and the support surface."""
    if detections is None:
        return frame.rgb
    left_out = [candidate for candidate in detections.left_out if candidate.frame == view]
    image = draw_left_out(draw_detections(frame, detections.per_frame[view]), left_out)
    return draw_surfaces(image, frame, detections.surfaces)


def _clearest_views(overview: Overview, count: int = 2) -> list[int]:
    """Return the views with the most detections, preferring different directions."""
    if not overview.frames:
        return []
    seen = [len(found) for found in overview.detections.per_frame] if overview.detections else []
    order = sorted(range(len(overview.frames)), key=lambda i: -(seen[i] if i < len(seen) else 0))
    first = order[0]
    rest = sorted(order[1:4], key=lambda i: -_turn(overview.frames[first], overview.frames[i]))
    return sorted([first, *rest[: count - 1]])


def _turn(a: RgbdFrame, b: RgbdFrame) -> float:
    """Return the angle between two viewing directions in [rad]."""
    if a.T_world_camera is None or b.T_world_camera is None:
        return 0.0
    return float(np.arccos(np.clip(a.T_world_camera[:3, 2] @ b.T_world_camera[:3, 2], -1, 1)))


def _title(axis: Any, text: str) -> None:
    axis.set_title(text, loc="left", fontsize=14.5, color=_INK, pad=6)


def _picture(axis: Any, title: str, image: Image | None) -> None:
    _title(axis, title)
    axis.set_axis_off()
    if image is not None:
        extent = axis.get_window_extent()
        scale = min(extent.width / image.shape[1], extent.height / image.shape[0])
        size = (round(scale * image.shape[1]), round(scale * image.shape[0]))
        axis.imshow(cv2.resize(image, size, interpolation=cv2.INTER_AREA), interpolation="nearest")
    else:
        axis.text(0.5, 0.5, "not reached", ha="center", color=_FAINT, fontsize=14, transform=axis.transAxes)


def _draw_plan(axis: Any, plan: TaskPlan | None) -> None:
    """Draw the plan in top view: the goal of each object and the order of execution."""
    from matplotlib.patches import Circle, Rectangle

    _title(axis, "4  Plan, from above")
    axis.set_aspect("equal")
    # The overview camera views the table along +y and -x: draw y to the right and x downwards to match it.
    axis.set_xlim(-0.62, 0.62)
    axis.set_ylim(0.86, -0.14)
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_color("#d0d3d9")
    axis.add_patch(Circle((0, 0), 0.075, facecolor="#e8eaee", edgecolor=_FAINT))
    axis.text(0, 0, "robot", ha="center", va="center", fontsize=10, color=_FAINT)
    if plan is None:
        axis.text(0, 0.4, "no plan", ha="center", color=_FAINT, fontsize=14)
        return
    if plan.box is not None:
        (x, y), (length, width, _) = plan.box.center, plan.box.size
        corner = (y - width / 2, x - length / 2)
        axis.add_patch(Rectangle(corner, width, length, fill=False, edgecolor="#9c7b45", linewidth=3))
        axis.text(corner[0], corner[1] - 0.015, "box", color="#9c7b45", fontsize=12)
    for line in plan.lines:
        (x0, y0), (x1, y1) = line.start, line.end
        axis.plot([y0, y1], [x0, x1], color="#29599e", linewidth=3, alpha=0.5, zorder=1)
    for obstacle in plan.obstacles:
        _draw_obstacle(axis, obstacle)
    for order, placement in enumerate(plan.placements, start=1):
        item = plan.objects[placement.name]
        start = item.T_world_stand[:2, 3]
        goal = np.array(placement.position[:2])
        color = np.array(color_of(item.id)) / 255
        yaw = placement.yaws[0] if placement.yaws else 0.0
        _outline(axis, item.vertices, item.T_world_stand, color, alpha=0.25)
        T_world_goal = pose_from_yaw(yaw, np.array(placement.position, dtype=np.float64))
        _outline(axis, item.vertices, T_world_goal, color, alpha=0.8)
        axis.annotate(
            "",
            xy=goal[::-1],
            xytext=start[::-1],
            arrowprops={"arrowstyle": "-|>", "color": color, "alpha": 0.7, "linewidth": 1.4},
        )
        axis.text(*start[::-1], f"{placement.name.replace('_', ' ')}", ha="center", va="center", fontsize=9)
        axis.text(*goal[::-1], str(order), ha="center", va="center", fontsize=12, fontweight="bold")
    for name in plan.left_out.keys() & plan.objects.keys():  # what cannot be grasped as it is has no goal
        item = plan.objects[name]
        _outline(axis, item.vertices, item.T_world_stand, np.array([0.5, 0.5, 0.5]), alpha=0.4)
        axis.text(*item.T_world_stand[:2, 3][::-1], f"{name}\nleft out", ha="center", fontsize=9)


def _outline(axis: Any, vertices: np.ndarray, T: np.ndarray, color: np.ndarray, alpha: float) -> None:
    """Draw the convex outline of an object in top view."""
    points = (vertices @ T[:3, :3].T + T[:3, 3])[:, :2]
    hull = points[ConvexHull(points).vertices]
    axis.fill(hull[:, 1], hull[:, 0], facecolor=(*color, alpha), edgecolor=color, linewidth=1.2)


def _draw_obstacle(axis: Any, obstacle: PerceivedObstacle) -> None:
    """Draw the convex pieces of a thing of no class in top view."""
    for piece in obstacle.pieces:
        hull = piece[ConvexHull(piece[:, :2]).vertices]
        axis.fill(hull[:, 1], hull[:, 0], facecolor="#b9bcc4", edgecolor="#8a8d96", linewidth=0.8)
    x, y = obstacle.bounds.mean(axis=0)[:2]
    axis.text(y, x, f"{obstacle.name.replace('_', ' ')}\nof no class", ha="center", va="center", fontsize=8)


def _table(axis: Any, reports: Sequence[ObjectReport]) -> None:
    """List the outcome of each object."""
    _title(axis, "Result")
    axis.set_axis_off()
    axis.set_xlim(0, 1)
    axis.set_ylim(0, 1)
    step = min(0.085, 0.95 / max(len(reports), 1))
    for row, entry in enumerate(reports):
        y = 0.95 - step * row
        good = bool(entry.placed)
        name = f"{entry.category} {entry.id}" if entry.id >= 0 else entry.category
        axis.plot(0.03, y, "o", color=_GOOD if good else _BAD, markersize=9)
        axis.text(0.07, y, name, fontsize=13, va="center", color=_INK)
        axis.text(0.30, y, _verdict(entry), fontsize=12, va="center", color=_INK if good else _BAD)


def _verdict(entry: ObjectReport) -> str:
    if not entry.placed:
        text = entry.reason or "not judged"
        return text if len(text) <= 48 else text[:45] + "..."
    placed = "in place"
    if entry.error_position is not None:
        placed += f", {1000 * entry.error_position:.0f} mm from plan"
    return placed + (f", {entry.attempts} attempts" if entry.attempts > 1 else "")
