"""Convex pieces: within 2 mm of the material, cavities free, only the base on the table."""

from functools import cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from perception.types import CATEGORIES
from sim_assets.objects import sample_object
from sim_assets.objects.convex.pieces import CLEARANCE

EVERY = [(category, split) for category in CATEGORIES for split in ("train", "test")]


@cache
def an_object(category, split):
    return sample_object(category, split, np.random.default_rng(21))


def piece_mesh(piece) -> trimesh.Trimesh:
    if piece.kind == "mesh":
        return trimesh.convex.convex_hull(piece.vertices)
    if piece.kind == "box":
        mesh = trimesh.creation.box(2 * np.array(piece.size))
    elif piece.kind == "cylinder":
        mesh = trimesh.creation.cylinder(piece.size[0], 2 * piece.size[1], sections=48)
    else:
        mesh = trimesh.creation.capsule(2 * piece.size[1], piece.size[0], count=[12, 12])
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    T_object_piece = np.eye(4)
    T_object_piece[:3, :3] = Rotation.from_quat(piece.quat_wxyz, scalar_first=True).as_matrix()
    T_object_piece[:3, 3] = piece.position
    return mesh.apply_transform(T_object_piece)


@cache
def pieces_of(category, split):
    return [piece_mesh(piece) for piece in an_object(category, split).collision]


def near_material(model, points, distance=2e-3):
    """Whether material lies within a distance of each point, probed in 26 directions."""
    steps = np.array([s for s in np.ndindex(3, 3, 3) if s != (1, 1, 1)]) - 1.0
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    near = model.inside(points)
    for reach in (0.5 * distance, distance):
        for step in steps:
            near |= model.inside(points + reach * step)
    return near


@pytest.mark.parametrize(("category", "split"), EVERY)
def test_pieces_stay_within_2_mm_of_the_material(category, split):
    model = an_object(category, split)
    points = np.concatenate([mesh.sample(6, seed=0) for mesh in pieces_of(category, split)])
    hollow_foot = 0.012  # the hollows under foot rings and inside can rims are filled on purpose
    points = points[(points[:, 2] > hollow_foot) & (points[:, 2] < model.height - 0.006)]
    assert near_material(model, points).all()


@pytest.mark.parametrize(("category", "split"), EVERY)
def test_pieces_cover_the_surface(category, split):
    points = an_object(category, split).mesh.sample(400, seed=0)
    outside = np.full(len(points), np.inf)
    for mesh in pieces_of(category, split):
        offset = (mesh.face_normals * mesh.triangles[:, 0]).sum(axis=1)
        outside = np.minimum(outside, (points @ mesh.face_normals.T - offset).max(axis=1))
    assert np.quantile(outside, 0.99) < 2.5e-3


@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("category", ["mug", "bowl"])
def test_cavities_are_free(category, split):
    model = an_object(category, split)
    rng = np.random.default_rng(0)
    points = rng.uniform(*model.mesh.bounds, (3000, 3))
    cavity = points[~near_material(model, points, 2e-3) & (points[:, 2] > 0.4 * model.height)]
    cavity = cavity[np.hypot(cavity[:, 0], cavity[:, 1]) < 0.6 * model.radius]
    assert len(cavity) > 50
    for mesh in pieces_of(category, split):
        offset = (mesh.face_normals * mesh.triangles[:, 0]).sum(axis=1)
        assert ((cavity @ mesh.face_normals.T - offset).max(axis=1) > 0).all()


@pytest.mark.parametrize(("category", "split"), EVERY)
def test_one_piece_stands_on_the_table(category, split):
    lowest = np.array([mesh.bounds[0, 2] for mesh in pieces_of(category, split)])
    assert (np.abs(lowest) < 1e-6).sum() == 1
    assert np.sort(lowest)[1] >= (CLEARANCE if category in ("mug", "bowl") else 0.0)


def test_quaternions_are_unit_and_sizes_positive():
    for category, split in EVERY:
        for piece in an_object(category, split).collision:
            assert np.linalg.norm(piece.quat_wxyz) == pytest.approx(1.0)
            assert all(size > 0 for size in piece.size)
            assert (len(piece.vertices) >= 8) == (piece.kind == "mesh")


@pytest.mark.parametrize("split", ["train", "test"])
def test_handles_collide_along_their_whole_length(split):
    """Points on the centreline clear of the wall lie in a capsule beyond the body."""
    model = an_object("mug", split)
    handle = model.shape.handle
    capsules = [mesh for mesh, p in zip(pieces_of("mug", split), model.collision) if p.kind == "capsule"]
    assert len(capsules) >= 4
    line = handle.centreline[handle.centreline[:, 0] > 1.1 * model.radius]
    points = np.column_stack([line[:, 0], np.zeros(len(line)), line[:, 1]])
    slack = 0.5 * handle.thickness.min() + handle.width.max() - handle.thickness.min()  # pairs beside y = 0
    outside = np.full(len(points), np.inf)
    for mesh in capsules:
        offset = (mesh.face_normals * mesh.triangles[:, 0]).sum(axis=1)
        outside = np.minimum(outside, (points @ mesh.face_normals.T - offset).max(axis=1))
    assert outside.max() < slack
