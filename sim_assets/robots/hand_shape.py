"""Shape of a parallel hand, measured on its collision geoms while the fingers move.

Hands with two moving fingers; ``jaw_shape`` measures those with one.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from manipulation.robot import GripperGeometry
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.finger_motion import HandSweep, is_below
from sim_assets.robots.hand_pads import SLICE, find_pads, finger_motion, reversed_sweep
from sim_assets.robots.hand_surface import HandShape, HandSurface, hand_surface
from sim_assets.robots.jaw_shape import measure_jaw, one_moves

_PAD_HALF_HEIGHT = 0.0095  # [m]; of longer pads the part at the fingertips is used
_FINGER_DEPTH = 0.032  # [m] from the pad's face; what reaches further out belongs to the palm
_FINGER_HALF_WIDTH = 0.03  # [m], the same across the closing direction
_MAX_TURN = np.deg2rad(10)  # of the pads while the hand opens
_INSERTED = 0.035  # [m] of the fingers above the TCP that may enter a cavity
_SNAP = np.cos(np.deg2rad(15))  # axes this near to one of a body's are that axis
_ALONG = np.cos(np.deg2rad(50))  # largest angle of the approach to the direction from the palm to the fingers


def measure_hand(model: MjModel, arm_joints: tuple[str, ...], sweep: HandSweep) -> HandShape:
    """Measure a hand whose collision geoms have a non-zero ``contype``.

    Raises:
        RobotFileError: there are neither two fingers that move towards each other nor a jaw that moves
            towards a fixed one.
    """
    hand = int(model.joint(arm_joints[-1]).bodyid[0])
    surface = hand_surface(model, hand, sweep)
    if one_moves(sweep):
        return measure_jaw(model, hand, sweep, surface)
    axes = _axes(model, hand, sweep, surface)  # rows x, y, z in the hand body's frame
    points = surface.points @ axes.T
    left, right = _sides(points, surface)
    pads = find_pads(points, left, right)
    gaps = np.array([station[pads[0], 1].min() - station[pads[1], 1].max() for station in points])
    if gaps[0] > gaps[-1]:
        points, gaps, sweep = points[::-1], gaps[::-1], reversed_sweep(sweep)
    if gaps[-1] - max(gaps[0], 0.0) < 0.005:
        raise RobotFileError(
            f"the fingers open from {1e3 * gaps[0]:.1f} to {1e3 * gaps[-1]:.1f} mm only: name the joints "
            "that open and close the hand in [gripper] joints"
        )
    _require_parallel(surface, pads)
    fingers = finger_motion(sweep, gaps)
    tcp, geometry = _geometry(points, pads, (left, right), surface.moves, fingers.widths)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes.T, axes.T @ tcp
    return HandShape(model.body(hand).name, T, geometry, fingers, points[-1] - tcp)


def _require_parallel(
    surface: HandSurface, pads: tuple[Int[np.ndarray, "_a"], Int[np.ndarray, "_b"]]
) -> None:
    """Raise RobotFileError if the bodies of the pads turn much while the hand opens."""
    for pad in pads:
        body = surface.body == np.bincount(surface.body[pad]).argmax()
        shapes = [points[body] - points[body].mean(axis=0) for points in surface.points[[0, -1]]]
        turn = Rotation.align_vectors(*shapes)[0].magnitude()
        if turn > _MAX_TURN:
            raise RobotFileError(
                f"the pads turn by {np.rad2deg(turn):.0f} degrees while the hand opens, those of a parallel "
                "hand by none: check what couples its joints (equality, tendon) and their ranges"
            )


def _axes(model: MjModel, hand: int, sweep: HandSweep, surface: HandSurface) -> Float[np.ndarray, "3 3"]:
    """Return closing direction y, approach z and x as rows, in the hand body's frame."""
    first, last = surface.points[0], surface.points[-1]
    bodies = [int(b) for b in np.unique(surface.body) if surface.moves[surface.body == b].all()]
    shifts = {b: (last - first)[surface.body == b].mean(axis=0) for b in bodies}
    if not shifts:
        raise RobotFileError("no collision geom of the hand moves with the joints of [gripper]")
    main = max(shifts.values(), key=lambda shift: float(np.linalg.norm(shift)))
    sides = [[s for s in shifts.values() if sign * (s @ main) > 0] for sign in (1, -1)]
    if not sides[1]:
        raise RobotFileError("only one finger moves: a parallel hand with two moving fingers is needed")
    candidates = _body_axes(model, hand, sweep, bodies)
    closing = _snapped(np.mean(sides[0], axis=0) - np.mean(sides[1], axis=0), candidates)
    outward = surface.points[0, surface.moves].mean(axis=0)
    fixed = surface.points[0, ~surface.moves]
    outward = outward - (fixed.mean(axis=0) if len(fixed) else 0.0)
    outward = outward - (outward @ closing) * closing
    outward /= np.linalg.norm(outward)
    wrist = model.jnt_axis[model.body_jntadr[hand]]  # most hands are mounted along the last joint's axis
    likely = [
        axis for axis in (wrist, -wrist, *candidates) if abs(axis @ closing) < 0.2 and axis @ outward > _ALONG
    ]
    moving = surface.points[0, surface.moves]
    approach = min(likely, key=lambda z: float(np.ptp(moving @ np.cross(closing, z))), default=outward)
    approach = approach - (approach @ closing) * closing
    approach /= np.linalg.norm(approach)
    return np.array([np.cross(closing, approach), closing, approach])


def _body_axes(model: MjModel, hand: int, sweep: HandSweep, bodies: list[int]) -> list[np.ndarray]:
    """Return the axes of the hand and its fingers, both directions of each, in the hand body's frame."""
    data = mujoco.MjData(model)
    data.qpos[:] = sweep.qpos[0]
    mujoco.mj_kinematics(model, data)
    R = data.xmat[hand].reshape(3, 3)
    fixed = [b for b in range(model.nbody) if is_below(model, b, hand) and not model.body_dofnum[b]]
    frames = [R.T @ data.xmat[body].reshape(3, 3) for body in (hand, *fixed, *bodies)]
    return [sign * axis for frame in frames for axis in frame.T for sign in (1.0, -1.0)]


def _snapped(direction: np.ndarray, candidates: list[np.ndarray]) -> Float[np.ndarray, "3"]:
    """Return the candidate nearest to a direction if it is near, else the direction, of length 1."""
    direction = direction / np.linalg.norm(direction)
    nearest = max(candidates, key=lambda axis: float(axis @ direction), default=direction)
    return nearest if nearest @ direction > _SNAP else direction


def _sides(points: Float[np.ndarray, "k n 3"], surface: HandSurface) -> tuple[np.ndarray, np.ndarray]:
    """Return which moving points belong to the finger on the side of +y, and to the one of -y."""
    travel = points[-1, :, 1] - points[0, :, 1]
    of_body = np.zeros(len(travel))
    for body in np.unique(surface.body[surface.moves]):  # links turn: their mean identifies the finger
        of_body[surface.body == body] = travel[surface.body == body].mean()
    height = points[-1, :, 1] - points[-1, surface.moves, 1].mean()
    opens = np.sign(height[surface.moves] @ of_body[surface.moves]) or 1.0
    return surface.moves & (opens * of_body > 0), surface.moves & (opens * of_body < 0)


def _geometry(
    points: Float[np.ndarray, "k n 3"],
    pads: tuple[np.ndarray, np.ndarray],
    sides: tuple[np.ndarray, np.ndarray],
    moves: Bool[np.ndarray, "n"],
    widths: Float[np.ndarray, "w"],
) -> tuple[Float[np.ndarray, "3"], GripperGeometry]:
    """Return the origin of the tool frame, in the axes' frame, and the dimensions for planning."""
    pad = points[:, np.concatenate(pads)]
    ends = pad[:, :, 2].max(axis=1)  # fingertip side of the pads at each station
    half_height = min(float(np.ptp(pad[0, :, 2])) / 2, _PAD_HALF_HEIGHT)
    opened = points[-1]
    center_x = 0.5 * (pad[..., 0].min() + pad[..., 0].max())
    center_y = 0.5 * (opened[pads[0], 1].min() + opened[pads[1], 1].max())
    tcp = np.array([center_x, center_y, 0.5 * (ends.min() + ends.max()) - half_height])
    tip = float(points[:, moves, 2].max() - tcp[2])
    local = opened - tcp
    face = 0.5 * float(widths[-1])
    palm = _palm(local, moves, face)
    finger = moves & (local[:, 2] > -palm)
    outer = np.abs(local[:, 1]) - face
    lower = finger & (local[:, 2] > -half_height)
    inserted = finger & (local[:, 2] > -_INSERTED)
    behind = points - tcp
    behind = behind[(behind[..., 2] < -palm + SLICE) & (behind[..., 2] > -palm - 0.1)]
    return tcp, GripperGeometry(
        max_width=float(widths[-1]),
        pad_half_height=half_height,
        pad_thickness=max(float(outer[lower].max()), 0.002),
        tip=tip,
        finger_thickness=max(float(outer[inserted].max()), 0.002),
        finger_reach=max(float(outer[finger].max()), 0.002),
        palm=palm,
        palm_half_length=float(np.abs(behind[:, 1]).max(initial=0.02)),
        palm_half_width=float(np.abs(behind[:, 0]).max(initial=0.02)),
        min_width=float(widths[0]),
        finger_half_width=float(np.abs(local[inserted, 0]).max()),
    )


def _palm(local: Float[np.ndarray, "n 3"], moves: Bool[np.ndarray, "n"], face: float) -> float:
    """Return the distance from the TCP back to where the fingers end and the palm begins."""
    wide = np.abs(local[:, 1]) - face > _FINGER_DEPTH
    thick = np.abs(local[:, 0]) > _FINGER_HALF_WIDTH
    palm = local[(~moves | wide | thick) & (local[:, 2] < 0), 2]
    return float(-palm.max(initial=-0.15))
