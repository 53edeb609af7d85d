"""Objects that touch and were segmented as one: masks are cut where the surface is concave or depth jumps.

Two convex objects form a crease where they touch, in most views (local convexity: Stein et al., "Object
partitioning using local convexity", CVPR 2014). Single objects have such places, too, at handles, necks and
openings: pieces are hypotheses, which fits must confirm.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.depth_cleaning import beside_jumps
from perception.detection.geometry import bounding_window
from perception.detection.unclassified import associate_candidates
from perception.types import ObjectDetection, RgbdFrame, SupportPlane, unclassified

Rows = Sequence[Sequence[ObjectDetection]]
Mask = Bool[np.ndarray, "h w"]

JUMP = 0.012  # [m] of depth between neighbouring pixels, from which on they belong to two surfaces
CREASE = np.radians(28)  # angle between the normals on both sides of a crease
SMALLEST, MIN_PIXELS = 0.06, 150  # pixels of a piece: relative to those of the mask, and at least
WHOLE = 0.96  # least share of a mask that is one piece
CUT_VIEWS = 2  # in which an instance is more than one piece, if it has as many
_BASELINE = 0.005  # [m] from a crease to the surfaces on both sides that are compared
_APART = 0.06  # [m] between their points, from which on they are not one surface
_SMOOTHING = 0.002  # [m] standard deviation of the filter that makes normals of noisy depth
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (rows, columns)


def touching_pieces(
    frames: Sequence[RgbdFrame], rows: Rows, ids: Collection[int], plane: SupportPlane, free_id: int
) -> list[list[ObjectDetection]]:
    """Return the detections of each frame with the pieces of instances, of no class, in place of these.

    Args:
        frames: Images without flying pixels, with camera poses.
        rows: Associated detections of each frame.
        ids: Instances that are cut; those that are one piece in nearly all of their views stay as they are.
        plane: Support plane.
        free_id: Least id of the pieces, which are associated across views.
    """
    cuts: dict[int, list[tuple[int, list[Mask]]]] = {id: [] for id in ids}
    n_cut = dict.fromkeys(ids, 0)
    for k, (frame, row) in enumerate(zip(frames, rows, strict=True)):
        for detection in row:
            if detection.instance_id in cuts:
                pieces = convex_pieces(frame, detection.mask)
                cuts[detection.instance_id].append((k, pieces))
                n_cut[detection.instance_id] += _is_cut(detection.mask, pieces)
    found: list[list[ObjectDetection]] = [[] for _ in frames]
    gone = {id for id, views in cuts.items() if n_cut[id] >= min(CUT_VIEWS, max(len(views), 1))}
    for k, pieces in (view for id in sorted(gone) for view in cuts[id]):
        found[k] += [unclassified(piece) for piece in pieces]
    associated = associate_candidates(frames, found, plane, free_id)
    return [
        [*(d for d in row if d.instance_id not in gone), *pieces]
        for row, pieces in zip(rows, associated, strict=True)
    ]


def convex_pieces(frame: RgbdFrame, mask: Mask) -> list[Mask]:
    """Return the parts of a mask between creases and jumps of depth, the largest first.

    Pixels beyond these that are far from any part are left out.

    Args:
        frame: Image without flying pixels.
        mask: Pixels of the instance.
    """
    if not (mask & (frame.depth > 0)).any():
        return []
    pixels_per_metre = frame.intrinsics.fx / float(np.median(frame.depth[mask & (frame.depth > 0)]))
    reach = max(3, round(_BASELINE * pixels_per_metre))
    window = bounding_window(mask, 2 * reach)
    inside, depth = mask[window], frame.depth[window].astype(np.float32)
    measured = inside & (depth > 0)
    points = _smooth_points(frame, window, measured, max(1.0, _SMOOTHING * pixels_per_metre))
    whole = measured & ~beside_jumps(measured, depth, JUMP) & ~_creases(points, measured, reach)
    opened = cv2.morphologyEx(whole.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels = cv2.connectedComponents(opened)
    size = np.bincount(labels.ravel(), minlength=count)
    least = max(MIN_PIXELS, SMALLEST * mask.sum())
    large = [k for k in np.argsort(-size, kind="stable").tolist() if k and size[k] >= least]
    if not large:
        return []
    away = [cv2.distanceTransform((labels != k).astype(np.uint8), cv2.DIST_L2, 3) for k in large]
    nearest = np.argmin(away, axis=0)
    pieces = []
    for number in range(len(large)):
        piece = np.zeros_like(mask)
        piece[window] = inside & (nearest == number) & (away[number] <= 2 * reach)
        pieces.append(piece)
    return pieces


def _is_cut(mask: Mask, pieces: Sequence[Mask]) -> bool:
    return len(pieces) > 1 or (len(pieces) == 1 and bool(pieces[0].sum() < WHOLE * mask.sum()))


def _smooth_points(
    frame: RgbdFrame, window: tuple[slice, slice], measured: Mask, sigma: float
) -> Float[np.ndarray, "h w 3"]:
    """Return the points of a window in the camera frame [m], their depth smoothed over ``sigma`` pixels."""
    weight = measured.astype(np.float32)
    depth = frame.depth[window].astype(np.float32) * weight
    smooth = cv2.GaussianBlur(depth, (0, 0), sigma) / np.maximum(
        cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6
    )
    k, (rows, columns) = frame.intrinsics, window
    v, u = np.mgrid[rows.start : rows.start + len(depth), columns.start : columns.start + depth.shape[1]]
    return np.stack([(u - k.cx) / k.fx * smooth, (v - k.cy) / k.fy * smooth, smooth], axis=-1)


def _creases(points: Float[np.ndarray, "h w 3"], measured: Mask, reach: int) -> Mask:
    """Return the pixels at which the surface is concave.

    It is where the normals n and points x on both sides, ``reach`` pixels away, have (n1 - n2) (x1 - x2) < 0.
    """
    normals = _normals(points)
    concave = np.zeros(measured.shape, bool)
    for rows, columns in _DIRECTIONS:
        first, second = (
            (_shifted(points, step), _shifted(normals, step), _shifted(measured, step))
            for step in ((reach * rows, reach * columns), (-reach * rows, -reach * columns))
        )
        across = first[0] - second[0]
        bent = np.einsum("hwc,hwc->hw", first[1], second[1]) < np.cos(CREASE)
        inwards = np.einsum("hwc,hwc->hw", first[1] - second[1], across) < 0
        near = np.linalg.norm(across, axis=-1) < _APART
        concave |= bent & inwards & near & first[2] & second[2]
    return concave


def _normals(points: Float[np.ndarray, "h w 3"], step: int = 2) -> Float[np.ndarray, "h w 3"]:
    """Return the unit normals towards the camera, from differences over twice ``step`` pixels."""
    along_u = _shifted(points, (0, -step)) - _shifted(points, (0, step))
    along_v = _shifted(points, (-step, 0)) - _shifted(points, (step, 0))
    normals = np.cross(along_v, along_u)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    away = np.einsum("hwc,hwc->hw", normals, points) > 0
    normals[away] *= -1
    return normals


def _shifted(image: np.ndarray, step: tuple[int, int]) -> np.ndarray:
    """Return an image moved by (rows, columns); what leaves it on one side enters it on the other."""
    return np.roll(image, step, axis=(0, 1))
