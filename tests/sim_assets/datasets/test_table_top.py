"""Table tops: geometry of a frame, labels and visibility of two boxes at known poses."""

from dataclasses import replace

import numpy as np
import pytest
from trimesh import creation

from sim_assets.cell.layout import PlanarPose
from sim_assets.datasets.scatter import make_item
from sim_assets.datasets.scene_config import RoomConfig, TrainingSceneConfig
from sim_assets.datasets.table_top import TableTop
from sim_assets.rendering.camera import look_at

CONFIG = TrainingSceneConfig(
    width=160, height=120, pool=2, distractors=1, textures_redrawn=2, objects=(1, 2), extras=(1, 1),
    shadows=0.0, noises=(1.0, 0.0, 0.0, 0.0, 0.0),
)  # fmt: skip
FOVY = 50.0


def box(x, y, z):
    return creation.box((x, y, z)).apply_translation((0, 0, z / 2))


@pytest.fixture(scope="module")
def table():
    items = [make_item("can", box(0.04, 0.12, 0.1)), make_item("mug", box(0.06, 0.06, 0.05))]
    table = TableTop([*items, make_item(None, box(0.05, 0.05, 0.05))], CONFIG, np.random.default_rng(0))
    yield table
    table.close()


@pytest.fixture
def overhead(table):
    """A camera 0.8 m above the origin, image x along world x: item 0 rotated by 90° at (0.1, 0.05)."""
    table.show([0], [PlanarPose(0.1, 0.05, np.pi / 2).matrix])
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.8
    return table.capture(T, FOVY, False)


def test_item_appears_at_its_pose_and_depth(overhead):
    frame, ids = overhead
    k = frame.intrinsics
    assert k.fy == pytest.approx(60 / np.tan(np.radians(25)))
    v, u = np.nonzero(ids == 0)
    z = 0.8 - 0.1
    np.testing.assert_allclose(frame.depth[v, u].min(), z, atol=1e-3)
    top = frame.depth[v, u] < z + 2e-3
    x, y = (u[top] - k.cx) / k.fx * z, -(v[top] - k.cy) / k.fy * z
    pixel = z / k.fx
    np.testing.assert_allclose([x.min(), x.max()], (0.1 - 0.06, 0.1 + 0.06), atol=pixel)
    np.testing.assert_allclose([y.min(), y.max()], (0.05 - 0.02, 0.05 + 0.02), atol=pixel)
    assert frame.depth[5, 5] == pytest.approx(0.8, abs=1e-3)  # table top at z = 0


def test_hidden_items_are_in_no_image(table, overhead):
    assert set(np.unique(overhead[1])) == {-1, 0}
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.8
    table.show([2, 1], [PlanarPose(-0.1, 0.0, 0.0).matrix, PlanarPose(0.1, 0.0, 0.3).matrix])
    ids = table.capture(T, FOVY, False)[1]
    assert set(np.unique(ids)) == {-1, 1, 2}
    assert np.nonzero(ids == 2)[1].mean() < 80 < np.nonzero(ids == 1)[1].mean()


def test_label_has_the_area_of_the_projected_hull(table, overhead):
    frame, _ = overhead
    pose = PlanarPose(0.0, 0.0, 0.0).matrix
    label = table._label(table.items[0], pose, 17, frame, frame.intrinsics)
    z, f = 0.7, frame.intrinsics.fx
    assert label.outline_pixels == pytest.approx(0.04 * 0.12 * (f / z) ** 2, rel=1e-3)
    assert (label.category, label.pixels, label.height) == ("can", 17, pytest.approx(0.1))
    np.testing.assert_allclose(label.T_world_object, pose)
    np.testing.assert_allclose(label.foot, (0, 0, 0), atol=1e-9)


def test_depth_noise_is_drawn_with_its_probabilities(table, monkeypatch):
    used = []
    monkeypatch.setattr(table, "sense", lambda true, noise, rng: used.append(noise) or true)
    table.config = replace(CONFIG, noises=(0.0, 0.5, 0.5, 0.0, 0.0))
    for seed in range(20):
        table.picture(np.random.default_rng(seed))
    assert set(used) == {"gaussian", "realsense"}
    table.config = CONFIG


def test_a_frame_is_sensed_with_noise_and_calibration_errors(table):
    table.show([0], [PlanarPose(0.0, 0.0, 0.0).matrix])
    true, _ = table.capture(look_at(np.array([0.3, 0.0, 0.6]), np.zeros(3)), FOVY, False)
    gaussian = table.sense(true, "gaussian", np.random.default_rng(0))
    assert np.std(gaussian.depth - true.depth) == pytest.approx(0.002, rel=0.1)
    assert gaussian.intrinsics == true.intrinsics
    table.config = replace(CONFIG, misregistered=1.0)
    assert table.sense(true, "none", np.random.default_rng(0)).intrinsics != true.intrinsics
    table.config = replace(CONFIG, cut=1.0)
    assert any((table.sense(true, "none", np.random.default_rng(s)).depth == 0).any() for s in range(4))
    table.config = CONFIG
    np.testing.assert_array_equal(table.sense(true, "none", np.random.default_rng(0)).depth, true.depth)


def test_labels_agree_with_an_image_in_error(table):
    """With a wrong depth scale, table and footprints are where the image shows them."""
    table.config = replace(CONFIG, misregistered=1.0, noises=(1.0, 0, 0, 0, 0))
    image = table.picture(np.random.default_rng(3))
    table.config = CONFIG
    frame = image.frame
    k, T = frame.intrinsics, frame.T_world_camera
    v, u = np.nonzero((image.instances < 0) & (frame.depth > 0))
    z = frame.depth[v, u]
    points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], 1) @ T[:3, :3].T + T[:3, 3]
    height = points @ image.plane.normal - image.plane.offset
    assert np.median(np.abs(height)) < 5e-4
    for label in image.labels:
        assert abs(label.foot @ image.plane.normal - image.plane.offset) < 0.003


def test_number_of_objects_and_distractors_is_in_its_range(table):
    rng = np.random.default_rng(0)
    chosen = [table._choose(rng) for _ in range(40)]
    assert {sum(i < 2 for i in c) for c in chosen} == {1, 2} and {c.count(2) for c in chosen} == {1}
    assert all(len(set(c)) == len(c) for c in chosen) and len({tuple(c) for c in chosen}) > 4


def test_camera_looks_near_an_item_from_the_configured_range(table):
    rng = np.random.default_rng(1)
    placed = [PlanarPose(0.2, 0.1, 0.0).matrix]
    for _ in range(50):
        T = table._aim(placed, rng)
        low, high = CONFIG.distance
        reach = T[2, 3] / -T[2, 2]  # along the optical axis to the table
        target = T[:3, 3] + T[:3, 2] * reach
        assert low - 0.3 < np.linalg.norm(T[:3, 3] - (*target[:2], 0)) < high + 0.2
        assert np.degrees(np.arcsin(-T[2, 2])) >= 29.9
        along = np.array([0.2, 0.1]) / np.hypot(0.2, 0.1)
        if -T[2, 2] > 0.9:
            assert 0.0 < target[:2] @ along < 0.35


def test_camera_keeps_the_distance_of_its_sensor(table):
    """A tall item under the camera counts with its top, not with its foot."""
    rng = np.random.default_rng(2)
    poses = PlanarPose(0.2, 0.1, 0.0), PlanarPose(-0.1, 0.0, 0.0)
    placed, heights = [pose.matrix for pose in poses], [0.05, 0.25]
    for _ in range(30):
        eye = table._aim(placed, rng, heights, nearest=0.6)[:3, 3]
        for pose, height in zip(poses, heights, strict=True):
            points = np.array([(pose.x, pose.y, z) for z in np.linspace(0, height, 26)])
            assert np.linalg.norm(points - eye, axis=1).min() > 0.6 - 1e-3


def test_stacked_items_are_rendered_and_labelled_at_their_height():
    items = [make_item("bowl", box(0.09, 0.09, 0.05)), make_item("can", box(0.03, 0.03, 0.06))]
    table = TableTop(
        items, replace(CONFIG, objects=(1, 1), extras=(0, 0), stacked=1.0), np.random.default_rng(0)
    )
    images = [table.picture(np.random.default_rng(seed)) for seed in range(12)]
    table.close()
    assert all(len(image.labels) == 2 for image in images)
    upper = [image for image in images if image.labels[1].category == "can"]
    assert 0 < len(upper) < 12
    for image in upper:
        T = image.labels[1].T_world_object
        assert T[2, 3] == pytest.approx(0.05, abs=0.025)  # up to 22 degrees of tilt
        v, u = np.nonzero(image.instances == 1)
        if len(v) < 30:
            continue
        k, z = image.frame.intrinsics, image.frame.depth[v, u]
        eye = image.frame.T_world_camera
        points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], 1) @ eye[:3, :3].T + eye[:3, 3]
        local = (points - T[:3, 3]) @ T[:3, :3]
        assert (np.abs(local - (0, 0, 0.03)) < (0.0165, 0.0165, 0.0315)).all(axis=1).mean() > 0.9


def test_furniture_is_no_item_but_marked():
    """A block as high as a man around a small table: its pixels have no instance and are surroundings."""
    items = [make_item("can", box(0.05, 0.05, 0.1)), make_item(None, box(0.05, 0.05, 0.05))]
    room = RoomConfig(side=(0.4, 0.4), ground=0.0, things=(1, 1))
    config = replace(CONFIG, objects=(1, 1), room=room, elevation=(0.3, 0.4), distance=(1.0, 1.2))
    table = TableTop(items, config, np.random.default_rng(0), [box(1.5, 1.5, 2.5)])
    images = [table.picture(np.random.default_rng(seed)) for seed in range(6)]
    table.close()
    assert any(image.surroundings.mean() > 0.02 for image in images)
    assert all((image.instances[image.surroundings] == -1).all() for image in images)


def test_light_falls_on_the_origin_from_above(table):
    for seed in range(10):
        table.light(np.random.default_rng(seed))
        position, direction = table.model.light_pos[0], table.model.light_dir[0]
        np.testing.assert_allclose(direction, -position / np.linalg.norm(position), atol=1e-9)
        assert position[2] > 0.9 and np.linalg.norm(position) == pytest.approx(1.8)


def test_redrawing_changes_textures_of_some_items_and_of_the_ground(table):
    before = table.model.tex_data.copy()
    table.redraw_textures(np.random.default_rng(5))

    def changed(name):
        texture = table.model.texture(name).id
        start = table.model.tex_adr[texture]
        return not np.array_equal(before[start : start + 100], table.model.tex_data[start : start + 100])

    assert changed("table") and changed("wall") and changed("floor")
    assert sum(changed(f"item{i}") for i in range(3)) == CONFIG.textures_redrawn
