"""Things of no class as rigid bodies: distractors with convex collision pieces and a mass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import trimesh

from sim_assets.datasets.distractors import random_distractor
from sim_assets.objects import CollisionPiece
from sim_assets.objects.convex.halving import DENT, halved_pieces
from sim_assets.objects.convex.pieces import hull

DENSITY = 400.0  # [kg/m³], of the hulls of the parts: most things are hollow
LIGHTEST, HEAVIEST = 0.05, 1.0  # [kg]
LONGEST, TALLEST, FLATTEST = 0.20, 0.24, 0.025  # [m], limits of the extents
MOST_PIECES = 48
THINNEST_PIECE = 1e-8  # [m³]; convex pieces without a volume are left out


@dataclass(frozen=True, eq=False)
class UnknownThing:
    """A thing of no class in its own frame, z up, resting on z = 0.

    Attributes:
        mesh: surface with its texture coordinates [m].
        collision: convex collision pieces.
        mass: mass [kg].
    """

    mesh: trimesh.Trimesh
    collision: tuple[CollisionPiece, ...]
    mass: float

    @property
    def hulls(self) -> trimesh.Trimesh:
        """Surface of the collision pieces [m]: what touches, at places a little more than the mesh."""
        hulls = [trimesh.convex.convex_hull(piece.vertices) for piece in self.collision]
        return cast(trimesh.Trimesh, trimesh.util.concatenate(hulls))


def draw_unknown(count: int, rng: np.random.Generator) -> tuple[UnknownThing, ...]:
    """Draw things of the test split's kinds, in sizes that leave room on the table for others."""
    things: list[UnknownThing] = []
    while len(things) < count:
        mesh = random_distractor(rng, "test")
        x, y, z = mesh.extents
        if max(x, y) <= LONGEST and FLATTEST <= z <= TALLEST:
            things.append(as_body(mesh))
    return tuple(things)


def as_body(mesh: trimesh.Trimesh) -> UnknownThing:
    """Return the body of a mesh: convex pieces that follow each of its parts, or one piece if there are many.

    What is bent, hollow or waisted is cut into pieces (``halved_pieces``), so that nothing touches where
    nothing is seen.
    """
    parts = [part for part in mesh.split(only_watertight=False) if len(part.vertices) > 3]
    parts = [part for part in parts if part.convex_hull.volume > THINNEST_PIECE]
    if not 1 <= len(parts) <= MOST_PIECES:
        parts = [mesh.convex_hull]
    dent = DENT
    while len(pieces := [piece for part in parts for piece in halved_pieces(part, dent)]) > MOST_PIECES:
        dent *= 2
    mass = float(np.clip(DENSITY * sum(part.convex_hull.volume for part in parts), LIGHTEST, HEAVIEST))
    return UnknownThing(mesh, tuple(hull(piece) for piece in pieces), mass)
