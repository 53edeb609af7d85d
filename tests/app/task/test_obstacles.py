"""Things of no class beside the object map: known geometry, pictures, rows of the report."""

import numpy as np
import pytest

from app.task.obstacles import (
    beside_box,
    bounds_of,
    box_interior,
    filled_bounds,
    known_bounds,
    obstacle_note,
    obstacle_rows,
    obstacles_beside,
    obstacles_during,
    portrait_of,
    table_of,
    unexplained_during,
)
from manipulation.types import Box
from perception.detection.left_out import of_no_class
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane
from sim_assets.robots import panda

CAMERA = CameraIntrinsics(480, 360, 450.0, 450.0, 239.5, 179.5)


def block(x, y, half=0.03, height=0.06):
    corners = [(x + a, y + b, c) for a in (-half, half) for b in (-half, half) for c in (0.0, height)]
    return PerceivedObstacle(0, (np.array(corners),), 1000)


def overhead(x, y, height=0.5, obstacle=None):
    """A view from straight above on the table and the flat top of a block."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, y, height
    depth = np.full((360, 480), height, np.float32)
    if obstacle is not None:
        (low, high), top = obstacle.bounds[:, :2], obstacle.bounds[1, 2]
        v, u = np.mgrid[:360, :480]
        at = np.stack(
            [x + (u - 239.5) / 450 * (height - top), y - (v - 179.5) / 450 * (height - top)], axis=-1
        )
        depth[((at > low) & (at < high)).all(axis=-1)] = height - top
    return RgbdFrame(0.0, np.zeros((360, 480, 3), np.uint8), depth, CAMERA, T)


def test_a_thing_on_the_table_is_found_and_one_in_the_robots_base_is_not():
    detections = Detections(SupportPlane(), ((),))
    frames = [overhead(0.5, -0.2, obstacle=block(0.5, -0.2))]
    (found,) = obstacles_beside([], frames, detections, Box(), panda().description)
    np.testing.assert_allclose(found.bounds.mean(axis=0)[:2], (0.5, -0.2), atol=0.006)
    at_base = [overhead(0.0, 0.0, obstacle=block(0.0, 0.0))]
    assert obstacles_beside([], at_base, detections, Box(), panda().description) == ()


def test_the_box_is_no_candidate_and_no_object_and_a_thing_beside_it_is():
    box = Box()
    wall = overhead(box.center[0], box.center[1], obstacle=block(*box.center, half=0.02, height=0.005))
    thing = overhead(0.5, -0.2, obstacle=block(0.5, -0.2, height=0.08))
    frames = (wall, thing)
    masks = [frame.depth < 0.5 for frame in frames]
    rows = tuple((ObjectDetection("can", 0.6, mask, instance_id=i),) for i, mask in enumerate(masks))
    candidates = tuple(of_no_class(mask, 0.9, i) for i, mask in enumerate(masks))
    detections = Detections(SupportPlane(), rows, left_out=candidates)
    beside = beside_box(known_bounds(box), frames, detections)
    assert beside.per_frame == ((), rows[1])
    assert beside.left_out == (candidates[1],)
    assert beside_box(known_bounds(None), frames, detections) == detections


def test_what_is_in_the_box_is_known_with_it():
    box = Box()
    packed = overhead(*box.center, obstacle=block(*box.center, half=0.02, height=0.1))
    mask = packed.depth < packed.depth.max() - 0.05
    detections = Detections(SupportPlane(), ((ObjectDetection("can", 0.6, mask, instance_id=0),),))
    assert beside_box(known_bounds(box), [packed], detections) == detections
    assert beside_box(filled_bounds(box), [packed], detections).per_frame == ((),)
    assert filled_bounds(None).shape == (0, 2, 3)


def test_the_interior_of_the_box_is_without_its_walls():
    box = Box(center=(0.5, 0.2), size=(0.3, 0.2, 0.1))
    (x0, x1), (y0, y1) = box_interior(box)
    np.testing.assert_allclose((x0, x1, y0, y1), (0.356, 0.644, 0.106, 0.294))


def test_during_a_run_what_stands_in_the_box_is_known():
    box, surface = Box(), table_of(Detections(SupportPlane(), ((),)))
    x, y = box.center
    arm = panda().description
    for thing, count in ((block(x, y, height=0.12), 0), (block(0.5, -0.2), 1)):
        middle = thing.bounds.mean(axis=0)
        frames = [overhead(middle[0], middle[1], obstacle=thing)]
        assert len(obstacles_during([], frames, surface, box, arm)) == count


def test_the_box_is_known_geometry():
    box = Box(center=(0.5, 0.2), size=(0.3, 0.2, 0.08))
    corners = known_bounds(box)
    np.testing.assert_allclose(corners[:, 0].min(axis=0), (0.35 - box.wall, 0.1 - box.wall, 0.0))
    np.testing.assert_allclose(corners[:, 1].max(axis=0), (0.65 + box.wall, 0.3 + box.wall, box.top))
    assert known_bounds(None).shape == (0, 2, 3)


def test_the_portrait_is_the_view_that_shows_all_of_a_thing_largest():
    thing = block(0.5, -0.2)
    near, cut = overhead(0.5, -0.2, 0.4), overhead(0.6, -0.2, 0.3)
    frames = [overhead(0.5, -0.2, 0.6), near, cut]
    portrait = portrait_of(thing, frames)
    assert portrait is not None and portrait.frame == 1
    rows, columns = portrait.window
    assert columns.stop - columns.start == pytest.approx(2 * 12 + 0.06 / 0.34 * 450, abs=2)
    assert portrait.picture(frames).shape == (rows.stop - rows.start, columns.stop - columns.start, 3)
    assert portrait_of(block(3.0, 3.0), [near]) is None


def test_rows_and_notes_name_place_and_size():
    thing = block(0.5, -0.2)
    (row,) = obstacle_rows([thing], [overhead(0.5, -0.2)])
    assert (row["name"], row["center"], row["size"]) == ("thing_0", [0.5, -0.2, 0.03], [0.06, 0.06, 0.06])
    assert row["image"] == 0 and len(row["box"]) == 4
    assert "image" not in obstacle_rows([thing], [])[0]
    assert obstacle_note(thing) == "thing_0: a thing of no class, 6 x 6 x 6 cm, at (0.50, -0.20) m is avoided"


def test_points_of_nothing_known(can_at):
    """Points of a can, a thing and the table, one above the box, and one that nothing explains."""
    can, thing, box = can_at(0), block(0.6, -0.3), Box()
    T = can.T_world_object
    on_can = max(can.mesh_world.vertices, key=lambda vertex: vertex[2])
    unknown = T[:3, 3] + (0.0, 0.0, 0.12)
    points = np.array(
        [on_can, (0.6, -0.3, 0.07), (0.4, -0.4, 0.01), (*box.center, 0.15), unknown], dtype=np.float64
    )
    surface = table_of(Detections(SupportPlane(), ((),)))
    found = unexplained_during(points, [can], [thing], surface, box)
    np.testing.assert_array_equal(found, points[4:])
    found = unexplained_during(points, [], [], surface, None)
    np.testing.assert_array_equal(found, points[[0, 1, 3, 4]])


def test_the_bounds_of_objects_are_those_of_their_meshes(can_at):
    near, far = can_at(0, 0.4), can_at(1, 0.5, 0.2)
    bounds = bounds_of([near, far])
    np.testing.assert_allclose(
        bounds[1] - bounds[0], np.tile([0.1, 0.2 - near.T_world_object[1, 3], 0.0], (2, 1))
    )
    np.testing.assert_allclose(bounds[0].mean(axis=0), near.mesh_world.vertices.mean(axis=0), atol=0.01)
    assert bounds_of([]).shape == (0, 2, 3)
