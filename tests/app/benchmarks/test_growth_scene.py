"""Views, masks and maps of the growth curves."""

from dataclasses import replace

import numpy as np
import pytest

from app.benchmarks.growth_scene import enlarged, n_masks, plane_of_table, sequence, table_views
from perception.inference.problem import FitState
from perception.inference.shape_model import linearise
from perception.rendering.pose import ObjectPose
from perception.shape.decoder import ShapeDecoder
from perception.slam.landmarks import Landmark, LandmarkMap, bounding_radius
from perception.types import CATEGORIES, CODE_SIZE


@pytest.fixture(scope="module")
def table():
    return table_views(objects=2, views=3, seed=1)


def test_a_table_has_its_views_and_the_masks_of_its_objects(table):
    assert len(table.frames) == 3 and n_masks(table.masks) == 2
    for frame, row in zip(table.frames, table.masks):
        for found in row:
            assert found.mask.any() and (frame.depth[found.mask] > 0).mean() > 0.9
    eyes = [frame.T_world_camera[:3, 3] for frame in table.frames]
    assert np.linalg.norm(eyes[0] - eyes[1]) > 0.05


def test_objects_stand_on_the_plane_of_the_table(table):
    frame = table.frames[0]
    points = frame.intrinsics  # the lowest measured points are those of the table
    v, u = np.nonzero(frame.depth > 0)
    z = frame.depth[v, u]
    camera = np.stack([(u - points.cx) / points.fx * z, (v - points.cy) / points.fy * z, z], axis=1)
    heights = (camera @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3])[:, 2]
    assert abs(np.median(heights) - plane_of_table().offset) < 0.02


def test_chosen_views_are_far_apart(table):
    assert table.spread(2).frames == (table.frames[0], table.frames[2])
    assert table.spread(3).frames == table.frames and table.spread(1).frames == table.frames[:1]


def test_only_the_first_frame_of_a_sequence_has_a_pose():
    frames = sequence(objects=1, frames=3, seed=1)
    assert [frame.T_world_camera is None for frame in frames] == [False, True, True]


@pytest.fixture(scope="module")
def landmark():
    shape = linearise(ShapeDecoder.load(), "mug", np.zeros(CODE_SIZE))
    state = FitState(ObjectPose(np.eye(3), np.zeros(3), np.full(3, 0.05)), np.zeros(CODE_SIZE))
    return Landmark(0, "mug", state, shape, bounding_radius(shape, state), 0.5, np.zeros(len(CATEGORIES)))


def test_a_map_grows_by_copies_out_of_view(landmark):
    world = LandmarkMap(plane_of_table()).with_landmarks(landmark, replace(landmark, id=4))
    large = enlarged(world, 7)
    assert large.ids == (0, 4, 5, 6, 7, 8, 9)
    assert large.landmarks[0] is landmark
    places = [large.landmarks[id].state.pose.translation[0] for id in large.ids]
    assert places == [0, 0, 2, 2, 4, 4, 6]
    assert enlarged(world, 1).ids == world.ids
