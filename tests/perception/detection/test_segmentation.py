"""Instances that the shipped scene network finds on analytic scenes, unlike any it was trained on."""

import numpy as np
import pytest

from perception.detection.instances import InstanceConfig, find_instances
from perception.detection.scene_network import load_scene_network
from perception.types import RgbdFrame, SupportPlane

PLANE = SupportPlane()
TARGET = (0.48, -0.22, 0.05)


@pytest.fixture(scope="module")
def segment():
    """Masks of the instances of a frame."""
    network = load_scene_network()

    def masks(frame, plane, config=None):
        found = find_instances(frame, plane, network, config or InstanceConfig())
        return [instance.mask for instance in found]

    return masks


@pytest.fixture
def table(scenes):
    """A can, a bottle, a carton and a bowl-sized cylinder, 4 cm and more apart."""
    return [
        scenes.Solid(0.40, -0.30, 0.10, radius=0.04),
        scenes.Solid(0.52, -0.30, 0.20, radius=0.035),
        scenes.Solid(0.40, -0.18, 0.05, half=(0.05, 0.03)),
        scenes.Solid(0.53, -0.14, 0.07, radius=0.06),
    ]


def matches(masks, instances, count):
    """Best IoU for each true instance."""
    return [
        max(((m & (instances == i)).sum() / (m | (instances == i)).sum() for m in masks), default=0.0)
        for i in range(count)
    ]


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("view", [(90, 0, 0.6), (60, 90, 0.5), (45, 200, 0.5), (75, 300, 0.45)])
def test_every_object_is_one_instance(segment, scenes, table, view, noise):
    elevation, azimuth, distance = view
    scene = scenes.render(table, scenes.orbit(TARGET, distance, elevation, azimuth), noise, size=(640, 480))
    masks = segment(scene.frame, PLANE)
    assert len(masks) == len(table)
    assert min(matches(masks, scene.instances, len(table))) > 0.9
    assert sum(m.astype(int) for m in masks).max() == 1  # no pixel twice


def test_masks_err_outwards(segment, scenes, table):
    scene = scenes.render(table, scenes.orbit(TARGET, 0.5, 60, 90), 0.002, size=(640, 480))
    for mask in segment(scene.frame, PLANE):
        true = scene.instances == np.bincount(scene.instances[mask & (scene.instances >= 0)]).argmax()
        assert (mask & true).sum() > 0.98 * true.sum()


def test_the_open_box_neither_swallows_nor_breaks_its_neighbours(segment, scenes, table):
    walls = [scenes.Solid(0.5, y, 0.08, half=(0.18, 0.003)) for y in (0.12, 0.42)]
    walls += [scenes.Solid(x, 0.27, 0.08, half=(0.003, 0.15)) for x in (0.32, 0.68)]
    floor = scenes.Solid(0.5, 0.27, 0.004, half=(0.18, 0.15))
    scene = scenes.render([*table, *walls, floor], scenes.orbit(TARGET, 0.6, 50, 270), 0.002, size=(640, 480))
    assert (scene.instances >= len(table)).sum() > 5000  # it is in view
    assert min(matches(segment(scene.frame, PLANE), scene.instances, len(table))) > 0.9


def test_an_object_half_hidden_is_not_joined_to_what_hides_it(segment, scenes):
    solids = [scenes.Solid(0.45, -0.30, 0.12, radius=0.03), scenes.Solid(0.45, -0.18, 0.09, radius=0.04)]
    scene = scenes.render(solids, scenes.orbit((0.45, -0.25, 0.05), 0.5, 45, 270), 0.002, size=(640, 480))
    masks = segment(scene.frame, PLANE)
    assert len(masks) == 2
    assert min(matches(masks, scene.instances, 2)) > 0.85


def test_objects_cut_by_the_border_count(segment, scenes, table):
    scene = scenes.render(table, scenes.orbit((0.40, -0.30, 0.05), 0.25, 80, 90), size=(640, 480))
    masks = segment(scene.frame, PLANE)
    edge = [m for m in masks if m[0].any() or m[-1].any() or m[:, 0].any() or m[:, -1].any()]
    assert edge


def test_holes_in_the_depth_are_part_of_the_mask(segment, scenes):
    scene = scenes.render([scenes.Solid(0.45, -0.2, 0.1, radius=0.05)], scenes.orbit(TARGET, 0.5, 60, 0))
    depth = scene.frame.depth.copy()
    v, u = (int(c.mean()) for c in np.nonzero(scene.instances == 0))
    depth[v - 4 : v + 4, u - 4 : u + 4] = 0
    frame = RgbdFrame(0.0, scene.frame.rgb, depth, scene.frame.intrinsics, scene.frame.T_world_camera)
    (mask,) = segment(frame, PLANE)
    assert mask[v - 4 : v + 4, u - 4 : u + 4].all()


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_a_bare_table_has_no_instances(segment, scenes, noise):
    assert segment(scenes.render([], scenes.orbit(TARGET, 0.5, 60, 0), noise).frame, PLANE) == []


def test_no_measurement_no_instances(segment, scenes):
    frame = scenes.render([], scenes.orbit(TARGET, 0.5, 60, 0)).frame
    blind = RgbdFrame(0.0, frame.rgb, 0 * frame.depth, frame.intrinsics, frame.T_world_camera)
    assert segment(blind, PLANE) == []


def test_what_towers_over_the_table_or_nears_the_lens_is_no_object(segment, scenes):
    arm = scenes.Solid(0.45, -0.2, 0.6, half=(0.04, 0.04))
    scene = scenes.render([arm], scenes.orbit(TARGET, 1.0, 30, 0))
    assert segment(scene.frame, PLANE) == []
    finger = scenes.Solid(0.48, -0.22, 0.45, radius=0.01)
    scene = scenes.render([finger], scenes.orbit(TARGET, 0.5, 90, 0))
    assert segment(scene.frame, PLANE, InstanceConfig(max_height=1.0)) == []


def test_a_camera_without_a_pose_sees_the_same(segment, scenes, table):
    T = scenes.orbit(TARGET, 0.5, 60, 90)
    frame = scenes.render(table, T).frame
    alone = RgbdFrame(0.0, frame.rgb, frame.depth, frame.intrinsics)
    plane = SupportPlane(normal=T[:3, :3].T @ (0.0, 0.0, 1.0), offset=float(-T[2, 3]))
    posed, unposed = segment(frame, PLANE), segment(alone, plane)
    assert len(posed) == len(unposed) == len(table)
    for mask in posed:
        assert max((mask & other).sum() / (mask | other).sum() for other in unposed) > 0.98
