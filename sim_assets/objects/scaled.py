"""Scaled copies of objects, for arms of short reach or small hands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from sim_assets.objects.convex.pieces import CollisionPiece
from sim_assets.objects.model import LIGHTEST, ObjectModel, Shape


@dataclass(frozen=True, eq=False)
class ScaledShape:
    """Geometry of a scaled object.

    Attributes:
        shape: geometry of the original.
        scale: lengths relative to it.
    """

    shape: Shape
    scale: float

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        return self.scale * self.shape.bounds

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which points are inside the material."""
        return self.shape.inside(points / self.scale)

    def is_handle(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which surface points belong to a mug's handle."""
        return self.shape.is_handle(points / self.scale)


def scaled(model: ObjectModel, scale: float) -> ObjectModel:
    """Return an object of the same material with all lengths multiplied by ``scale``."""
    if scale == 1.0:
        return model
    mesh = model.mesh.copy()
    mesh.apply_scale(scale)
    return replace(
        model,
        mesh=mesh,
        collision=tuple(_scaled_piece(piece, scale) for piece in model.collision),
        mass=max(model.mass * scale**3, LIGHTEST),
        parameters=None,
        shape=ScaledShape(model.shape, scale),
    )


def _scaled_piece(piece: CollisionPiece, scale: float) -> CollisionPiece:
    return replace(
        piece,
        position=scale * piece.position,
        size=tuple(scale * length for length in piece.size),
        vertices=scale * piece.vertices,
    )
