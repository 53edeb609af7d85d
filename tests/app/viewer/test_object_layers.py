"""Bodies, reconstructed objects and ghosts in the scene."""

from dataclasses import replace

import numpy as np
import pytest

from app.drawing import CLASS_COLORS
from app.viewer.display import DisplayOptions
from app.viewer.meshes import MeshCache
from app.viewer.object_layers import FIT_OPACITY, GHOST_OPACITY, BodyLayer, GoalLayer, ObjectLayer
from app.viewer.snapshot import ObjectState, Snapshot
from app.viewer.timeline import Timeline
from perception.geometry import pose_from_yaw

RECONSTRUCTED, TRUE, BOTH = (DisplayOptions(objects=name) for name in ("reconstructed", "true", "both"))
T_GOAL = pose_from_yaw(0.0, np.array([0.4, 0.2, 0.05]))


@pytest.fixture
def can(make_can):
    estimate = make_can()
    return ObjectState(
        0, "can", None, estimate.T_world_object, estimate.scale, np.asarray(estimate.code, dtype=np.float64)
    )


@pytest.fixture
def meshes(recording):
    return MeshCache(recording)


def color(node):
    return tuple(int(value) for value in node.color)


def test_bodies_move_with_their_rows_of_the_poses(server, node, recording):
    layer = BodyLayer(server, recording)
    snapshot = Timeline(recording).at(recording.now)
    layer.draw(snapshot, RECONSTRUCTED)
    for row, body in ((0, "hand"), (3, "object0")):
        np.testing.assert_allclose(node(f"/cell/{body}").position, snapshot.poses[row, :3])
        np.testing.assert_allclose(node(f"/cell/{body}").wxyz, snapshot.poses[row, 3:])
    assert not node("/cell/world/0").cast_shadow and node("/cell/hand/0").cast_shadow
    layer.draw(replace(snapshot, poses=np.zeros((0, 7))), RECONSTRUCTED)  # no poses yet


def test_true_objects_are_hidden_once_there_are_reconstructions(server, node, recording, can):
    layer, poses = BodyLayer(server, recording), recording.poses[0]
    for objects, options, visible in (
        ({}, RECONSTRUCTED, True),
        ({0: can}, RECONSTRUCTED, False),
        ({0: can}, TRUE, True),
        ({0: can}, BOTH, True),
    ):
        layer.draw(Snapshot(poses=poses, objects=objects), options)
        assert node("/cell/object0").visible == visible and node("/cell/hand").visible


def test_objects_have_the_colour_of_their_class_and_their_pose(server, node, meshes, can):
    layer = ObjectLayer(server, meshes)
    layer.draw(Snapshot(objects={0: replace(can, T_world_object=T_GOAL)}), RECONSTRUCTED)
    mesh, label = node("/objects/0"), node("/labels/0")
    assert color(mesh) == CLASS_COLORS["can"] and mesh.opacity is None and not mesh.wireframe
    np.testing.assert_allclose(mesh.position, T_GOAL[:3, 3])
    np.testing.assert_allclose(label.position, T_GOAL[:3, 3] + (0, 0, 0.05 + 0.02))
    assert label.text == "can 0" and mesh.visible and label.visible
    layer.draw(Snapshot(objects={0: can}), replace(TRUE, labels=False))
    assert not node("/objects/0").visible and not node("/labels/0").visible
    np.testing.assert_allclose(node("/objects/0").position, can.T_world_object[:3, 3])
    layer.draw(Snapshot(objects={0: can}), BOTH)
    assert node("/objects/0").wireframe and node("/objects/0").visible
    layer.draw(Snapshot(), RECONSTRUCTED)
    assert node("/objects/0") is None and node("/labels/0") is None


def test_fits_are_translucent_and_drawn_anew_at_each_iteration(server, node, meshes, can, monkeypatch):
    monkeypatch.setattr(meshes, "mesh", lambda state: meshes._recorder.objects[0].mesh)
    layer = ObjectLayer(server, meshes)
    layer.draw(Snapshot(objects={0: replace(can, iteration=8)}), RECONSTRUCTED)
    first = node("/objects/0")
    assert first.opacity == FIT_OPACITY and node("/labels/0").text == "can 0 · iteration 8"
    layer.draw(Snapshot(objects={0: replace(can, iteration=8)}), RECONSTRUCTED)
    assert node("/objects/0") is first
    layer.draw(Snapshot(objects={0: replace(can, iteration=30)}), RECONSTRUCTED)
    assert node("/objects/0") is not first


def test_uncertainty_is_shown_as_vertex_colours(server, node, meshes, can, monkeypatch):
    asked = []
    colors = np.full((len(meshes.mesh(can).vertices), 3), 9, np.uint8)
    monkeypatch.setattr(meshes, "uncertainty_colors", lambda state: asked.append(state.id) or colors)
    layer = ObjectLayer(server, meshes)
    layer.draw(Snapshot(objects={0: can}), RECONSTRUCTED)
    assert not asked
    layer.draw(Snapshot(objects={0: can}), DisplayOptions(coloring="uncertainty"))
    assert asked == [0] and not hasattr(node("/objects/0"), "wireframe")  # a textured mesh


def test_ghosts_are_at_the_goal_pose_in_the_colour_of_the_class(server, node, meshes, can):
    layer = GoalLayer(server, meshes)
    layer.draw(Snapshot(objects={0: can}, goals={"can_0": T_GOAL, "mug_7": T_GOAL}), RECONSTRUCTED)
    ghost = node("/goals/can_0")
    np.testing.assert_allclose(ghost.position, T_GOAL[:3, 3])
    assert color(ghost) == CLASS_COLORS["can"] and ghost.opacity == GHOST_OPACITY == 0.25 and ghost.visible
    assert node("/goals/mug_7") is None  # without a reconstruction there is no shape
    T_revised = pose_from_yaw(0.0, np.array([0.3, 0.1, 0.05]))
    layer.draw(Snapshot(objects={0: can}, goals={"can_0": T_revised}), DisplayOptions(goals=False))
    np.testing.assert_allclose(ghost.position, T_revised[:3, 3])
    assert not ghost.visible
    layer.draw(Snapshot(objects={0: can}), RECONSTRUCTED)
    assert node("/goals/can_0") is None
