"""Masks are cut where two bodies touch, on depth images of boxes and balls from above and from the side."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference.touching import convex_pieces, touching_pieces
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

F, DISTANCE = 500.0, 0.5
CAMERA = CameraIntrinsics(240, 200, F, F, 119.5, 99.5)
v, u = np.mgrid[:200, :240]
RAYS = np.stack([(u - 119.5) / F, (v - 99.5) / F, np.ones((200, 240))], axis=-1)


def sphere(x: float, radius: float, y: float = 0.0) -> np.ndarray:
    """Depth [m] of a ball whose centre is as far away as the table, infinite beside it."""
    centre = np.array([x, y, DISTANCE])
    a, b, c = (RAYS**2).sum(-1), RAYS @ centre, centre @ centre - radius**2
    root = b**2 - a * c
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def view(*bodies: np.ndarray, noise: float = 0.0, seed: int = 0) -> tuple[RgbdFrame, np.ndarray]:
    """The image of bodies on a table seen from above, and the pixels of all of them."""
    depth = np.minimum.reduce([*bodies, DISTANCE / RAYS[..., 2]])
    mask = depth < DISTANCE - 1e-6
    depth = depth + np.random.default_rng(seed).normal(0, noise, depth.shape)
    T = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, DISTANCE], [0, 0, 0, 1]])
    return RgbdFrame(0.0, np.zeros((*mask.shape, 3), np.uint8), depth.astype(np.float32), CAMERA, T), mask


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_two_balls_that_touch_are_cut_between_them(noise):
    frame, mask = view(sphere(-0.03, 0.03), sphere(0.03, 0.03), noise=noise)
    pieces = convex_pieces(frame, mask)
    assert len(pieces) == 2
    for piece, side in zip(sorted(pieces, key=lambda p: u[p].mean()), (-1, 1)):
        assert (piece & (side * (u - 119.5) > 3)).sum() > 0.97 * (mask & (side * (u - 119.5) > 3)).sum()
        assert not (piece & (side * (u - 119.5) < -3)).any()


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_one_body_is_one_piece(noise):
    """A ball, and a ridge as of a carton: convex edges are no creases."""
    ridge = DISTANCE - 0.04 + 0.6 * np.abs(u - 119.5) / F * DISTANCE
    for frame, mask in (view(sphere(0.0, 0.04), noise=noise), view(ridge, noise=noise)):
        (piece,) = convex_pieces(frame, mask)
        np.testing.assert_array_equal(piece, mask)


def test_what_is_in_front_is_cut_off():
    """A plate 3 cm above another one: no crease shows, but a step."""
    low = np.where(np.abs(u - 119.5) < 60, DISTANCE - 0.02, np.inf)
    high = np.where((u > 119.5) & (u < 170), DISTANCE - 0.05, np.inf)
    frame, mask = view(low, high)
    pieces = convex_pieces(frame, mask)
    assert len(pieces) == 2 and {int(u[p].mean()) > 130 for p in pieces} == {True, False}


def test_small_pieces_belong_to_what_is_nearest():
    """A bump that is less than the smallest part of the mask."""
    frame, mask = view(sphere(-0.02, 0.04), sphere(0.024, 0.006))
    assert len(convex_pieces(frame, mask)) == 1


def test_what_is_far_from_every_piece_is_left_out():
    """Specks of a neighbour behind a step: too small for a piece of their own."""
    body = np.where(np.hypot(u - 70, v - 100) < 50, DISTANCE - 0.05, np.inf)
    speck = np.where(np.hypot(u - 150, v - 100) < 9, DISTANCE - 0.01, np.inf)
    frame, mask = view(body, speck)
    (piece,) = convex_pieces(frame, mask)
    np.testing.assert_array_equal(piece, mask & (u < 130))


def test_without_depth_there_are_no_pieces():
    frame, mask = view(sphere(0.0, 0.03))
    assert convex_pieces(replace(frame, depth=np.zeros_like(frame.depth)), mask) == []


def test_pieces_are_associated_across_views():
    """In place of the instance, without a class; another instance stays."""
    frames, rows = [], []
    for seed in range(3):
        frame, mask = view(sphere(-0.035, 0.03), sphere(0.025, 0.03), noise=0.001, seed=seed)
        other = np.zeros_like(mask)
        other[:5, :5] = True
        frames.append(frame)
        rows.append(
            [
                ObjectDetection("can", 0.9, other, instance_id=2),
                ObjectDetection("can", 0.9, mask, instance_id=4),
            ]
        )
    cut = touching_pieces(frames, rows, {4}, SupportPlane(), 7)
    assert [sorted(d.instance_id or 0 for d in row) for row in cut] == [[2, 7, 8]] * 3
    sides = {d.instance_id: set() for row in cut for d in row}
    for row in cut:
        for d in row:
            sides[d.instance_id].add(bool(u[d.mask].mean() > 119.5))
    assert len(sides[7]) == len(sides[8]) == 1 and sides[7] != sides[8]


@pytest.mark.parametrize(("cut", "gone"), [(0, False), (1, False), (2, True)])
def test_an_instance_that_is_one_piece_in_nearly_all_views_stays(monkeypatch, cut, gone):
    frames, rows = [], []
    for number in range(3):
        bodies = [sphere(-0.03, 0.03), sphere(0.03, 0.03)] if number < cut else [sphere(0.0, 0.04)]
        frame, mask = view(*bodies)
        frames.append(frame)
        rows.append([ObjectDetection("can", 0.9, mask, instance_id=4)])
    result = touching_pieces(frames, rows, {4}, SupportPlane(), 7)
    assert (4 not in {d.instance_id for row in result for d in row}) == gone
