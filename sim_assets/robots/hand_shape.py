"""Shape of a parallel hand, measured on its collision geoms while the fingers move.

Convention of the tool frame (TCP): z out of the hand, y the closing direction, origin between the pads.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from manipulation.robot import FingerMotion, GripperGeometry
from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import MjModel, mujoco
from sim_assets.robots.finger_motion import HandSweep, is_below

_SPACING = 0.004  # [m] between points on a geom
_SLICE = 0.003  # [m] height of the slices across the approach
_PAD_DEPTH = 0.0015  # [m] by which points of a pad may lie behind its face
_PAD_HALF_HEIGHT = 0.0095  # [m]; of longer pads the part at the fingertips is used
_FINGER_DEPTH = 0.032  # [m] from the pad's face; what reaches further out belongs to the palm
_FINGER_HALF_WIDTH = 0.03  # [m], the same across the closing direction
_INSERTED = 0.035  # [m] of the fingers above the TCP that may enter a cavity
_SNAP = np.cos(np.deg2rad(15))  # axes this near to one of a body's are that axis
_ALONG = np.cos(np.deg2rad(50))  # largest angle of the approach to the direction from the palm to the fingers


@dataclass(frozen=True)
class HandShape:
    """Measured hand.

    Attributes:
        body: name of the body that carries the hand.
        T_body_tcp: (4, 4) pose of the tool frame in that body.
        geometry: dimensions for planning.
        fingers: joint positions over the opening between the pads.
        points: (n, 3) points on the hand's surface in the tool frame, fingers open, in [m].
    """

    body: str
    T_body_tcp: Float[np.ndarray, "4 4"]
    geometry: GripperGeometry
    fingers: FingerMotion
    points: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class _Surface:
    """Points on the hand's collision geoms at every station of a sweep, in the hand body's frame.

    Attributes:
        points: (k, n, 3) in [m], stations from closed to open or reverse.
        body: (n,) body of each point.
        moves: (n,) whether the point moves with the fingers.
    """

    points: Float[np.ndarray, "k n 3"]
    body: Int[np.ndarray, "n"]
    moves: Bool[np.ndarray, "n"]


def measure_hand(model: MjModel, arm_joints: tuple[str, ...], sweep: HandSweep) -> HandShape:
    """Measure a hand whose collision geoms have a non-zero ``contype``.

    Raises:
        RobotFileError: there are no two fingers that move towards each other.
    """
    hand = int(model.joint(arm_joints[-1]).bodyid[0])
    surface = _surface(model, hand, sweep)
    axes = _axes(model, hand, sweep, surface)  # rows x, y, z in the hand body's frame
    points = surface.points @ axes.T
    left, right = _sides(points, surface)
    pads = _pads(points, left, right)
    gaps = np.array([station[pads[0], 1].min() - station[pads[1], 1].max() for station in points])
    if gaps[0] > gaps[-1]:
        points, gaps, sweep = points[::-1], gaps[::-1], _reversed(sweep)
    if gaps[-1] - max(gaps[0], 0.0) < 0.005:
        raise RobotFileError(
            f"the fingers open from {1e3 * gaps[0]:.1f} to {1e3 * gaps[-1]:.1f} mm only: name the joints "
            "that open and close the hand in [gripper] joints"
        )
    fingers = _finger_motion(sweep, gaps)
    tcp, geometry = _geometry(points, pads, (left, right), surface.moves, fingers.widths)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes.T, axes.T @ tcp
    return HandShape(model.body(hand).name, T, geometry, fingers, points[-1] - tcp)


def _surface(model: MjModel, hand: int, sweep: HandSweep) -> _Surface:
    geoms = [
        g
        for g in range(model.ngeom)
        if model.geom_contype[g] and is_below(model, int(model.geom_bodyid[g]), hand)
    ]
    if not geoms:
        raise RobotFileError("the hand has no collision geoms: there is nothing to grasp with")
    local = {g: geom_points(model, g) for g in geoms}
    data = mujoco.MjData(model)
    stations = []
    for qpos in sweep.qpos:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        R, p = data.xmat[hand].reshape(3, 3), data.xpos[hand]
        parts = [local[g] @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g] for g in geoms]
        stations.append((np.concatenate(parts) - p) @ R)
    points = np.array(stations)
    body = np.concatenate([np.full(len(local[g]), model.geom_bodyid[g]) for g in geoms])
    moving = {b for b in set(body.tolist()) if np.ptp(points[:, body == b], axis=0).max() > 1e-3}
    return _Surface(points, body, np.isin(body, list(moving)))


def geom_points(model: MjModel, geom: int) -> Float[np.ndarray, "n 3"]:
    """Return points on a geom's surface, meshes by their convex hulls as in collision."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        start = model.mesh_vertadr[mesh]
        shape = trimesh.convex.convex_hull(model.mesh_vert[start : start + model.mesh_vertnum[mesh]])
    elif kind == types.mjGEOM_BOX:
        shape = trimesh.creation.box(extents=2 * size)
    elif kind == types.mjGEOM_SPHERE:
        shape = trimesh.creation.icosphere(2, float(size[0]))
    elif kind == types.mjGEOM_ELLIPSOID:
        shape = trimesh.creation.icosphere(2, 1.0)
        shape.apply_scale(size)
    elif kind == types.mjGEOM_CYLINDER:
        shape = trimesh.creation.cylinder(float(size[0]), float(2 * size[1]), sections=24)
    else:
        shape = trimesh.creation.capsule(float(2 * size[1]), float(size[0]), count=[16, 16])
    vertices = trimesh.remesh.subdivide_to_size(shape.vertices, shape.faces, _SPACING, max_iter=12)[0]
    kept = np.unique(np.round(vertices / (_SPACING / 4)).astype(np.int64), axis=0, return_index=True)[1]
    return vertices[kept]


def _axes(model: MjModel, hand: int, sweep: HandSweep, surface: _Surface) -> Float[np.ndarray, "3 3"]:
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


def _sides(points: Float[np.ndarray, "k n 3"], surface: _Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return which moving points belong to the finger on the side of +y, and to the one of -y."""
    travel = points[-1, :, 1] - points[0, :, 1]
    of_body = np.zeros(len(travel))
    for body in np.unique(surface.body[surface.moves]):  # links turn: their mean identifies the finger
        of_body[surface.body == body] = travel[surface.body == body].mean()
    height = points[-1, :, 1] - points[-1, surface.moves, 1].mean()
    opens = np.sign(height[surface.moves] @ of_body[surface.moves]) or 1.0
    return surface.moves & (opens * of_body > 0), surface.moves & (opens * of_body < 0)


def _pads(
    points: Float[np.ndarray, "k n 3"], left: Bool[np.ndarray, "n"], right: Bool[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "_a"], Int[np.ndarray, "_b"]]:
    """Return the points of both pads: where the fingers are nearest to each other in the closed hand."""
    if not left.any() or not right.any():
        raise RobotFileError("the fingers do not move towards each other: check [gripper] joints")
    first, last = _gap(points[0], left, right), _gap(points[-1], left, right)
    closed, opened = (points[0], points[-1]) if first < last else (points[-1], points[0])
    bins = np.floor(closed[:, 2] / _SLICE).astype(int)
    gaps, openings = {}, {}
    for b in np.intersect1d(bins[left], bins[right]).tolist():
        on_left, on_right = left & (bins == b), right & (bins == b)
        gaps[b] = closed[on_left, 1].min() - closed[on_right, 1].max()
        openings[b] = opened[on_left, 1].min() - opened[on_right, 1].max()
    if not gaps:
        raise RobotFileError("the fingers are not opposite to each other: check [gripper] joints")
    # Brackets and linkages near the palm are close to each other in the opened hand as well.
    gaps = {b: gap for b, gap in gaps.items() if openings[b] > 0.5 * max(openings.values())}
    least = min(gaps.values())
    runs = _runs([b for b, gap in sorted(gaps.items()) if gap < least + 2 * _PAD_DEPTH])
    run = max(runs, key=lambda run: (run[1] - run[0] >= 2, run[1]))  # the one at the fingertips
    inside = (bins >= run[0]) & (bins <= run[1])
    face_left = closed[left & inside, 1].min()
    face_right = closed[right & inside, 1].max()
    on_left = left & inside & (closed[:, 1] < face_left + _PAD_DEPTH)
    on_right = right & inside & (closed[:, 1] > face_right - _PAD_DEPTH)
    return np.flatnonzero(on_left), np.flatnonzero(on_right)


def _gap(station: np.ndarray, left: np.ndarray, right: np.ndarray) -> float:
    return float(station[left, 1].mean() - station[right, 1].mean())


def _runs(values: list[int]) -> list[tuple[int, int]]:
    """Return first and last of each run of consecutive integers, one missing value allowed."""
    runs = [(values[0], values[0])]
    for before, value in itertools.pairwise(values):
        runs = [*runs[:-1], (runs[-1][0], value)] if value - before <= 2 else [*runs, (value, value)]
    return runs


def _reversed(sweep: HandSweep) -> HandSweep:
    return HandSweep(sweep.joint_names, sweep.positions[::-1], sweep.qpos[::-1], sweep.n_driven)


def _finger_motion(sweep: HandSweep, gaps: Float[np.ndarray, "k"]) -> FingerMotion:
    """Return the motion over increasing openings; pads that would penetrate each other count as closed."""
    widths, positions = [], []
    for gap, position in zip(gaps, sweep.positions, strict=True):
        if not widths or gap > widths[-1] + 1e-5:
            widths.append(float(gap))
            positions.append(position)
    table, columns = np.array(widths), np.array(positions)
    if table[0] < 0:
        at_zero = np.array([np.interp(0.0, table, column) for column in columns.T])
        keep = table > 1e-4
        table, columns = np.append(0.0, table[keep]), np.vstack([at_zero, columns[keep]])
    return FingerMotion(sweep.joint_names, table, columns, sweep.n_driven)


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
    behind = behind[(behind[..., 2] < -palm + _SLICE) & (behind[..., 2] > -palm - 0.1)]
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
