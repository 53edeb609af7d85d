"""The Panda's visual geoms: closed-form solids, on every link, without mass or contact."""

import numpy as np
import pytest
import trimesh

from sim_assets.rendering.headless import mujoco
from sim_assets.robots.panda_arm import VISUAL_GROUP, add_arm
from sim_assets.robots.panda_visuals import PARTS, Block, Disc, Part, dress_arm


@pytest.mark.parametrize(("axis", "index"), [("x", 0), ("y", 1), ("z", 2)])
def test_disc_is_a_filleted_cylinder_along_its_axis(axis, index):
    center, radius, length, fillet = np.array([0.1, -0.2, 0.3]), 0.05, 0.08, 0.02
    points = Disc(tuple(center), axis, radius, length, fillet).points() - center
    half = np.full(3, radius)
    half[index] = length / 2
    np.testing.assert_allclose(np.abs(points).max(axis=0), half, atol=2e-4)
    along, across = np.abs(points[:, index]), np.linalg.norm(np.delete(points, index, axis=1), axis=1)
    assert across[along < length / 2 - fillet + 1e-9].max() == pytest.approx(radius)
    assert across[along > length / 2 - 1e-9].max() == pytest.approx(radius - fillet)
    edge = np.stack([across - (radius - fillet), along - (length / 2 - fillet)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(edge, axis=1), fillet)  # a quarter circle


def test_block_is_a_box_with_chamfered_edges():
    """Volume of the box less 12 edge prisms c² l / 2 plus the corners counted twice."""
    a, b, c, d = 0.03, 0.02, 0.01, 0.002
    block = Block((0.1, 0.2, 0.3), (a, b, c), d)
    mesh = trimesh.convex.convex_hull(block.points())
    np.testing.assert_allclose(mesh.bounds - (0.1, 0.2, 0.3), [(-a, -b, -c), (a, b, c)])
    edges = 4 * (2 * (a + b + c) - 6 * d) * d**2 / 2  # the straight parts of the 12 edges
    corners = 8 * d**3 * (1 - 1 / 6)  # of each corner cube a tetrahedron is left
    assert mesh.volume == pytest.approx(8 * a * b * c - edges - corners, rel=1e-6)


def test_part_is_the_hull_of_its_solids():
    ends = (Disc((0, 0, 0), "z", 0.02, 0.01, 0.001), Disc((0, 0, 0.1), "z", 0.02, 0.01, 0.001))
    tube = Part("shell", ends).mesh()
    assert tube.is_convex and tube.volume == pytest.approx(np.pi * 0.02**2 * 0.11, rel=0.01)


def test_every_body_of_the_arm_is_dressed_without_mass_or_contact():
    bare, dressed = mujoco.MjSpec(), mujoco.MjSpec()
    for spec in (bare, dressed):
        spec.compiler.degree = False
        add_arm(spec)
    dress_arm(dressed)
    before, after = bare.compile(), dressed.compile()
    np.testing.assert_array_equal(before.body_mass, after.body_mass)
    np.testing.assert_array_equal(before.body_inertia, after.body_inertia)
    visual = np.flatnonzero(after.geom_group == VISUAL_GROUP)
    assert len(visual) == sum(map(len, PARTS.values())) == after.ngeom - before.ngeom
    assert not after.geom_contype[visual].any() and not after.geom_conaffinity[visual].any()
    assert {after.body(i).name for i in after.geom_bodyid[visual]} == set(PARTS)
    assert set(PARTS) == {after.body(i).name for i in range(1, after.nbody)}
    for index in visual:
        body, number = after.geom(index).name.rsplit("_visual", 1)
        assert after.mat(after.geom_matid[index]).name == f"arm_{PARTS[body][int(number)].material}"


def test_pads_are_seen_where_they_collide():
    """The inner faces of the visible and of the colliding pads lie in the plane y = 0 of the finger."""
    for finger in ("left_finger", "right_finger"):
        pad = PARTS[finger][-1].mesh()
        assert pad.bounds[0, 1] == pytest.approx(0.0, abs=1e-9)
        assert pad.bounds[1, 2] == pytest.approx(0.0445 + 0.0092)
