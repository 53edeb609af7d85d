"""URDF: metres, kilograms, roll-pitch-yaw about fixed axes, one collision mesh for each piece."""

from __future__ import annotations

from xml.etree import ElementTree as xml

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from app.drawing import CLASS_COLORS
from app.export.urdf import write_urdf


def floats(text: str) -> np.ndarray:
    return np.array(text.split(), dtype=float)


@pytest.fixture
def folder(box_body, tmp_path):
    assert write_urdf(tmp_path, [box_body]) == tmp_path / "urdf" / "scene.urdf"
    return tmp_path / "urdf"


def test_joint_in_the_scene_has_the_pose_of_the_object(folder, box_body):
    T = box_body.estimate.T_world_object
    joint = xml.parse(folder / "scene.urdf").getroot().find("joint")
    origin = joint.find("origin")
    np.testing.assert_allclose(floats(origin.get("xyz")), T[:3, 3], atol=1e-6)
    roll, pitch, yaw = floats(origin.get("rpy"))
    rotation = (
        Rotation.from_euler("z", yaw) * Rotation.from_euler("y", pitch) * Rotation.from_euler("x", roll)
    )
    np.testing.assert_allclose(rotation.as_matrix(), T[:3, :3], atol=1e-6)
    assert joint.get("type") == "floating"
    assert (joint.find("parent").get("link"), joint.find("child").get("link")) == ("world", "bottle_7")


@pytest.mark.parametrize("name", ["scene", "bottle_7"])
def test_inertial_is_that_of_the_body(folder, box_body, name):
    inertial = xml.parse(folder / f"{name}.urdf").getroot().find("link[@name='bottle_7']/inertial")
    np.testing.assert_allclose(floats(inertial.find("origin").get("xyz")), box_body.center, atol=1e-6)
    np.testing.assert_allclose(floats(inertial.find("origin").get("rpy")), 0, atol=1e-9)
    assert float(inertial.find("mass").get("value")) == pytest.approx(0.3)
    rows = [["ixx", "ixy", "ixz"], ["ixy", "iyy", "iyz"], ["ixz", "iyz", "izz"]]
    moments = [[float(inertial.find("inertia").get(key)) for key in row] for row in rows]
    np.testing.assert_allclose(moments, box_body.inertia, rtol=1e-6)


def test_meshes_are_in_metres_in_the_object_frame(folder):
    link = xml.parse(folder / "bottle_7.urdf").getroot().find("link")
    visual = trimesh.load(folder / link.find("visual/geometry/mesh").get("filename"), force="mesh")
    np.testing.assert_allclose(visual.bounds, [(-0.01, -0.01, 0.0), (0.03, 0.05, 0.1)], atol=1e-6)
    pieces = [
        trimesh.load(folder / mesh.get("filename"), force="mesh")
        for mesh in link.findall("collision/geometry/mesh")
    ]
    assert len(pieces) == 2
    for piece, low in zip(pieces, (0.0, 0.05), strict=True):
        assert piece.is_watertight and piece.volume == pytest.approx(0.04 * 0.06 * 0.05)
        np.testing.assert_allclose(piece.bounds[:, 2], (low, low + 0.05), atol=1e-6)


def test_colour_and_friction(folder):
    link = xml.parse(folder / "bottle_7.urdf").getroot().find("link")
    rgba = floats(link.find("visual/material/color").get("rgba"))
    np.testing.assert_allclose(rgba, (*np.array(CLASS_COLORS["bottle"]) / 255, 1), atol=1e-3)
    assert float(link.find("contact/lateral_friction").get("value")) == 0.6
