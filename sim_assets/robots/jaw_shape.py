"""Shape of a hand with one moving jaw opposite to a fixed one, measured on its collision geoms.

The jaw turns about a hinge or slides. While it turns, its pad is parallel to the fixed one in at most one
posture; the opening is that at the narrowest place near the tips, and postures in which the tip of a turning
jaw is far above that of the fixed one are left out. The tool frame lies on the fixed pad.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from manipulation.robot import GripperGeometry
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.finger_motion import HandSweep
from sim_assets.robots.hand_pads import SLICE, find_pads, finger_motion, reversed_sweep
from sim_assets.robots.hand_surface import HandShape, HandSurface

_RISE = 0.015  # [m] of the moving tip above its lowest place, up to which the jaw is used
_HELD = 0.020  # [m] of an object above the TCP that may be between the jaws
_PAD_HALF_HEIGHT = (0.003, 0.0095)  # [m] least and largest
_OUTER = 0.6  # share of the jaw's length from which on its points belong to its tip
_FINGER_DEPTH = 0.032  # [m] from the pad's face; what reaches further out belongs to the palm
_FINGER_HALF_WIDTH = 0.03  # [m], the same across the closing direction
_BETWEEN = 0.004  # [m] beyond the fixed pad's face, from which on the fixed part is the palm
_BESIDE = 0.005  # [m] across the closing direction, from the jaw to fixed points opposite to it
_INSERTED = 0.035  # [m] of the fingers above the TCP that may enter a cavity
_ALONG = np.cos(np.deg2rad(50))  # largest angle of the approach to the direction of the jaw
_ACROSS = 0.2  # cosine up to which axes are perpendicular
_LEAST_TRAVEL = 0.005  # [m] of the opening


def one_moves(sweep: HandSweep) -> bool:
    """Return whether one joint alone moves the hand."""
    return len(sweep.joint_names) == 1


def measure_jaw(model: MjModel, hand: int, sweep: HandSweep, surface: HandSurface) -> HandShape:
    """Measure a hand whose only joint moves one jaw.

    Args:
        model: the arm.
        hand: body that carries the fixed jaw.
        sweep: motion of the joint over its range.
        surface: points on the hand.

    Raises:
        RobotFileError: there is no fixed jaw opposite to the moving one.
    """
    if _is_closed_last(surface):
        sweep = reversed_sweep(sweep)
        surface = HandSurface(surface.points[::-1], surface.body, surface.moves)
    axes = _axes(model, hand, sweep, surface)
    points, moves = surface.points @ axes.T, surface.moves
    if points[-1, moves, 1].mean() < points[0, moves, 1].mean():  # the jaw opens towards +y
        axes = axes * np.array([[-1.0], [-1.0], [1.0]])
        points = surface.points @ axes.T
    first, last = _usable(points, moves)
    fixed_pad = find_pads(points[[first, last]], moves, _opposite(points[first], moves))[1]
    pad = points[0, fixed_pad]
    half_height = float(np.clip(np.ptp(pad[:, 2]) / 2, *_PAD_HALF_HEIGHT))
    tcp = np.array(
        [0.5 * (pad[:, 0].min() + pad[:, 0].max()), pad[:, 1].max(), pad[:, 2].max() - half_height]
    )
    local = points[first : last + 1] - tcp
    gaps = np.array([_opening(station[moves]) for station in local])
    used = slice(int(gaps.argmin()), len(gaps))
    local, gaps = local[used], gaps[used]
    if gaps[-1] - max(gaps[0], 0.0) < _LEAST_TRAVEL:
        raise RobotFileError(
            f"the jaw opens from {1e3 * gaps[0]:.1f} to {1e3 * gaps[-1]:.1f} mm only: name the joint that "
            "opens and closes the hand in [gripper] joints"
        )
    stations = slice(first + used.start, last + 1)
    motion = HandSweep(sweep.joint_names, sweep.positions[stations], sweep.qpos[stations], 1)
    fingers = finger_motion(motion, gaps)
    geometry = _geometry(local, gaps, moves, half_height, fingers.widths)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes.T, axes.T @ tcp
    return HandShape(model.body(hand).name, T, geometry, fingers, local[-1])


def _is_closed_last(surface: HandSurface) -> bool:
    """Return whether the outer part of the jaw is nearest to the fixed parts at the last station."""
    if not surface.moves.any() or surface.moves.all():
        raise RobotFileError("only one finger moves, and nothing of the hand is opposite to it")
    moving = surface.points[:, surface.moves]
    tree = KDTree(surface.points[0, ~surface.moves])
    outer = np.linalg.norm(moving[-1] - moving[0], axis=1)
    outer = outer > _OUTER * outer.max()
    distances = [float(np.mean(tree.query(moving[k, outer])[0])) for k in (0, -1)]
    return distances[1] < distances[0]


def _axes(model: MjModel, hand: int, sweep: HandSweep, surface: HandSurface) -> Float[np.ndarray, "3 3"]:
    """Return x, closing direction y and approach z as rows, in the hand body's frame, but for their sign."""
    data = mujoco.MjData(model)
    data.qpos[:] = sweep.qpos[0]
    mujoco.mj_kinematics(model, data)
    R, joint = data.xmat[hand].reshape(3, 3), model.joint(sweep.joint_names[0])
    axis = R.T @ data.xaxis[joint.id]
    moving = surface.points[0, surface.moves]
    start = R.T @ (data.xanchor[joint.id] - data.xpos[hand])
    if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE:
        start = surface.points[0, ~surface.moves].mean(axis=0)
    reach = np.linalg.norm(np.cross(moving - start, axis), axis=1)
    outward = moving[reach > _OUTER * reach.max()].mean(axis=0) - start
    outward = outward - (outward @ axis) * axis
    outward /= np.linalg.norm(outward)
    wrist = model.jnt_axis[model.body_jntadr[hand]]
    candidates = [sign * a for a in (wrist, *np.eye(3)) for sign in (1.0, -1.0)]
    likely = [a for a in candidates if abs(a @ axis) < _ACROSS and a @ outward > _ALONG]
    approach = likely[0] if likely else outward
    approach = approach - (approach @ axis) * axis
    approach /= np.linalg.norm(approach)
    if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE:
        return np.array([np.cross(axis, approach), axis, approach])
    return np.array([axis, np.cross(approach, axis), approach])


def _usable(points: Float[np.ndarray, "k n 3"], moves: Bool[np.ndarray, "n"]) -> tuple[int, int]:
    """Return the first and last station at which the moving tip is next to the fixed one."""
    tips = points[:, moves, 2].max(axis=1)
    high = np.flatnonzero(tips < tips.max() - _RISE)
    lowest = int(tips.argmax())
    first = int(max(high[high < lowest], default=-1)) + 1
    last = int(min(high[high > lowest], default=len(tips))) - 1
    return first, last


def _opposite(points: Float[np.ndarray, "n 3"], moves: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return which fixed points are beside the jaw along its closing direction."""
    low, high = points[moves, 0].min(), points[moves, 0].max()
    return ~moves & (points[:, 0] > low - _BESIDE) & (points[:, 0] < high + _BESIDE)


def _opening(moving: Float[np.ndarray, "m 3"]) -> float:
    """Return the distance [m] of the moving jaw from the plane of the fixed pad, where it is nearest."""
    near = moving[moving[:, 2] > -_HELD]
    return float(near[:, 1].min())


def _geometry(
    local: Float[np.ndarray, "k n 3"],
    gaps: Float[np.ndarray, "k"],
    moves: Bool[np.ndarray, "n"],
    half_height: float,
    widths: Float[np.ndarray, "w"],
) -> GripperGeometry:
    """Return the dimensions for planning, of the thicker one of the two jaws."""
    outer = np.where(moves, local[..., 1] - gaps[:, None], -local[..., 1])  # from the pads' faces outwards
    palm = _palm(local[0], outer[0], moves)
    z, x = local[..., 2], np.abs(local[..., 0])
    finger = z > -palm
    lower, inserted = finger & (z > -half_height), finger & (z > -_INSERTED)
    behind = local[(z < -palm + SLICE) & (z > -palm - 0.1)]
    half_length = max(np.abs(behind[:, 1] - middle).max(initial=0.02) for middle in (0.0, widths[-1] / 2))
    return GripperGeometry(
        max_width=float(widths[-1]),
        pad_half_height=half_height,
        pad_thickness=max(float(outer[lower].max()), 0.002),
        tip=float(z.max()),
        finger_thickness=max(float(outer[inserted].max()), 0.002),
        finger_reach=max(float(outer[finger].max()), 0.002),
        palm=palm,
        palm_half_length=float(half_length),
        palm_half_width=float(np.abs(behind[:, 0]).max(initial=0.02)),
        min_width=float(widths[0]),
        finger_half_width=float(x[inserted].max()),
        one_jaw=True,
    )


def _palm(
    local: Float[np.ndarray, "n 3"], outer: Float[np.ndarray, "n"], moves: Bool[np.ndarray, "n"]
) -> float:
    """Return the distance from the TCP back to where the jaws end and the palm begins, closed."""
    thick = (outer > _FINGER_DEPTH) | (np.abs(local[:, 0]) > _FINGER_HALF_WIDTH)
    between = ~moves & (local[:, 1] > _BETWEEN)
    palm = local[(thick | between) & (local[:, 2] < 0), 2]
    return float(-palm.max(initial=-0.15))
