"""Parts of an object's masks that are not of it: what the instance network joined across a gap.

The cable beside a mug may be in its mask. Measured points that are neither near the surface of its shape nor
connected to points that are, as a handle is, belong to something else. Some views show the gap, in others one
is in front of the other.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.depth_cleaning import clean_frame
from perception.detection.geometry import points_of
from perception.inference.explanation import FAR, SAMPLES
from perception.metrics import SurfaceSamples
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame

GAP = 0.008  # [m] between neighbouring points of one object, at most
VIEWS = 2  # that show the gap, from which on points are stray in the other ones too


def without_stray_parts(
    frames: Sequence[RgbdFrame],
    rows: Sequence[Sequence[ObjectDetection]],
    estimates: Mapping[int, ObjectEstimate],
    ids: Collection[int],
) -> list[list[ObjectDetection]]:
    """Return the detections, those of some objects without the parts of their masks that are not of them.

    Args:
        frames: Images with camera poses.
        rows: Associated detections of each frame.
        estimates: Estimates of the objects, by id.
        ids: Objects whose masks are examined.
    """
    rng = np.random.default_rng(0)
    cleaned = [clean_frame(frame) for frame in frames]
    result = [list(row) for row in rows]
    for id in sorted(ids):
        surface = SurfaceSamples.of(estimates[id].mesh_world, rng, SAMPLES).tree
        places = {(k, n): d for k, row in enumerate(rows) for n, d in enumerate(row) if d.instance_id == id}
        views = {place: _FarPixels.of(cleaned[place[0]], d.mask, surface) for place, d in places.items()}
        clouds = [KDTree(view.points[view.is_stray]) for view in views.values() if view.is_stray.any()]
        for (k, n), view in views.items():
            stray = view.stray(clouds)
            if stray.any():
                result[k][n] = replace(result[k][n], mask=result[k][n].mask & ~stray)
    return result


@dataclass(frozen=True)
class _FarPixels:
    """Pixels of a mask that are far from the surface of the object's shape.

    Attributes:
        image: Which pixels of the image they are.
        points: (n, 3) what they measure in the world frame, in metres.
        is_stray: Whether a gap is seen between each of them and the object.
    """

    image: Bool[np.ndarray, "h w"]
    points: Float[np.ndarray, "n 3"]
    is_stray: Bool[np.ndarray, "n"]

    @staticmethod
    def of(frame: RgbdFrame, mask: Bool[np.ndarray, "h w"], surface: KDTree) -> _FarPixels:
        """Find them; connected ones of which none is beside a near point of the mask are stray."""
        far = mask & (frame.depth > 0)
        points = points_of(frame, far)
        is_far = surface.query(points, distance_upper_bound=2 * FAR)[0] > FAR
        near, points = points[~is_far], points[is_far]
        far[far] = is_far
        if not len(near) or not len(points):
            return _FarPixels(far, points, np.zeros(len(points), bool))
        is_beside = KDTree(near).query(points, distance_upper_bound=2 * GAP)[0] < GAP
        labels = cv2.connectedComponents(far.astype(np.uint8))[1][far]
        return _FarPixels(far, points, ~np.isin(labels, labels[is_beside]))

    def stray(self, clouds: Sequence[KDTree]) -> Bool[np.ndarray, "h w"]:
        """Return the pixels that are stray in this view or, by the stray points of all views, in enough."""
        seen = [cloud.query(self.points, distance_upper_bound=2 * GAP)[0] < GAP for cloud in clouds]
        stray = self.image.copy()
        stray[stray] = self.is_stray | (np.sum(seen, axis=0) >= VIEWS)
        return stray
