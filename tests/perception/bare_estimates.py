"""Estimates and an image that have no more than what the rules of cluttered tables look at."""

import numpy as np

from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, TriangleMesh

MASK = np.ones((4, 4), np.bool_)
FRAME = RgbdFrame(
    0.0,
    np.zeros((4, 4, 3), np.uint8),
    np.ones((4, 4), np.float32),
    CameraIntrinsics(4, 4, 4.0, 4.0, 1.5, 1.5),
    np.eye(4),
)


def found(id, score=0.9, category="can", resting="upright", n_views=2, length=0.12, radius=0.03):
    """Return an estimate of an object of a length and a radius in metres."""
    made = object.__new__(ObjectEstimate)
    mesh = TriangleMesh(
        np.array([[0.03, -radius, 0.0], [0.0, radius, 0.0], [0.0, 0.0, length]]), np.array([[0, 1, 2]])
    )
    vars(made).update(id=id, score=score, n_views=n_views, category=category, resting=resting, mesh=mesh)
    return made
