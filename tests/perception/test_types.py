"""Validation of the core types, and measures of object estimates."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.errors import InvalidInputError
from perception.types import (
    CameraIntrinsics,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
    check_rigid,
    is_unclassified,
    unclassified,
)

CAMERA = CameraIntrinsics(width=8, height=6, fx=10.0, fy=10.0, cx=3.5, cy=2.5)


def frame(**changes):
    fields = {
        "time": 0.0,
        "rgb": np.zeros((6, 8, 3), np.uint8),
        "depth": np.ones((6, 8), np.float32),
        "intrinsics": CAMERA,
        "T_world_camera": np.eye(4),
    }
    return RgbdFrame(**(fields | changes))


def test_intrinsics_matrix_projects_the_optical_axis_to_the_principal_point():
    u, v, w = CAMERA.matrix @ (0, 0, 2.0)
    assert (u / w, v / w) == (3.5, 2.5)


@pytest.mark.parametrize("change", [{"fx": 0.0}, {"fy": float("nan")}, {"cx": 1e6}, {"width": 0}])
def test_invalid_intrinsics_are_rejected(change):
    good = {"width": 8, "height": 6, "fx": 10.0, "fy": 10.0, "cx": 3.5, "cy": 2.5}
    with pytest.raises(InvalidInputError):
        CameraIntrinsics(**(good | change))


def test_images_of_a_frame_are_read_only_and_the_given_arrays_stay_writable():
    depth = np.ones((6, 8), np.float32)
    kept = frame(depth=depth)
    with pytest.raises(ValueError, match="read-only"):
        kept.depth[0, 0] = 2.0
    depth[0, 0] = 3.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": np.full((6, 8), np.nan, np.float32)}, "NaN"),
        ({"depth": -np.ones((6, 8), np.float32)}, "negative"),
        ({"depth": np.ones((6, 7), np.float32)}, "camera says"),
        ({"rgb": np.zeros((6, 7, 3), np.uint8)}, "camera says"),
        ({"T_world_camera": 2 * np.eye(4)}, "rigid"),
    ],
)
def test_invalid_frames_are_rejected_with_the_reason(change, message):
    with pytest.raises(InvalidInputError, match=message):
        frame(**change)


def test_a_reflection_is_not_a_rigid_transform():
    with pytest.raises(InvalidInputError, match="rigid"):
        check_rigid(np.diag([1.0, 1.0, -1.0, 1.0]), "T")


def test_an_empty_mask_is_rejected():
    with pytest.raises(InvalidInputError, match="empty"):
        ObjectDetection("mug", 0.9, np.zeros((6, 8), bool))


def test_height_above_the_plane():
    plane = SupportPlane(offset=0.5)
    np.testing.assert_allclose(plane.height_above(np.array([[9.0, 9.0, 0.75]])), [0.25])


def test_measures_of_an_estimate_exclude_the_handle():
    # A box 2 x 4 x 6 cm, with a spike along +x in the place of a handle.
    corners = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.02, 0.02) for z in (-0.03, 0.03)])
    spike = np.array([[0.08, 0.0, 0.0]])
    mesh = TriangleMesh(np.vstack((corners, spike)), np.array([[0, 1, 8]]))
    T = np.eye(4)
    T[:3, 3] = (1.0, 0.0, 0.0)
    mug = ObjectEstimate(3, "mug", np.zeros(16), T, np.full(3, 0.05), mesh)
    assert mug.name == "mug_3"
    assert mug.height == pytest.approx(0.06)
    assert mug.radius == pytest.approx(0.02)
    assert mug.size == pytest.approx(np.hypot(0.06, 0.04))
    np.testing.assert_allclose(mug.mesh_world.vertices[-1], (1.08, 0.0, 0.0))


@pytest.mark.parametrize("turn", [0.0, 0.2, np.pi / 8])
def test_the_size_of_a_polygonal_bowl_is_that_across_its_corners(turn):
    angles = np.pi / 4 * np.arange(8) + turn
    rim = np.stack([0.07 * np.cos(angles), 0.07 * np.sin(angles), np.full(8, 0.03)], axis=1)
    mesh = TriangleMesh(np.concatenate([rim, rim * (0.5, 0.5, -1.0)]), np.array([[0, 1, 2]]))
    bowl = ObjectEstimate(1, "bowl", np.zeros(16), np.eye(4), np.ones(3), mesh)
    assert bowl.size == pytest.approx(np.hypot(0.06, 0.14), rel=1e-3)
    assert replace(bowl, category="can").size <= bowl.size + 1e-12


def test_the_tip_of_a_bottle_does_not_count():
    """A cylinder with a cone on it: what is above the section of 60 square millimetres is left out."""
    radius, shoulder, tip = 0.02, 0.1, 0.02
    cone = [(radius * (1 - u), shoulder + tip * u) for u in np.linspace(0, 1, 41)]
    profile = [(0.0, 0.0), (radius, 0.0), *cone]
    solid = trimesh.creation.revolve(profile, sections=64)
    mesh = TriangleMesh(np.array(solid.vertices), np.array(solid.faces))
    bottle = ObjectEstimate(1, "bottle", np.zeros(16), np.eye(4), np.ones(3), mesh)
    height = shoulder + tip * (1 - np.sqrt(6e-5 / np.pi) / radius)
    assert bottle.size == pytest.approx(np.hypot(height, 2 * radius), abs=4e-4)
    assert bottle.height == pytest.approx(shoulder + tip)
    assert replace(bottle, category="can").size == pytest.approx(
        np.hypot(shoulder + tip, 2 * radius), abs=1e-4
    )


def test_an_unclassified_mask_is_told_from_a_classified_one() -> None:
    mask = np.ones((2, 3), bool)
    assert is_unclassified(unclassified(mask, 7)) and unclassified(mask, 7).instance_id == 7
    assert not is_unclassified(ObjectDetection("mug", 0.2, mask))
    assert not is_unclassified(ObjectDetection("mug", 0.2, mask, np.array([0.2, 0.2, 0.2, 0.1, 0.3])))
