"""Direction of a mug's handle: masks from depth, and what is made of the network's answers."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import nearest_yaw, pose_from_yaw, transform_points
from perception.inference.handle import (
    LEAST_TURN,
    SURE,
    handle_yaw,
    mask_around,
    sure_direction,
    turned_to_handle,
    with_seen_handles,
)
from perception.metrics import SurfaceSamples
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, SupportPlane, TriangleMesh

CAMERA = CameraIntrinsics(160, 120, 200.0, 200.0, 79.5, 59.5)
RADIUS, HEIGHT, REACH = 0.04, 0.09, 0.03
AT = np.array([0.5, -0.2, 0.0])
BINS = 36


def at(x, y, z):
    """A point relative to the mug."""
    return AT + np.array([x, y, z])


def block(low, high):
    """A box as a mesh."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return TriangleMesh(np.asarray(low) + corners * (np.asarray(high) - low), np.array(faces))


@pytest.fixture
def mug():
    """A square mug: body about the origin of the frame, handle along +x."""
    body = block((-RADIUS, -RADIUS, 0.0), (RADIUS, RADIUS, HEIGHT))
    handle = block((RADIUS, -0.006, 0.02), (RADIUS + REACH, 0.006, 0.07))
    faces = np.concatenate([body.faces, handle.faces + len(body.vertices)])
    mesh = TriangleMesh(np.concatenate([body.vertices, handle.vertices]), faces)
    return ObjectEstimate(1, "mug", np.zeros(16), pose_from_yaw(0.3, AT), np.ones(3), mesh, 0.9)


def seen_from_above(*boxes):
    """An image from 0.5 m above the table at ``AT`` of boxes in the world: (low, high) corners."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = at(0.0, 0.0, 0.5)
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    depth = np.full((CAMERA.height, CAMERA.width), 0.5)
    for low, high in sorted(boxes, key=lambda corners: corners[1][2]):
        z = 0.5 - high[2]
        x, y = AT[0] + (u - CAMERA.cx) * z / CAMERA.fx, AT[1] - (v - CAMERA.cy) * z / CAMERA.fy
        depth[(x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])] = z
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    return RgbdFrame(0.0, rgb, depth.astype(np.float32), CAMERA, T)


BODY = (at(-RADIUS, -RADIUS, 0.0), at(RADIUS, RADIUS, HEIGHT))
HANDLE = (
    at(-0.006, RADIUS, 0.0),
    at(0.006, RADIUS + REACH, 0.07),
)  # along +y, not where it is expected


class Network:
    """Answers with a peak at a yaw, of some probability; keeps the masks."""

    def __init__(self, yaw, share=1.0):
        self.answer = np.full(BINS, (1 - share) / BINS)
        self.answer[round(yaw / (2 * np.pi) * BINS) % BINS] += share
        self.masks = []

    def complete(self, frame, plane, detections):
        self.masks += [d.mask for d in detections]
        return [replace(d, yaw_probabilities=self.answer) for d in detections]


def test_the_mask_has_the_handle_wherever_it_is(mug) -> None:
    mask = mask_around(mug, seen_from_above(BODY, HANDLE), [])
    alone = mask_around(mug, seen_from_above(BODY), [])
    handle = mask & ~alone
    rows, columns = np.nonzero(handle)
    assert alone.sum() > 800 and handle.sum() > 70
    assert rows.max() < CAMERA.cy and abs(columns.mean() - CAMERA.cx) < 2, "above the body in the image"


def test_other_objects_and_the_table_are_not_in_the_mask(mug) -> None:
    beside = (at(RADIUS, -0.02, 0.0), at(RADIUS + 0.03, 0.02, 0.06))
    frame = seen_from_above(BODY, beside)
    other = SurfaceSamples.of(block(*beside), np.random.default_rng(0), 3000)
    with_it, without = (mask_around(mug, frame, others).sum() for others in ([], [other]))
    assert without == pytest.approx(mask_around(mug, seen_from_above(BODY), []).sum(), rel=0.05)
    assert with_it > 1.1 * without


def test_far_things_are_outside_of_the_mask(mug) -> None:
    frame = seen_from_above(BODY, (at(-0.14, -0.02, 0.0), at(-0.11, 0.02, 0.06)))
    assert mask_around(mug, frame, []).sum() == mask_around(mug, seen_from_above(BODY), []).sum()


def test_a_mug_behind_the_camera_has_no_mask(mug) -> None:
    frame = seen_from_above(BODY)
    T = frame.T_world_camera.copy()
    T[2, 3] = -0.2
    assert not mask_around(mug, replace(frame, T_world_camera=T), []).any()


def test_a_sure_direction_is_the_mean_of_its_neighbours() -> None:
    p = np.zeros(BINS)
    p[35], p[0], p[1] = 0.5, 0.5, 0.0
    assert sure_direction(p) == pytest.approx(np.radians(-5.0))
    p[0], p[18] = 0.5 - 1.05 * (1 - SURE), 1.05 * (1 - SURE)
    assert sure_direction(p) is None


@pytest.mark.parametrize("yaw", [1.5708, 3.1416])
def test_a_mug_is_turned_about_the_axis_of_its_body(mug, yaw) -> None:
    """The origin of the frame is elsewhere: between body and handle."""
    shift = np.array([0.012, 0.0, 0.04])
    mesh = TriangleMesh(mug.mesh.vertices - shift, mug.mesh.faces)
    T = mug.T_world_object.copy()
    T[:3, 3] = transform_points(T, shift[None])[0]
    moved = replace(mug, mesh=mesh, T_world_object=T)
    turned = turned_to_handle(moved, [seen_from_above(BODY)], [], SupportPlane(), Network(yaw))
    assert turned is not None
    assert np.cos(nearest_yaw(turned.T_world_object) - yaw) == pytest.approx(1.0, abs=1e-4)
    axis = transform_points(turned.T_world_object, -shift[None])[0]
    np.testing.assert_allclose(axis, AT, atol=1e-9)


def test_a_mug_stays_where_the_images_leave_it_open_or_show_it(mug) -> None:
    frame = [seen_from_above(BODY)]
    assert turned_to_handle(mug, frame, [], SupportPlane(), Network(2.0, share=0.3)) is None
    near = replace(mug, T_world_object=pose_from_yaw(np.radians(10) + 0.9 * LEAST_TURN, AT))
    assert turned_to_handle(near, frame, [], SupportPlane(), Network(np.radians(10))) is None
    assert handle_yaw(mug, [seen_from_above()], [], SupportPlane(), Network(2.0)) is None, "nothing measured"


def test_several_images_count_together(mug) -> None:
    network = Network(1.5708, share=0.6)
    assert handle_yaw(mug, [seen_from_above(BODY)], [], SupportPlane(), network) is None
    assert handle_yaw(mug, [seen_from_above(BODY)] * 3, [], SupportPlane(), network) is not None


def test_upright_mugs_alone_are_turned(mug) -> None:
    others = [replace(mug, id=2, category="can"), replace(mug, id=3, resting="lying")]
    far = [replace(other, T_world_object=pose_from_yaw(0.3, at(0.5, 0.0, 0.0))) for other in others]
    result = with_seen_handles([mug, *far], [seen_from_above(BODY)], SupportPlane(), Network(2.0))
    assert result[1:] == far and result[0] is not mug and result[0].id == 1
