"""Shapes of objects measured again where they stand upright and free.

Of what lies, or stands in or on something else, a part is hidden, and its size the least certain.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from perception.depth_cleaning import clean_frame
from perception.detection.completion import Completer
from perception.detection.geometry import points_of, touches_border
from perception.inference.explanation import unexplained
from perception.inference.reconstruct import reconstruct
from perception.inference.shape_model import Decoder
from perception.inference.stack_parts import instance_points
from perception.inference.standing_masks import standing_masks
from perception.metrics import SurfaceSamples
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

MOST_UNEXPLAINED = 0.04  # share of an object's measured points: more, and it does not stand there upright
MARGINS = (0.015, 0.08)  # [m] by which it may be wider and higher: nothing stands on it
_SAMPLES = 3000  # of a surface
NEAR = 0.02  # [m] between the axes of the estimates before and after


def remeasured(
    estimates: Mapping[int, ObjectEstimate],
    frames: Sequence[RgbdFrame],
    plane: SupportPlane,
    network: Completer,
    decoder: Decoder,
    ids: Collection[int] | None = None,
) -> dict[int, ObjectEstimate]:
    """Return upright objects as further images show them, by id.

    Those that no image shows whole, or that cannot be fitted, are missing.

    Args:
        estimates: Objects that stand on the plane, at their poses, by id.
        frames: Images of them, with camera poses.
        plane: Support plane.
        network: Predicts the yaw of mugs.
        decoder: Shape prior.
        ids: Those that are measured, which the others may hide; all if None.
    """
    views = [clean_frame(frame) for frame in frames]
    points = [points_of(view, view.depth > 0) for view in views]
    surfaces = {
        id: SurfaceSamples.of(estimate.mesh_world, np.random.default_rng(0), _SAMPLES)
        for id, estimate in estimates.items()
    }
    masks: list[list[ObjectDetection]] = [[] for _ in views]
    for id in sorted(estimates if ids is None else ids):
        category = estimates[id].category
        for k, mask in standing_masks(estimates[id], views, points, plane, surfaces, MARGINS).items():
            if not touches_border(mask):  # a tall object would become a lower one
                masks[k].append(ObjectDetection(category, 1.0, mask, instance_id=id))
    rows = [network.complete(view, plane, row) for view, row in zip(views, masks)]
    found = {e.id: e for e in reconstruct(frames, rows, decoder, plane)}
    return {
        id: replace(e, score=estimates[id].score)
        for id, e in found.items()
        if e.status != "implausible"
        and np.linalg.norm((e.T_world_object - estimates[id].T_world_object)[:2, 3]) < NEAR
        and unexplained(instance_points(views, rows, id), [e]) < MOST_UNEXPLAINED
    }
