import numpy as np
import pytest
import trimesh

from perception.mesh_sections import cross_section, outermost, radial_hits

TUBE = trimesh.creation.annulus(r_min=0.036, r_max=0.04, height=0.1, sections=128)


def cut(mesh, z):
    return cross_section(np.asarray(mesh.vertices), np.asarray(mesh.faces), z)


def test_section_of_a_tube_has_two_walls():
    hits = radial_hits(cut(TUBE, 0.01), np.zeros(2), 0.3)
    assert hits == pytest.approx([0.036, 0.040], abs=2e-5)


def test_section_of_a_cube_is_its_square_outline():
    segments = cut(trimesh.creation.box((0.2, 0.1, 0.3)), 0.07)
    assert np.abs(segments[..., 0]).max() == pytest.approx(0.1)
    assert np.abs(segments[..., 1]).max() == pytest.approx(0.05)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum()
    assert length == pytest.approx(0.6)


def test_section_of_a_cone_is_interpolated_between_its_vertices():
    """At a quarter of the height the radius of a cone is three quarters of that of its base."""
    cone = trimesh.creation.cone(radius=0.08, height=0.2, sections=256)
    distance = np.linalg.norm(cut(cone, 0.05), axis=-1)
    assert distance == pytest.approx(0.06, rel=2e-4)


@pytest.mark.parametrize("z", [-0.051, 0.051])
def test_planes_outside_the_mesh_give_no_segments(z):
    assert cut(TUBE, z).shape == (0, 2, 2)
    assert len(radial_hits(cut(TUBE, z), np.zeros(2), 0.0)) == 0


def test_rays_start_at_the_centre_and_hits_are_sorted():
    segments = cut(trimesh.creation.box((0.2, 0.1, 0.3)), 0.07)
    center = np.array([0.06, 0.02])
    assert radial_hits(segments, center, 0.0) == pytest.approx([0.04])
    assert radial_hits(segments, center, np.pi / 2) == pytest.approx([0.03])
    assert radial_hits(segments, center, np.pi) == pytest.approx([0.16])
    assert radial_hits(segments, np.array([-0.5, 0.0]), 0.0) == pytest.approx([0.4, 0.6])
    assert len(radial_hits(segments, np.array([-0.5, 0.0]), np.pi)) == 0


def test_hits_closer_than_a_tenth_of_a_millimetre_are_one():
    walls = np.array([[[x, -1.0], [x, 1.0]] for x in (0.1, 0.10005, 0.1003)])
    assert radial_hits(walls, np.zeros(2), 0.0) == pytest.approx([0.1, 0.1003])


def test_outermost_crossings_are_those_of_single_rays():
    outline = cut(trimesh.creation.box((0.2, 0.1, 0.3)), 0.07)
    beyond = np.array([[[0.3, -1.0], [0.3, 1.0]]])  # seen along +x only
    found = outermost(np.concatenate([outline, beyond]), np.array([0.0, np.pi / 2, np.pi, -2.0]))
    single = radial_hits(outline, np.zeros(2), -2.0)[-1]
    assert found == pytest.approx([0.3, 0.05, 0.1, single])


def test_a_ray_that_crosses_nothing_is_infinite():
    walls = np.array([[[0.1, -1.0], [0.1, 1.0]]])
    assert outermost(walls, np.array([0.0, np.pi])) == pytest.approx([0.1, np.inf])
    assert np.isinf(outermost(np.zeros((0, 2, 2)), np.zeros(1))).all()
