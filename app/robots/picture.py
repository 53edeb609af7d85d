"""``robot.png``: the arm in the cell, its camera's view, and the part of the table that its hand reaches."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from app.robots.examination import Examination
from manipulation.kinematics import Kinematics
from sim_assets.cell.config import CellConfig
from sim_assets.cell.layout import Region
from sim_assets.cell.scene import TABLE_CENTER, TABLE_SIZE, BoxConfig
from sim_assets.cell.world import World
from sim_assets.robots.simulated_arm import WRIST_CAMERA, SimulatedArm

_FRAME = 0.08  # [m] length of the axes of drawn frames
_COLORS = ("tab:red", "tab:green", "tab:blue")  # x, y, z


def write_picture(path: Path, robot: SimulatedArm, examination: Examination) -> None:
    """Draw an arm at home in an empty cell: views, frames from the side, reach from above."""
    scale = examination.fit.workspace.scale
    with World(CellConfig(objects=(), box=BoxConfig().scaled(scale), robot=robot, scale=scale)) as world:
        overview, wrist = world.overview_image(640, 480), world.overview_image(640, 480, WRIST_CAMERA)
    figure, axes = plt.subplots(2, 2, figsize=(12, 9), layout="constrained")
    for ax, image, title in ((axes[0, 0], overview, "arm at home"), (axes[0, 1], wrist, "wrist camera")):
        ax.imshow(image)
        ax.set_title(title)
        ax.axis("off")
    kinematics = Kinematics(robot.description)
    _draw_frames(axes[1, 0], kinematics)
    _draw_reach(axes[1, 1], kinematics, examination)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _draw_frames(ax: Axes, kinematics: Kinematics) -> None:
    """Draw the joints' anchors and the frames of tool and camera, from the side (x and z)."""
    anchors = kinematics.anchors(np.asarray(kinematics.arm.q_home))
    ax.plot(anchors[:, 0], anchors[:, 2], "o-", color="0.4", label="joints")
    for frame in ("tcp", "camera"):
        T = kinematics.forward(np.asarray(kinematics.arm.q_home), frame)
        for axis, color in enumerate(_COLORS):
            end = T[:3, 3] + _FRAME * T[:3, axis]
            ax.plot([T[0, 3], end[0]], [T[2, 3], end[2]], color=color)
        ax.annotate(frame, (float(T[0, 3]), float(T[2, 3])))
    ax.axhline(0.0, color="tab:brown", label="table")
    ax.set(title="frames (x red, y green, z blue)", xlabel="x [m]", ylabel="z [m]", aspect="equal")
    ax.legend(fontsize=8)


def _draw_reach(ax: Axes, kinematics: Kinematics, examination: Examination) -> None:
    """Draw where a hand pointing down reaches, over table, box and region of the objects."""
    length, width, _ = TABLE_SIZE
    corner = (TABLE_CENTER[0] - length / 2, TABLE_CENTER[1] - width / 2)
    ax.add_patch(Rectangle(corner, length, width, facecolor="0.95", edgecolor="tab:brown"))
    base = (float(kinematics.base[0]), float(kinematics.base[1]))
    if len(examination.reach):
        for radius, color in ((examination.reach[-1], "honeydew"), (examination.reach[0], "0.95")):
            ax.add_patch(Circle(base, float(radius), facecolor=color, edgecolor="tab:green"))
    scale = examination.fit.workspace.scale
    region, box = Region().scaled(scale), BoxConfig().scaled(scale)
    size = (region.x[1] - region.x[0], region.y[1] - region.y[0])
    ax.add_patch(
        Rectangle((region.x[0], region.y[0]), *size, fill=False, edgecolor="tab:orange", label="objects")
    )
    low = (box.center[0] - box.inner[0] / 2, box.center[1] - box.inner[1] / 2)
    ax.add_patch(Rectangle(low, *box.inner[:2], fill=False, edgecolor="tab:blue", label="box"))
    ax.plot(*base, "k^", label="base")
    ax.set(title="reach of the hand pointing down (green)", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set(xlim=(-0.35, 1.2), ylim=(-0.75, 0.75))
    ax.legend(fontsize=8)
