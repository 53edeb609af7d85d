"""Depth images of cans on a table, drawn from dense points on their surfaces, without noise."""

import numpy as np
import trimesh

from perception.geometry import pose_from_yaw
from perception.metrics import SurfaceSamples
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, TriangleMesh

CAMERA = CameraIntrinsics(160, 120, 145.0, 145.0, 79.5, 59.5)
REGION = ((0.0, 1.0), (-0.6, 0.2))
RADIUS, HEIGHT = 0.033, 0.12


def estimate(T=np.eye(4), mesh=None):
    if mesh is None:
        can = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=48).subdivide()
        mesh = TriangleMesh(np.asarray(can.vertices), np.asarray(can.faces))
    return ObjectEstimate(1, "can", np.zeros(16), T, np.ones(3), mesh)


def plate():
    mesh = trimesh.creation.box((1.2, 1.2, 0.001)).apply_translation((0.47, -0.2, -0.0005))
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def drawn(*objects):
    """Three views of a table with objects."""
    rng = np.random.default_rng(0)
    meshes = (plate(), *(o.mesh_world for o in objects))
    surface = np.concatenate([SurfaceSamples.of(mesh, rng, 150_000).points for mesh in meshes])
    views = []
    for azimuth, elevation in ((90, 80), (30, 50), (200, 50)):
        a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
        outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        x = np.array([-np.sin(a), np.cos(a), 0.0])
        T = np.eye(4)
        T[:3, :3] = np.stack([x, np.cross(-outward, x), -outward], axis=1)
        T[:3, 3] = np.array([0.47, -0.2, 0.03]) + 0.55 * outward
        seen = (surface - T[:3, 3]) @ T[:3, :3]
        u = np.rint(CAMERA.fx * seen[:, 0] / seen[:, 2] + CAMERA.cx).astype(int)
        v = np.rint(CAMERA.fy * seen[:, 1] / seen[:, 2] + CAMERA.cy).astype(int)
        inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
        depth = np.full((120, 160), np.inf, np.float32)
        np.minimum.at(depth, (v[inside], u[inside]), seen[inside, 2].astype(np.float32))
        depth[np.isinf(depth)] = 0
        views.append(RgbdFrame(0.0, np.zeros((120, 160, 3), np.uint8), depth, CAMERA, T))
    return views


def lying(azimuth, x, y, z=RADIUS):
    T = pose_from_yaw(azimuth, np.array([x, y, z]))
    T[:3, :3] = T[:3, :3] @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    return T


def upright(x, y, z=HEIGHT / 2):
    return pose_from_yaw(0.0, np.array([x, y, z]))
