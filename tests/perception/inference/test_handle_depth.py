"""A mug in images, with the pose that is expected turned about its axis, and with walls beside it."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.inference.handle import body_axis
from perception.inference.handle_depth import shows_handle
from perception.types import ObjectEstimate, RgbdFrame, TriangleMesh

AZIMUTHS = (0.3, 1.5, 2.7)


@pytest.fixture(scope="module")
def frames(mug) -> list[RgbdFrame]:
    rng = np.random.default_rng(5)
    return [mug.frame(mug.camera(azimuth), rng)[0] for azimuth in AZIMUTHS]


def turned(mug, estimate, degrees):
    turn = np.array([0.0, 0.0, np.deg2rad(degrees)])
    pose = mug.pose.turned(turn, body_axis(estimate))
    return replace(estimate, T_world_object=pose.T_world_object)


@pytest.mark.parametrize(
    ("degrees", "shown"), [(0, True), (-4, True), (24, False), (-24, False), (90, False), (180, False)]
)
def test_a_handle_is_shown_where_it_is(mug, estimate, frames, degrees, shown):
    assert shows_handle(turned(mug, estimate, degrees), frames) == shown


def test_a_handle_out_of_view_is_not_shown(mug, estimate, frames):
    assert not shows_handle(turned(mug, estimate, 0), [])
    behind = mug.pose.T_world_object[:3, 0]
    azimuth = float(np.arctan2(-behind[1], -behind[0]))
    frame = mug.frame(mug.camera(azimuth), np.random.default_rng(5))[0]
    assert not shows_handle(turned(mug, estimate, 0), [frame])


def test_what_another_object_explains_is_no_handle(mug, estimate, frames):
    """The handle that is seen may be a thin object beside the mug."""
    own = turned(mug, estimate, 0)
    T = own.T_world_object
    shape = trimesh.creation.box((0.06, 0.03, 0.2))
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    reach = float(own.mesh.vertices[:, 0].max())
    place = np.eye(4)
    place[:3, :3] = T[:3, :3]
    place[:3, 3] = T[:3, :3] @ np.array([reach - 0.02, 0.0, 0.0]) + T[:3, 3]
    inside = ObjectEstimate(7, "can", np.zeros(16), place, np.full(3, 0.1), own_surface(own, place, mesh))
    assert not shows_handle(own, frames, [inside])
    place = place.copy()
    place[:3, 3] += 0.3 * T[:3, 0]
    apart = ObjectEstimate(7, "can", np.zeros(16), place, np.full(3, 0.1), mesh)
    assert shows_handle(own, frames, [apart])


def own_surface(own, place, mesh):
    """The part of the mug's surface inside a box at a pose, in the frame of the box."""
    T = np.linalg.inv(place) @ own.T_world_object
    vertices = own.mesh.vertices @ T[:3, :3].T + T[:3, 3]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    kept = ((vertices > low) & (vertices < high)).all(axis=1)
    return TriangleMesh(vertices, own.mesh.faces[kept[own.mesh.faces].all(axis=1)])
