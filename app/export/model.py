"""A reconstructed object as a rigid body: mesh, mass, inertia and convex collision pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float

from manipulation.hulls import hull_faces
from manipulation.standing import body_axis
from perception.types import ObjectEstimate
from sim_assets.objects.convex.perceived_mesh import Piece, perceived_pieces
from sim_assets.objects.user import DENSITIES

FRICTION = (0.6, 0.005, 0.0001)  # sliding, torsional, rolling


@dataclass(frozen=True)
class RigidModel:
    """Rigid-body model of one object for simulators; the body frame is the object frame of the object map.

    Attributes:
        estimate: estimate that it is built from.
        mesh: watertight surface in the object frame [m].
        pieces: corners of convex pieces in the object frame [m].
        mass: mass [kg], for a homogeneous material of the class's typical density.
        center: (3,) centre of mass in the object frame [m].
        inertia: (3, 3) inertia tensor about the centre of mass, along the object frame's axes [kg m²].
    """

    estimate: ObjectEstimate
    mesh: trimesh.Trimesh
    pieces: tuple[Piece, ...]
    mass: float
    center: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]

    @property
    def name(self) -> str:
        return self.estimate.name

    @property
    def volume(self) -> float:
        """Volume of the material in [m³]."""
        return float(self.mesh.volume)


def rigid_model(estimate: ObjectEstimate) -> RigidModel:
    """Build the rigid body of an estimate."""
    mesh = trimesh.Trimesh(estimate.mesh.vertices, estimate.mesh.faces, process=False)
    density = DENSITIES[estimate.category]
    axis = body_axis(estimate.mesh.vertices, estimate.mesh.faces, estimate.category)
    return RigidModel(
        estimate=estimate,
        mesh=mesh,
        pieces=tuple(perceived_pieces(estimate.mesh, estimate.category, axis)),
        mass=float(density * mesh.volume),
        center=np.asarray(mesh.center_mass),
        inertia=np.asarray(density * mesh.moment_inertia),
    )


def numbers(values: np.ndarray | tuple[float, ...], digits: int = 7) -> str:
    """Format numbers as an XML attribute."""
    return " ".join(f"{value:.{digits}g}" for value in np.asarray(values, dtype=np.float64).ravel())


def hull_obj(corners: Piece) -> str:
    """Return the convex hull of a piece as an OBJ file."""
    return obj_text(corners, hull_faces(corners).reshape(-1, 3))


def obj_text(vertices: Float[np.ndarray, "v 3"], faces: np.ndarray) -> str:
    """Return vertices and triangles as an OBJ file."""
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in np.asarray(faces) + 1]
    return "\n".join(lines) + "\n"
