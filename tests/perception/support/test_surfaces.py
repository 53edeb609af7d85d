"""Which surfaces are found in scenes with several: by what stands on them, not by their size."""

from dataclasses import replace

import numpy as np
import pytest

from perception.errors import InvalidInputError, PerceptionError
from perception.support.surfaces import SurfaceConfig, find_surfaces


@pytest.fixture
def scene(scenes):
    """Return a function from solids and a view to a frame, with or without its pose."""

    def render(solids, eye, target, posed, noise=0.002):
        frame = scenes.render(solids, scenes.look_at(eye, target), noise, (640, 480)).frame
        return frame if posed else replace(frame, T_world_camera=None)

    return render


def heights(frame, eye):
    """Heights of the surfaces above the floor, and the angles of their normals with the vertical."""
    found = find_surfaces([frame])
    up = np.array([0.0, 0.0, 1.0])
    offsets = [surface.plane.offset for surface in found]
    if frame.T_world_camera is None:
        return [offset + eye[2] for offset in offsets], found
    assert all(surface.plane.normal @ up > np.cos(0.01) for surface in found)
    return offsets, found


def slab(scenes, top, half, x=0.0, y=0.0, thickness=0.03):
    return scenes.Solid(x, y, thickness, half=half, bottom=top - thickness)


def three_boxes(scenes, z, x=0.0):
    return [
        scenes.Solid(x - 0.12, -0.08, 0.10, half=(0.03, 0.03), bottom=z),
        scenes.Solid(x + 0.10, 0.05, 0.15, radius=0.03, bottom=z),
        scenes.Solid(x - 0.02, 0.12, 0.06, half=(0.05, 0.02), bottom=z),
    ]


both = pytest.mark.parametrize("posed", [True, False], ids=["posed", "unposed"])


@both
@pytest.mark.parametrize("eye", [(0, -1.3, 1.25), (0, -0.7, 1.15), (0, -1.9, 1.5)])
def test_a_small_table_is_preferred_to_a_large_floor(scenes, scene, posed, eye):
    solids = [slab(scenes, 0.7, (0.35, 0.25)), *three_boxes(scenes, 0.7)]
    found, (surface, *_) = heights(scene(solids, eye, (0, 0.1, 0.6), posed), eye)
    assert found == pytest.approx([0.7], abs=3e-3)  # nothing stands on the floor
    size = np.ptp(surface.outline, axis=0)
    assert sorted(size) == pytest.approx([0.5, 0.7], abs=0.06)


@both
def test_a_shelf_above_the_table_is_found_too(scenes, scene, posed):
    solids = [slab(scenes, 0.7, (0.6, 0.35)), *three_boxes(scenes, 0.7, -0.2)]
    solids += [
        slab(scenes, 1.0, (0.25, 0.15), 0.3, 0.2),
        scenes.Solid(0.3, 0.2, 0.12, radius=0.035, bottom=1),
    ]
    eye = (0, -0.8, 1.45)
    found, _ = heights(scene(solids, eye, (0.05, 0.1, 0.8), posed), eye)
    assert found == pytest.approx([0.7, 1.0], abs=2e-3)


@both
def test_a_wall_is_no_support_surface(scenes, scene, posed):
    solids = [scenes.Solid(0, 0.6, 2.0, half=(2.0, 0.01)), *three_boxes(scenes, 0.0)]
    eye = (0, -0.7, 0.35)
    found, _ = heights(scene(solids, eye, (0, 0.3, 0.2), posed), eye)
    assert found == pytest.approx([0.0], abs=2e-3)


def test_the_bottom_of_a_bin_is_preferred_to_its_sides(scenes, scene):
    solids = [scenes.Solid(0, y, 0.25, half=(0.32, 0.01)) for y in (-0.21, 0.21)] + [
        scenes.Solid(x, 0, 0.25, half=(0.01, 0.2)) for x in (-0.31, 0.31)
    ]
    solids += [scenes.Solid(x, y, 0.03, half=(0.06, 0.06)) for x in (-0.2, 0.0, 0.2) for y in (-0.1, 0.1)]
    eye = (0, 0, 0.7)
    found, _ = heights(scene(solids, eye, (0, 0.01, 0), False), eye)
    assert found[0] == pytest.approx(0.0, abs=2e-3)


@both
@pytest.mark.parametrize(
    ("top", "load", "expected"),
    [
        (0.10, False, [0.0]),  # the lid of a box is part of the box
        (0.10, True, [0.0, 0.10]),
        (0.03, True, [0.0, 0.03]),  # a tray
        (0.015, True, [0.0]),  # as thin as the tolerance with which objects touch the table
    ],
)
def test_what_carries_something_is_a_surface(scenes, scene, posed, top, load, expected):
    solids = [scenes.Solid(0, 0, top, half=(0.18, 0.13)), scenes.Solid(0.3, 0, 0.1, radius=0.033)]
    solids += [scenes.Solid(0.05, 0, 0.1, radius=0.033, bottom=top)] if load else []
    eye = (0, -0.6, 0.5)
    found, _ = heights(scene(solids, eye, (0, 0, 0.05), posed), eye)
    assert found == pytest.approx(expected, abs=2e-3)


def test_a_chair_beside_the_table_is_found(scenes, scene):
    solids = [
        slab(scenes, 0.7, (0.35, 0.25)),
        *three_boxes(scenes, 0.7),
        slab(scenes, 0.45, (0.2, 0.2), -0.7, 0.3),
    ]
    solids.append(scenes.Solid(-0.7, 0.3, 0.2, radius=0.04, bottom=0.45))
    eye = (-0.2, -1.0, 1.3)
    found, _ = heights(scene(solids, eye, (-0.2, 0.1, 0.6), False), eye)
    assert found == pytest.approx([0.7, 0.45], abs=3e-3)


def test_a_camera_may_have_any_roll(scenes, scene):
    eye = (0, -0.6, 0.5)
    frame = scene(three_boxes(scenes, 0.0), eye, (0, 0, 0.05), False)
    k = frame.intrinsics
    turned = replace(
        frame,
        rgb=np.ascontiguousarray(np.rot90(frame.rgb)),
        depth=np.ascontiguousarray(np.rot90(frame.depth)),
        intrinsics=replace(k, width=k.height, height=k.width, cx=k.cy, cy=k.cx),
    )
    (upright,), (rolled,) = find_surfaces([frame]), find_surfaces([turned])
    assert rolled.plane.offset == pytest.approx(upright.plane.offset, abs=1e-3)
    x, y, z = upright.plane.normal
    np.testing.assert_allclose(rolled.plane.normal, (y, -x, z), atol=3e-3)


def test_several_views_are_one_scene(scenes, scene):
    solids = [slab(scenes, 0.7, (0.35, 0.25)), *three_boxes(scenes, 0.7)]
    eyes = ((0, -1.2, 1.25), (1.1, 0.3, 1.25), (-1.0, 0.5, 1.3))
    frames = [scene(solids, eye, (0, 0, 0.65), True) for eye in eyes]
    (surface,) = find_surfaces(frames)
    assert surface.plane.offset == pytest.approx(0.7, abs=1e-3)
    assert sorted(np.ptp(surface.outline, axis=0)) == pytest.approx([0.5, 0.7], abs=0.06)


def test_the_world_may_be_the_first_cameras_frame(scenes, scene):
    """With poses relative to the first camera, the table is found as in the world with z up."""
    solids = [slab(scenes, 0.7, (0.35, 0.25)), *three_boxes(scenes, 0.7)]
    frames = [scene(solids, (x, -1.2, 1.35), (0, 0.1, 0.65), True) for x in (-0.4, 0.0, 0.4)]
    T_first_world = np.linalg.inv(frames[0].T_world_camera)
    relative = [replace(frame, T_world_camera=T_first_world @ frame.T_world_camera) for frame in frames]
    expected, found = find_surfaces(frames)[0].plane, find_surfaces(relative)[0].plane
    normal = T_first_world[:3, :3] @ expected.normal
    assert found.normal @ normal > np.cos(0.005)
    assert found.offset == pytest.approx(expected.offset + normal @ T_first_world[:3, 3], abs=3e-3)


def test_a_bare_table_is_the_main_surface(scenes, scene):
    (surface,) = find_surfaces([scene([], (0, -0.6, 0.5), (0, 0, 0.05), True)])
    assert surface.plane.offset == pytest.approx(0, abs=1e-3) and len(surface.outline) > 2


def test_a_surface_too_small_to_be_seen_has_no_outline(scenes, scene):
    frame = scene([], (0, 0, 0.12), (0, 0.001, 0), True, noise=0.0)
    k = frame.intrinsics
    near = replace(frame, intrinsics=replace(k, fx=6 * k.fx, fy=6 * k.fy))  # sees two centimetres
    (surface,) = find_surfaces([near])
    assert len(surface.outline) == 0 and surface.plane.offset == pytest.approx(0, abs=1e-3)


def test_the_number_of_surfaces_is_limited(scenes, scene):
    solids = [
        scenes.Solid(0, 0, 0.1, half=(0.18, 0.13)),
        scenes.Solid(0.05, 0, 0.1, radius=0.033, bottom=0.1),
    ]
    frame = scene(solids, (0, -0.6, 0.5), (0, 0, 0.05), True)
    assert len(find_surfaces([frame], SurfaceConfig(max_surfaces=1))) == 1


def test_unusable_frames_are_refused(scenes, scene):
    frame = scene([], (0, -0.6, 0.5), (0, 0, 0.05), False)
    with pytest.raises(InvalidInputError, match="needs T_world_camera of each"):
        find_surfaces([frame, frame])
    with pytest.raises(InvalidInputError, match="at least one"):
        find_surfaces([])
    with pytest.raises(PerceptionError, match="only 0 depth points"):
        find_surfaces([replace(frame, depth=np.zeros_like(frame.depth))])
