"""URDF: one file for each object, to load as a free body, and one scene file with all poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.drawing import CLASS_COLORS
from app.export.model import FRICTION, RigidModel, hull_obj, numbers, obj_text
from perception.io.files import write_atomically


def write_urdf(folder: Path, models: Sequence[RigidModel]) -> Path:
    """Write ``<object>.urdf``, ``scene.urdf`` and ``meshes/`` under ``urdf/``; the scene last."""
    folder = folder / "urdf"
    for model in models:
        text = obj_text(model.mesh.vertices, model.mesh.faces)
        write_atomically(folder / "meshes" / f"{model.name}.obj", text)
        for index, corners in enumerate(model.pieces):
            write_atomically(folder / _piece(model, index), hull_obj(corners))
        robot = _robot(model.name)
        robot.append(_link(model))
        write_atomically(folder / f"{model.name}.urdf", _text(robot))
    path = folder / "scene.urdf"
    write_atomically(path, _text(_scene(models)))
    return path


def _scene(models: Sequence[RigidModel]) -> xml.Element:
    """Return the scene: all objects at their poses in the world, with floating joints."""
    robot = _robot("scene")
    xml.SubElement(robot, "link", name="world")
    for model in models:
        robot.append(_link(model))
        joint = xml.SubElement(robot, "joint", name=f"{model.name}_in_world", type="floating")
        _origin(joint, model.estimate.T_world_object)
        xml.SubElement(joint, "parent", link="world")
        xml.SubElement(joint, "child", link=model.name)
    return robot


def _robot(name: str) -> xml.Element:
    robot = xml.Element("robot", name=name)
    mujoco = xml.SubElement(robot, "mujoco")  # ignored by others
    xml.SubElement(mujoco, "compiler", strippath="false", discardvisual="false", fusestatic="false")
    return robot


def _link(model: RigidModel) -> xml.Element:
    link = xml.Element("link", name=model.name)
    inertial = xml.SubElement(link, "inertial")
    center = np.eye(4)
    center[:3, 3] = model.center
    _origin(inertial, center)
    xml.SubElement(inertial, "mass", value=numbers((model.mass,)))
    rows = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    moments = {key: numbers((model.inertia[at],)) for key, at in rows.items()}
    xml.SubElement(inertial, "inertia", moments)
    visual = xml.SubElement(link, "visual")
    _mesh(visual, f"meshes/{model.name}.obj")
    paint = xml.SubElement(visual, "material", name=model.estimate.category)
    color = np.array([*CLASS_COLORS[model.estimate.category], 255]) / 255
    xml.SubElement(paint, "color", rgba=numbers(color, 4))
    for index in range(len(model.pieces)):
        _mesh(xml.SubElement(link, "collision"), _piece(model, index))
    contact = xml.SubElement(link, "contact")  # read by Bullet
    xml.SubElement(contact, "lateral_friction", value=numbers(FRICTION[:1]))
    return link


def _piece(model: RigidModel, index: int) -> str:
    """Return a unique file name: MuJoCo identifies meshes by name, regardless of folders."""
    return f"meshes/{model.name}_collision_{index:03d}.obj"


def _mesh(parent: xml.Element, filename: str) -> None:
    xml.SubElement(xml.SubElement(parent, "geometry"), "mesh", filename=filename)


def _origin(parent: xml.Element, T: Float[np.ndarray, "4 4"]) -> None:
    """Return translation, and roll, pitch, yaw about fixed axes."""
    angles = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    xml.SubElement(parent, "origin", xyz=numbers(T[:3, 3]), rpy=numbers(angles))


def _text(root: xml.Element) -> str:
    xml.indent(root)
    return '<?xml version="1.0"?>\n' + xml.tostring(root, encoding="unicode") + "\n"
