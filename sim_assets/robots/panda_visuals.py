"""Visual geoms of the arm: convex hulls of filleted discs and blocks; no mesh files.

Every part is one convex hull, for smooth shading. A disc is a cylinder with filleted edges: two of them
along crossing axes span an elbow; in line, a tapered tube.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float

from sim_assets.rendering.headless import MjSpec, mujoco
from sim_assets.robots.panda_arm import VISUAL_GROUP

Vector = tuple[float, float, float]
Axis = Literal["x", "y", "z"]
Material = Literal["shell", "ring", "accent", "metal", "rubber", "camera", "lens"]

_MATERIALS: dict[Material, tuple[tuple[float, float, float], float, float]] = {  # colour, specular, shininess
    "shell": ((0.93, 0.93, 0.925), 0.55, 0.65),
    "ring": ((0.075, 0.08, 0.09), 0.5, 0.5),
    "accent": ((0.08, 0.33, 0.78), 0.5, 0.6),
    "metal": ((0.55, 0.57, 0.60), 0.7, 0.7),
    "rubber": ((0.06, 0.06, 0.065), 0.15, 0.2),
    "camera": ((0.42, 0.44, 0.47), 0.6, 0.6),
    "lens": ((0.02, 0.02, 0.03), 0.9, 0.9),
}
_SECTIONS = 40  # around a disc
_ARC = 5  # points of a filleted edge


@dataclass(frozen=True)
class Disc:
    """A cylinder of ``radius`` and ``length`` along ``axis``, its edges rounded by ``fillet``; all in [m]."""

    center: Vector
    axis: Axis
    radius: float
    length: float
    fillet: float

    def points(self) -> Float[np.ndarray, "n 3"]:
        """Return points whose convex hull is the disc."""
        quarter = np.linspace(0, np.pi / 2, _ARC)
        radius = self.radius - self.fillet * (1 - np.cos(quarter))
        height = self.length / 2 - self.fillet * (1 - np.sin(quarter))
        angle = np.linspace(0, 2 * np.pi, _SECTIONS, endpoint=False)
        rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rings = [
            np.column_stack([r * rim, np.full(_SECTIONS, sign * h)])
            for r, h in zip(radius, height, strict=True)
            for sign in (-1, 1)
        ]
        order = {"x": (2, 0, 1), "y": (1, 2, 0), "z": (0, 1, 2)}[self.axis]
        return np.concatenate(rings)[:, order] + self.center


@dataclass(frozen=True)
class Block:
    """A box with its corners cut by ``chamfer``; ``half`` sizes, all in [m]."""

    center: Vector
    half: Vector
    chamfer: float = 0.001

    def points(self) -> Float[np.ndarray, "n 3"]:
        """Return points whose convex hull is the block."""
        corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
        cuts = [corners * (np.array(self.half) - self.chamfer * (np.arange(3) != i)) for i in range(3)]
        return np.concatenate(cuts) + self.center


@dataclass(frozen=True)
class Part:
    """The convex hull of several solids, of one material."""

    material: Material
    solids: tuple[Disc | Block, ...]

    def mesh(self) -> trimesh.Trimesh:
        return trimesh.convex.convex_hull(np.concatenate([solid.points() for solid in self.solids]))


def _ring(
    center: Vector, axis: Axis, radius: float, material: Material = "ring", length: float = 0.014
) -> Part:
    return Part(material, (Disc(center, axis, radius, length, 0.003),))


def _finger() -> tuple[Part, ...]:
    return (
        Part("metal", (Block((0, 0.0115, 0.006), (0.0105, 0.0095, 0.006)),)),
        Part("rubber", (
            Block((0, 0.012, 0.014), (0.0095, 0.008, 0.004)),
            Block((0, 0.0075, 0.050), (0.0085, 0.0028, 0.0036)),
        )),
        Part("rubber", (Block((0, 0.003, 0.0445), (0.0085, 0.003, 0.0092), 0.0006),)),
    )  # fmt: skip


PARTS: dict[str, tuple[Part, ...]] = {
    "link0": (
        Part("ring", (
            Disc((0, 0, 0.008), "z", 0.088, 0.016, 0.004),
            Disc((-0.085, 0, 0.008), "z", 0.068, 0.016, 0.004),
        )),
        Part("shell", (
            Disc((0, 0, 0.034), "z", 0.080, 0.038, 0.010), Disc((-0.080, 0, 0.034), "z", 0.060, 0.038, 0.012),
            Disc((0, 0, 0.115), "z", 0.062, 0.034, 0.006), Disc((-0.045, 0, 0.085), "z", 0.048, 0.030, 0.014),
        )),
        _ring((0, 0, 0.138), "z", 0.0600),
    ),
    "link1": (
        Part("shell", (
            Disc((0, 0, -0.165), "z", 0.0585, 0.046, 0.004),
            Disc((0, 0, -0.08), "z", 0.0585, 0.03, 0.01),
        )),
        Part("shell", (
            Disc((0, 0, -0.105), "z", 0.0580, 0.04, 0.010),
            Disc((0, 0, 0), "y", 0.0640, 0.120, 0.026),
        )),
    ),
    "link2": (
        _ring((0, 0, 0.057), "z", 0.040), _ring((0, 0, -0.057), "z", 0.040),
        Part("shell", (
            Disc((0, 0, 0), "z", 0.060, 0.096, 0.022),
            Disc((0, -0.145, 0), "y", 0.0545, 0.044, 0.005),
        )),
        _ring((0, -0.173, 0), "y", 0.0560),
    ),
    "link3": (
        Part("shell", (
            Disc((0, 0, -0.115), "z", 0.0550, 0.042, 0.005),
            Disc((0.006, 0, -0.075), "z", 0.0550, 0.04, 0.016),
        )),
        Part("shell", (
            Disc((0.004, 0, -0.085), "z", 0.0545, 0.04, 0.016),
            Disc((0.0825, 0, 0), "y", 0.0570, 0.112, 0.024),
        )),
    ),
    "link4": (
        _ring((0, 0, 0.053), "z", 0.036), _ring((0, 0, -0.053), "z", 0.036),
        Part("shell", (
            Disc((0, 0, 0), "z", 0.0530, 0.090, 0.020),
            Disc((-0.0825, 0.075, 0), "y", 0.0530, 0.050, 0.020),
        )),
        Part("shell", (
            Disc((-0.0825, 0.075, 0), "y", 0.0530, 0.050, 0.020),
            Disc((-0.0825, 0.10, 0), "y", 0.0530, 0.03, 0.004),
        )),
        _ring((-0.0825, 0.121, 0), "y", 0.0545),
    ),
    "link5": (
        Part("shell", (
            Disc((0, 0, -0.232), "z", 0.0530, 0.050, 0.005),
            Disc((0, 0, -0.11), "z", 0.0430, 0.05, 0.010),
        )),
        Part("shell", (
            Disc((0, 0, -0.105), "z", 0.0430, 0.04, 0.010),
            Disc((0, 0, 0), "y", 0.0500, 0.100, 0.022),
        )),
    ),
    "link6": (
        _ring((0, 0, 0.047), "z", 0.032), _ring((0, 0, -0.047), "z", 0.032),
        Part("shell", (
            Disc((0, 0, 0), "z", 0.0460, 0.076, 0.018),
            Disc((0.088, 0.0, 0), "y", 0.0480, 0.076, 0.016),
        )),
        _ring((0.088, -0.0405, 0), "y", 0.0485, "accent", 0.009),
    ),
    "link7": (
        Part("shell", (Disc((0, 0, 0.0625), "z", 0.0465, 0.034, 0.006),)),
        _ring((0, 0, 0.083), "z", 0.0400, "ring", 0.010),
        Part("metal", (Disc((0, 0, 0.0985), "z", 0.0350, 0.022, 0.003),)),
    ),
    "hand": (
        Part("shell", (
            Disc((0, 0, 0.010), "z", 0.0330, 0.018, 0.004),
            Disc((0, 0.0725, 0.044), "z", 0.0295, 0.036, 0.012),
            Disc((0, -0.0725, 0.044), "z", 0.0295, 0.036, 0.012),
        )),
        Part("ring", (Block((0, 0, 0.0625), (0.0175, 0.088, 0.0035)),)),
        Part("ring", (Block((0.040, 0, 0.036), (0.014, 0.016, 0.008)),)),
        Part("camera", (
            Disc((0.0625, 0.033, 0.038), "z", 0.0125, 0.026, 0.005),
            Disc((0.0625, -0.033, 0.038), "z", 0.0125, 0.026, 0.005),
        )),
        *(
            Part("lens", (Disc((0.0625, y, 0.0507), "z", 0.0065, 0.0012, 0.0004),))
            for y in (-0.025, -0.006, 0.012, 0.030)
        ),
    ),
    "left_finger": _finger(),
    "right_finger": _finger(),
}  # fmt: skip


def dress_arm(spec: MjSpec) -> None:
    """Add visual geoms, without mass or collision, to an arm created by ``add_arm``."""
    for name, (color, specular, shininess) in _MATERIALS.items():
        spec.add_material(name=f"arm_{name}", rgba=(*color, 1), specular=specular, shininess=shininess)
    for body_name, parts in PARTS.items():
        body = spec.body(body_name)
        for index, part in enumerate(parts):
            name = f"{body_name}_visual{index}"
            mesh = part.mesh()
            spec.add_mesh(
                name=name, uservert=mesh.vertices.astype(np.float32).ravel(),
                userface=mesh.faces.astype(np.int32).ravel(), smoothnormal=part.material == "shell",
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
            )  # fmt: skip
            body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=f"arm_{part.material}",
                group=VISUAL_GROUP, contype=0, conaffinity=0, mass=0,
            )  # fmt: skip
