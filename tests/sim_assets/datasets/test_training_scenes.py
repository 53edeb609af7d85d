"""Training pictures: labels agree with pictures, seeds repeat, kinds vary."""

from dataclasses import replace

import numpy as np
import pytest
from trimesh import creation

import sim_assets.datasets.training_scenes as training_scenes
from perception.types import CATEGORIES, POSED_CLASSES
from sim_assets.cell.outlines import gap
from sim_assets.datasets.distractors import random_distractor, random_parts
from sim_assets.datasets.scatter import make_item, scatter
from sim_assets.datasets.scene_config import TrainingSceneConfig
from sim_assets.datasets.training_scenes import TrainingScenes
from sim_assets.objects.can import FOOT, sample_can
from sim_assets.objects.families import make_solid, sample_parameters
from sim_assets.rendering.texture_coordinates import ATTRIBUTE

SMALL = TrainingSceneConfig(
    width=160,
    height=120,
    pool=8,
    distractors=4,
    objects=(3, 6),
    extras=(1, 2),
    textures_redrawn=3,
    shadows=0.0,
)


@pytest.fixture(scope="module")
def pictures():
    with TrainingScenes("train", 5, SMALL) as scenes:
        return list(scenes.render(6))


def test_pictures_are_frames_with_pose_and_labels(pictures):
    for picture in pictures:
        assert picture.frame.rgb.shape == (120, 160, 3)
        assert picture.instances.shape == (120, 160)
        assert picture.instances.max() < len(picture.labels)
        assert {label.category for label in picture.labels} <= {None, *CATEGORIES}
        assert picture.frame.T_world_camera is not None
        counts = np.bincount(picture.instances[picture.instances >= 0], minlength=len(picture.labels))
        assert [label.pixels for label in picture.labels] == counts.tolist()


def test_depth_of_an_instance_lies_where_its_label_says(pictures):
    """Points of an instance, seen from its object's frame, lie on the table within the object's height."""
    checked = 0
    for picture in pictures:
        frame = picture.frame
        v, u = np.indices(frame.depth.shape)
        k, T = frame.intrinsics, frame.T_world_camera
        rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
        points = (rays * frame.depth[..., None]) @ T[:3, :3].T + T[:3, 3]
        for index, label in enumerate(picture.labels):
            mine = points[(picture.instances == index) & (frame.depth > 0)]
            if len(mine) < 100:
                continue
            local = mine - label.T_world_object[:3, 3]
            assert np.median(np.linalg.norm(local[:, :2], axis=1)) < 0.2
            assert -0.02 < np.median(local[:, 2]) < label.height + 0.02
            checked += 1
    assert checked > 10


def test_yaw_is_the_angle_of_the_handle(pictures):
    label = pictures[0].labels[0]
    handle = label.T_world_object[:3, :3] @ [1, 0, 0]
    assert np.angle(np.exp(1j * (label.yaw - np.arctan2(handle[1], handle[0])))) == pytest.approx(0, abs=1e-9)


def test_same_seed_same_pictures(pictures):
    with TrainingScenes("train", 5, SMALL) as scenes:
        again = list(scenes.render(2))
    for first, second in zip(pictures[:2], again, strict=True):
        assert np.array_equal(first.instances, second.instances)
        assert np.array_equal(first.frame.rgb, second.frame.rgb)
        assert np.array_equal(first.frame.depth, second.frame.depth)


def test_touching_neighbours_touch_and_nothing_overlaps():
    rng = np.random.default_rng(0)
    items = [make_item("can", creation.cylinder(radius=r, height=0.1)) for r in rng.uniform(0.02, 0.06, 8)]
    items += [make_item(None, creation.box((0.1, 0.04, 0.05)))]
    poses = scatter(items, rng, 0.05, 0.3, touching=1.0)
    placed = [pose.transform(item.outline) for item, pose in zip(items, poses, strict=True) if pose]
    assert len(placed) > 5
    nearest = [min(gap(a, b) for j, b in enumerate(placed) if j != i) for i, a in enumerate(placed)]
    assert min(nearest) > 0 and max(nearest) < 0.008


def test_own_objects_take_the_place_of_generated_ones():
    own = [("bowl", creation.cylinder(radius=0.05, height=0.05))]
    with TrainingScenes("test", 1, SMALL, own) as scenes:
        labels = next(scenes.render(1)).labels
    assert {label.category for label in labels} <= {None, "bowl"}


def test_an_unhidden_thing_fills_its_outline(pictures):
    shares = [
        label.pixels / label.outline_pixels for p in pictures for label in p.labels if label.pixels > 100
    ]
    assert 0.7 < np.quantile(shares, 0.9) < 1.15


def test_distractors_rest_on_the_table_and_are_of_a_size_to_stand_there():
    rng = np.random.default_rng(0)
    for mesh in [random_distractor(rng, "test") for _ in range(40)] + [random_parts(rng) for _ in range(40)]:
        bounds = mesh.bounds
        assert bounds[0, 2] == pytest.approx(0, abs=1e-9)
        assert np.all(np.ptp(bounds, axis=0) < 0.45) and np.all(np.ptp(bounds, axis=0) > 0.002)


def test_the_pool_is_shared_out_as_asked_and_straight_tumblers_stay_out(monkeypatch):
    config = replace(
        SMALL, pool=10, distractors=6, shares=(2, 0, 2, 1), random_parts=1.0, plain_tumblers=False
    )
    drawn = []

    def sample(category, split, rng):
        drawn.append(sample_parameters(category, split, rng))
        return drawn[-1]

    monkeypatch.setattr(training_scenes, "sample_parameters", sample)
    items = training_scenes._draw_items("train", config, np.random.default_rng(1))
    kinds = [item.category for item in items]
    assert [kinds.count(c) for c in (*CATEGORIES, None)] == [4, 0, 4, 2, 6]
    plain = [o for o in drawn if getattr(o, "kind", "") == "tumbler" and o.bend < 0.1]
    assert len(drawn) == 10 + len(plain)


@pytest.mark.parametrize(("split", "share"), [("train", 1.0), ("train", 0.0), ("test", 1.0)])
def test_free_forms_are_of_the_training_split_alone(split, share):
    rng = np.random.default_rng(6)
    config = replace(SMALL, free=share, plain_tumblers=False)
    drawn = [training_scenes._draw_parameters("can", split, config, rng) for _ in range(20)]
    assert {bool(can.radii) for can in drawn} == {split == "train" and share == 1.0}


def test_flat_and_lidded_training_cans_may_stand_on_a_foot_and_no_others_change():
    rng = np.random.default_rng(2)
    cans = [sample_can("train", rng) for _ in range(40)]
    footed = [training_scenes._perhaps_drawn_in(can, 1.0, rng) for can in cans]
    for before, after in zip(cans, footed):
        if before.kind in ("plain", "canister"):
            assert before.foot == 0 and FOOT[0] <= after.foot <= FOOT[1]
            mesh = make_solid(after).mesh()
            assert mesh.is_watertight
            low = np.abs(mesh.vertices[mesh.vertices[:, 2] < 1e-4, :2]).max()
            assert low < after.radius - 0.9 * after.foot
        else:
            assert after is before
    assert [training_scenes._perhaps_drawn_in(can, 0.0, rng) for can in cans] == cans


@pytest.mark.parametrize("split", ["train", "test"])
def test_objects_and_distractors_come_from_the_split(monkeypatch, split):
    asked = []

    def sample(category, which, rng):
        asked.append(which)
        return sample_parameters("can", which, rng)

    def distractor(rng, which="train"):
        asked.append(which)
        return creation.box((0.05, 0.05, 0.05))

    monkeypatch.setattr(training_scenes, "sample_parameters", sample)
    monkeypatch.setattr(training_scenes, "random_distractor", distractor)
    training_scenes._draw_items(split, replace(SMALL, pool=4), np.random.default_rng(0))
    assert asked == [split] * 8


def test_posed_objects_rest_on_the_table_in_poses_of_their_class():
    config = replace(SMALL, pool=40, distractors=0, posed=1.0)
    items = training_scenes._draw_items("train", config, np.random.default_rng(3))
    posed = {(item.category, item.resting) for item in items}
    assert posed == {(c, r) for c, r in POSED_CLASSES if r != "upright"}
    for item in items:
        assert item.ignored and item.mesh.bounds[0, 2] == pytest.approx(0, abs=1e-9)


def test_a_cylinder_lies_as_high_as_it_is_wide_and_stands_on_its_head_as_high_as_it_is():
    rng, can = np.random.default_rng(0), creation.cylinder(0.02, 0.1)
    lying, down = (training_scenes._resting(can, "can", p, rng) for p in ("lying", "upside-down"))
    assert np.ptp(lying.bounds[:, 2]) == pytest.approx(0.04, abs=1e-3)
    assert np.ptp(down.bounds[:, 2]) == pytest.approx(0.1)


@pytest.mark.parametrize("turned", [training_scenes._toppled, None])
def test_the_print_of_an_object_turns_with_it(turned):
    """The print begins at the base, wherever that lies."""
    rng, cone = np.random.default_rng(0), creation.cone(0.03, 0.1)
    mesh = turned(cone, rng) if turned else training_scenes._resting(cone, "bottle", "lying", rng)
    coordinates = mesh.face_attributes[ATTRIBUTE]
    assert coordinates.shape == (len(mesh.faces), 3, 2)
    v = coordinates[..., 1].ravel()
    base, top = (mesh.vertices[mesh.faces].reshape(-1, 3)[v == at].mean(axis=0) for at in (0, 1))
    assert np.linalg.norm(top - base) == pytest.approx(0.1, abs=0.01)
    if not turned:
        np.testing.assert_allclose((top - base)[:2] / 0.1, (0, -1), atol=0.1)


def test_the_handle_of_a_lying_mug_is_beside_it_or_above():
    rng = np.random.default_rng(0)
    handle = creation.icosphere(1, 0.001)
    handle.apply_translation((0.05, 0, 0.04))
    mug = creation.cylinder(0.04, 0.08) + handle
    heights = [training_scenes._resting(mug, "mug", "lying", rng).vertices[-42:, 2].mean() for _ in range(30)]
    assert 0.02 < min(heights) < 0.04 and max(heights) > 0.08
