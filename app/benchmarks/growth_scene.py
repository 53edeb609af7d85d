"""Inputs of the growth curves: tables with any number of objects and views, maps of any size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from perception.io.recordings.sequence import without_pose
from perception.slam.landmarks import Landmark, LandmarkMap
from perception.slam.system import Slam
from perception.types import ObjectDetection, RgbdFrame, SupportPlane

MAX_VIEWS = 20
_VIEW_STEP = 0.12  # [m] between successive views
_VIEW_TURN = np.radians(12.0)
_OBJECTS_AT = 10  # objects for which the default table is laid out
_DISTANCE = 1.3  # of the cameras relative to the default, from where all objects are in view
_LOOK_AT = 0.03  # [m] half side of the square that the cameras look at
_AWAY = 2.0  # [m] from a landmark to its copies, which are not in view
_MIN_PIXELS = 120  # of a mask


@dataclass(frozen=True)
class TableViews:
    """Posed views of a table with the true masks.

    Attributes:
        frames: Images with camera poses.
        masks: Detections of each frame, whose instance ids are the objects' numbers.
    """

    frames: tuple[RgbdFrame, ...]
    masks: tuple[tuple[ObjectDetection, ...], ...]

    def spread(self, count: int) -> TableViews:
        """Return ``count`` views that are as far apart as possible."""
        chosen = np.linspace(0, len(self.frames) - 1, count).round().astype(int)
        return TableViews(tuple(self.frames[i] for i in chosen), tuple(self.masks[i] for i in chosen))


def table_views(objects: int, views: int, seed: int) -> TableViews:
    """Render a table on which a number of objects stand, as dense as the default one."""
    from sim_assets.datasets.sequences import SequenceConfig, TableSequence

    default = SequenceConfig()
    wider = np.sqrt(objects / _OBJECTS_AT)
    distance = _DISTANCE * max(wider, 1.0) * np.array(default.distance)
    config = replace(
        default,
        objects=objects,
        spread=default.spread * wider,
        distance=(float(distance[0]), float(distance[1])),
        look_at=_LOOK_AT,
        frames=views,
        step=_VIEW_STEP,
        turn=_VIEW_TURN,
    )
    table = TableSequence(seed, config)
    images = list(table.render())
    masks = tuple(
        tuple(
            ObjectDetection(item.model.category, 1.0, image.instances == k, instance_id=k)
            for k, item in enumerate(table.objects)
            if np.count_nonzero(image.instances == k) >= _MIN_PIXELS
        )
        for image in images
    )
    return TableViews(tuple(image.frame for image in images), masks)


def sequence(objects: int, frames: int, seed: int) -> list[RgbdFrame]:
    """Render a slow sequence, whose frames but the first have no pose; the objects are near the centre."""
    from sim_assets.datasets.sequences import SequenceConfig, TableSequence

    spread = SequenceConfig().spread * np.sqrt(objects / _OBJECTS_AT)
    config = SequenceConfig(objects=objects, frames=frames, spread=float(spread), look_at=_LOOK_AT)
    rendered = [image.frame for image in TableSequence(seed, config).render()]
    return [rendered[0], *(without_pose(frame) for frame in rendered[1:])]


def enlarge_map(slam: Slam, size: int) -> None:
    """Add copies of the landmarks, out of view, until the map has a size."""
    mapper = slam.mapper
    assert mapper is not None
    mapper.world = enlarged(mapper.world, size)
    mapper.next_id = max(mapper.world.ids) + 1


def enlarged(world: LandmarkMap, size: int) -> LandmarkMap:
    """Return a map with copies of its landmarks, out of view, until it has a size."""
    originals, first = [world.landmarks[id] for id in world.ids], max(world.ids) + 1
    count = max(size - len(originals), 0)
    return world.with_landmarks(
        *(_copy(originals[k % len(originals)], first + k, 1 + k // len(originals)) for k in range(count))
    )


def _copy(landmark: Landmark, id: int, row: int) -> Landmark:
    pose = landmark.state.pose
    moved = replace(pose, translation=pose.translation + np.array([_AWAY * row, 0.0, 0.0]))
    return replace(landmark, id=id).with_state(replace(landmark.state, pose=moved))


def plane_of_table() -> SupportPlane:
    """Return the table top of the rendered scenes."""
    return SupportPlane(np.array([0.0, 0.0, 1.0]), 0.0)


def n_masks(masks: Sequence[Sequence[ObjectDetection]]) -> int:
    """Return the number of distinct objects in the masks."""
    return len({found.instance_id for row in masks for found in row})
