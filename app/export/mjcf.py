"""MJCF: every object a free body above the support plane, with visual meshes and convex collision pieces."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.drawing import CLASS_COLORS
from app.export.model import FRICTION, RigidModel, numbers, obj_text
from perception.io.files import write_atomically
from perception.types import SupportPlane

GRAVITY = 9.81  # [m/s²]


def write_mjcf(folder: Path, models: Sequence[RigidModel], plane: SupportPlane) -> Path:
    """Write ``scene.xml`` and ``meshes/``; the scene last, so that an existing scene is complete."""
    for model in models:
        text = obj_text(model.mesh.vertices, model.mesh.faces)
        write_atomically(folder / "meshes" / f"{model.name}.obj", text)
    path = folder / "scene.xml"
    write_atomically(path, mjcf(models, plane))
    return path


def mjcf(models: Sequence[RigidModel], plane: SupportPlane) -> str:
    """Return the scene's XML."""
    root = xml.Element("mujoco", model="reconstruction")
    xml.SubElement(root, "compiler", angle="radian", meshdir="meshes")
    gravity = numbers(-GRAVITY * plane.normal)
    xml.SubElement(
        root, "option", timestep="0.002", integrator="implicitfast", cone="elliptic", impratio="10",
        gravity=gravity,
    )  # fmt: skip
    _defaults(root)
    assets, world = xml.SubElement(root, "asset"), xml.SubElement(root, "worldbody")
    _surroundings(assets, world, models, plane)
    for category, color in CLASS_COLORS.items():
        rgba = numbers(np.array([*color, 255]) / 255, 4)
        xml.SubElement(assets, "material", name=category, rgba=rgba, specular="0.4", shininess="0.5")
    for model in models:
        _body(assets, world, model)
    xml.indent(root)
    return xml.tostring(root, encoding="unicode") + "\n"


def _defaults(root: xml.Element) -> None:
    defaults = xml.SubElement(root, "default")
    contact = {"friction": numbers(FRICTION), "condim": "4", "solref": "0.006 1", "solimp": "0.95 0.99 0.001"}
    xml.SubElement(defaults, "geom", contact)
    look = xml.SubElement(defaults, "default", {"class": "visual"})
    xml.SubElement(look, "geom", type="mesh", contype="0", conaffinity="0", group="2", mass="0")
    touch = xml.SubElement(defaults, "default", {"class": "collision"})
    xml.SubElement(touch, "geom", contact, type="mesh", group="3", mass="0", rgba="0.3 0.7 0.3 0.4")


def _surroundings(
    assets: xml.Element, world: xml.Element, models: Sequence[RigidModel], plane: SupportPlane
) -> None:
    """Add light, sky and the support, just low enough that no object penetrates it initially."""
    xml.SubElement(
        assets, "texture", type="skybox", builtin="gradient", rgb1="0.65 0.72 0.8", rgb2="0.25 0.3 0.4",
        width="256", height="256",
    )  # fmt: skip
    vertices = np.concatenate([model.estimate.mesh_world.vertices for model in models])
    lowest = float((vertices @ plane.normal).min())
    middle = vertices.mean(axis=0)
    middle += (min(plane.offset, lowest) - middle @ plane.normal) * plane.normal
    pose = {"pos": numbers(middle), "quat": numbers(wxyz(upright(plane.normal)))}
    look = {"type": "plane", "size": "2 2 0.1", "rgba": "0.75 0.72 0.68 1"}
    xml.SubElement(world, "geom", pose | look, name="support")
    above = middle + 1.5 * plane.normal
    xml.SubElement(world, "light", pos=numbers(above), dir=numbers(-plane.normal), diffuse="0.7 0.7 0.7")


def _body(assets: xml.Element, world: xml.Element, model: RigidModel) -> None:
    T = model.estimate.T_world_object
    body = xml.SubElement(
        world, "body", name=model.name, pos=numbers(T[:3, 3]), quat=numbers(wxyz(T[:3, :3]))
    )
    xml.SubElement(body, "freejoint", name=model.name)
    moments = model.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    xml.SubElement(
        body, "inertial", pos=numbers(model.center), mass=numbers((model.mass,)), fullinertia=numbers(moments)
    )
    xml.SubElement(assets, "mesh", name=model.name, file=f"{model.name}.obj", inertia="shell")
    look = {"class": "visual", "name": model.name, "mesh": model.name, "material": model.estimate.category}
    xml.SubElement(body, "geom", look)
    for index, corners in enumerate(model.pieces):
        name = f"{model.name}_{index}"
        xml.SubElement(assets, "mesh", name=name, vertex=numbers(corners, 6), inertia="convex")
        xml.SubElement(body, "geom", {"class": "collision", "name": name, "mesh": name})


def upright(normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return a rotation whose z axis is the normal; the identity if the normal is z."""
    return Rotation.align_vectors(normal[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()


def wxyz(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
