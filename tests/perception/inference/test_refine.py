"""Meshes moved to measurements: a can drawn too small, too high and beside its place."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.geometry import transform_points
from perception.inference.observation import ObjectObservation
from perception.inference.refine import (
    RefineConfig,
    _depth_displacement,
    _section_harmonics,
    _View,
    refine_mesh,
)
from perception.surface_geometry import mesh_edges, vertex_normals
from perception.types import SupportPlane, TriangleMesh

PLANE = SupportPlane()


@pytest.fixture(scope="module")
def can(make_table):
    return make_table("can", (1.0, 0.0), yaw=0.0)


def cylinder(can, wider: float = 0.0, higher: float = 0.0, edge: float = 0.004) -> TriangleMesh:
    """A closed cylinder about the can's axis, standing on the plane, in the world."""
    x, y = can.pose.translation[:2]
    radius, height = 0.63 * 0.05 + wider, 2 * 0.75 * 0.05 + higher
    mesh = trimesh.creation.cylinder(radius, height, sections=48).subdivide_to_size(edge)
    return TriangleMesh(mesh.vertices + np.array([x, y, height / 2]), mesh.faces)


def on_side(mesh: TriangleMesh) -> np.ndarray:
    return (mesh.vertices[:, 2] > 0.01) & (mesh.vertices[:, 2] < 0.06)


def radii(mesh: TriangleMesh, can) -> np.ndarray:
    return np.linalg.norm(mesh.vertices[:, :2] - can.pose.translation[:2], axis=1)


def test_a_can_too_narrow_and_too_high_is_put_right(can) -> None:
    start = cylinder(can, wider=-0.002, higher=0.003)
    refined = refine_mesh(start, can.observations((0.0, 2.1, 4.2)), PLANE).mesh
    side = on_side(start)
    assert np.median(np.abs(radii(refined, can)[side] - 0.0315)) < 0.0004
    top = start.vertices[:, 2] > 0.0779
    middle = top & (radii(start, can) < 0.02)
    assert abs(np.median(refined.vertices[middle, 2]) - 0.075) < 0.0005
    assert abs(refined.vertices[:, 2].min()) < 0.001
    assert (refined.faces == start.faces).all()


def test_a_dome_on_a_coarse_mesh_is_flattened(can) -> None:
    """The stiffness is per length: few long edges bend as much as many short ones."""
    for edge in (0.009, 0.0045):
        start = cylinder(can, edge=edge)
        top = (start.vertices[:, 2] > 0.0749) & (radii(start, can) < 0.028)
        dome = start.vertices.copy()
        dome[top, 2] += 0.005 * (1 - (radii(start, can)[top] / 0.028) ** 2)
        seen = can.observations((0.0, 2.1, 4.2))
        refined = refine_mesh(TriangleMesh(dome, start.faces), seen, PLANE).mesh
        assert np.abs(refined.vertices[top & (radii(start, can) < 0.02), 2] - 0.075).max() < 0.001


def test_the_hidden_side_follows_what_all_sides_share(can) -> None:
    start = cylinder(can, wider=-0.002)
    result = refine_mesh(start, can.observations((0.0,)), PLANE)
    refined = result.mesh
    away = on_side(start) & (start.vertices[:, 0] < can.pose.translation[0] - 0.02)
    near = on_side(start) & (start.vertices[:, 0] > can.pose.translation[0] + 0.02)
    seen, hidden = radii(refined, can)[near].mean(), radii(refined, can)[away].mean()
    assert seen == pytest.approx(0.0315, abs=0.0004)
    assert 0.030 < hidden < seen
    assert result.determined[near].mean() > 0.9 and result.determined[away].mean() < 0.3


def test_nothing_moves_without_a_common_part_where_nothing_is_seen(can) -> None:
    start = cylinder(can, wider=-0.002)
    config = RefineConfig(common_sigma=1e-6, roughness=0.25)
    refined = refine_mesh(start, can.observations((0.0,)), PLANE, config).mesh
    farthest = start.vertices[:, 0] < can.pose.translation[0] - 0.028
    assert np.abs(radii(refined, can) - radii(start, can))[farthest & on_side(start)].max() < 0.0006


def test_corners_that_all_heights_share_are_found_although_the_surface_is_stiff(can) -> None:
    """An octagonal start becomes round; without harmonics, a stiff surface keeps its corners."""
    x, y = can.pose.translation[:2]
    start = cylinder(can)
    flat = start.vertices[:, :2] - (x, y)
    wave = 1 + 0.06 * np.cos(8 * np.arctan2(flat[:, 1], flat[:, 0]) + 0.7)
    octagon = np.column_stack([flat * wave[:, None] + (x, y), start.vertices[:, 2]])
    start = TriangleMesh(octagon, start.faces)
    stiff = RefineConfig(roughness=5e-3)
    seen, side = can.observations((0.0, 1.6, 3.1, 4.7)), on_side(start)
    uneven = [
        radii(refine_mesh(start, seen, PLANE, stiff, T).mesh, can)[side].std()
        for T in (None, can.pose.T_world_object)
    ]
    assert uneven[0] > 0.001 > 0.0004 > uneven[1]


def test_harmonics_move_inner_and_outer_walls_to_the_same_side() -> None:
    """Azimuths are those in the object frame, about the middle of the extents."""
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = [1.0, 2.0, 0.5]
    local = np.array([[0.05, 0.0, 0.1], [0.04, 0.0, 0.1], [0.0, 0.05, 0.1], [-0.05, -0.05, 0.1]])
    normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]])
    found = _section_harmonics(transform_points(T, local), normals @ T[:3, :3].T, T, (4, 6))
    # cos(4 phi), cos(6 phi), sin(4 phi), sin(6 phi) by the radial component of the normal
    np.testing.assert_allclose(
        found, [[1, 1, 0, 0], [-1, -1, 0, 0], [0.6, -0.6, 0, 0], [0, 0, 0, 0]], atol=1e-9
    )


def test_background_beside_the_mask_trims_what_sticks_out(can) -> None:
    start = cylinder(can, higher=0.02)
    refined = refine_mesh(start, can.observations((0.0, 2.1, 4.2)), PLANE, RefineConfig(limit=0.03)).mesh
    middle = (start.vertices[:, 2] > 0.0949) & (radii(start, can) < 0.025)
    assert np.median(refined.vertices[middle, 2]) < 0.088


def test_covered_pixels_say_nothing(can) -> None:
    start = cylinder(can, wider=-0.002)
    (seen,) = can.observations((0.0,))
    covered = type(seen)(seen.frame, seen.mask, np.ones_like(seen.mask))
    refined = refine_mesh(start, [covered], PLANE, RefineConfig(smoothing=0)).mesh
    np.testing.assert_allclose(refined.vertices[:, :2], start.vertices[:, :2], atol=2e-4)


def test_smoothing_takes_the_staircase_and_not_the_size(can) -> None:
    start = cylinder(can)
    rng = np.random.default_rng(0)
    rough = TriangleMesh(start.vertices + rng.normal(0, 3e-4, start.vertices.shape), start.faces)
    far_away = can.observations((0.0,))[:0]
    side = on_side(start)
    spread = []
    for smoothing in (0, 5):
        config = RefineConfig(smoothing=smoothing, support_sigma=1.0)
        smooth = refine_mesh(rough, far_away, SupportPlane(offset=-0.01), config).mesh
        spread.append(radii(smooth, can)[side].std())
        assert radii(smooth, can)[side].mean() == pytest.approx(0.0315, abs=2e-4)
    assert spread[1] < 0.5 * spread[0]


def measured(mesh: TriangleMesh, seen: ObjectObservation, config: RefineConfig) -> tuple:
    """The view, and precision and displacement of every vertex, before any prior."""
    normals = vertex_normals(mesh)
    edges = mesh.vertices[mesh_edges(mesh.faces)]
    length = float(np.median(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1)))
    view = _View.of(length, mesh.vertices, normals, seen)
    return view, *_depth_displacement(view, seen, config)


def test_depth_holes_are_no_measurements(can) -> None:
    """Vertices near a hole are not measured, and no mean is taken over a hole."""
    mesh, (seen,) = cylinder(can, wider=-0.002), can.observations((0.0,))
    config = RefineConfig(reach=1.0)  # nothing is rejected for its distance
    view, whole, _ = measured(mesh, seen, config)
    rows, columns = (np.rint(np.median(k)).astype(int) for k in np.nonzero(seen.mask))
    depth = seen.frame.depth.copy()
    depth[rows - 4 : rows + 5, columns - 4 : columns + 5] = 0.0
    holed = ObjectObservation(replace(seen.frame, depth=depth), seen.mask)
    view, precision, displacement = measured(mesh, holed, config)
    v, u = view.at[0] + view.window[0].start, view.at[1] + view.window[1].start
    near = (np.abs(v - rows) <= 4 + config.edge) & (np.abs(u - columns) <= 4 + config.edge)
    assert whole[near & (view.cosine < -0.5)].any() and not precision[near].any()
    assert precision.any() and np.abs(displacement[precision > 0]).max() < 0.01


def test_measured_displacement_is_the_residual_along_the_normal(can) -> None:
    mesh, (seen,) = cylinder(can, wider=-0.002), can.observations((0.0,))
    config = RefineConfig()
    view, precision, displacement = measured(mesh, seen, config)
    side = (precision > 0) & on_side(mesh) & (view.cosine < -0.7)
    np.testing.assert_allclose(np.median(displacement[side]), 0.002, atol=4e-4)
    steep = view.cosine > -config.steepest
    assert not precision[steep].any()
    assert precision.max() < config.floor_sigma**-2


def test_measurements_out_of_reach_belong_to_something_else(can) -> None:
    mesh, (seen,) = cylinder(can, wider=-0.01), can.observations((0.0,))
    side = on_side(mesh)
    assert not measured(mesh, seen, RefineConfig(reach=0.008))[1][side].any()
    assert measured(mesh, seen, RefineConfig(reach=0.03))[1][side].any()


def test_the_mesh_is_not_moved_farther_than_the_limit(can) -> None:
    start = cylinder(can, wider=-0.008)
    config = RefineConfig(limit=0.003, smoothing=0)
    refined = refine_mesh(start, can.observations((0.0, 2.1, 4.2)), PLANE, config).mesh
    moved = np.linalg.norm(refined.vertices - start.vertices, axis=1)
    assert 0.0029 < moved.max() < 0.003 + 1e-9


def test_the_mesh_does_not_enter_the_plane(can) -> None:
    start = cylinder(can)
    low = TriangleMesh(start.vertices - [0, 0, 0.004], start.faces)
    refined = refine_mesh(low, can.observations((0.0,)), PLANE).mesh
    assert refined.vertices[:, 2].min() > -1e-12
