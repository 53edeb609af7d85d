"""Finishes: patterns with known rows and colours, texture coordinates, materials in a compiled model."""

import numpy as np
import pytest
import trimesh

from sim_assets.rendering import materials
from sim_assets.rendering.headless import mujoco
from sim_assets.rendering.materials import (
    TEXTURE_SIZE,
    Finish,
    add_material,
    add_mesh,
    around,
    bands,
    cardboard,
    dots,
    gradient,
    metal,
    random_finish,
    random_ground,
    solid,
    speckle,
    stripes,
    two_tone,
    wood,
)

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def share_of_blue(texture):
    colours = texture.reshape(-1, 3)
    assert {tuple(c) for c in np.unique(colours, axis=0)} <= {(255, 0, 0), (0, 0, 255)}
    return (texture[..., 2] == 255).mean()


def test_solid_rounds_its_colour_to_bytes():
    texture = solid((1.0, 0.5, 0.0))
    assert texture.shape == (128, 256, 3) == (*TEXTURE_SIZE, 3) and texture.dtype == np.uint8
    assert np.unique(texture.reshape(-1, 3), axis=0).tolist() == [[255, 128, 0]]


@pytest.mark.parametrize(
    ("pattern", "low", "high"),
    [
        (bands, 0.03, 0.6),
        (two_tone, 0.19, 0.7),
        (stripes, 0.1, 0.65),
        (speckle, 0.02, 0.16),
        (dots, 0.1, 0.45),
    ],
)
def test_patterns_mix_two_colours_in_their_shares(pattern, low, high):
    for seed in range(8):
        assert low <= share_of_blue(pattern(RED, BLUE, np.random.default_rng(seed))) <= high


def test_bands_are_horizontal_and_the_dip_is_at_the_bottom():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        for texture in (bands(RED, BLUE, rng), two_tone(RED, BLUE, rng)):
            assert (texture == texture[:, :1]).all()
        assert tuple(texture[0, 0]) == (0, 0, 255) and tuple(texture[-1, 0]) == (255, 0, 0)


def test_gradient_runs_from_body_at_the_bottom_to_accent_at_the_top():
    texture = gradient(RED, BLUE, np.random.default_rng(0))
    assert tuple(texture[0, 0]) == (255, 0, 0) and tuple(texture[-1, 0]) == (0, 0, 255)
    assert (np.diff(texture[:, 0, 2].astype(int)) >= 0).all()


def test_cans_have_bare_metal_at_both_ends():
    texture = metal(RED, BLUE, np.random.default_rng(0))
    for row in (0, 8, -1, -12):
        assert (texture[row] == (185, 188, 194)).all()
    assert not (texture[64] == (185, 188, 194)).all()


def test_finishes_repeat_with_their_seed_and_keep_to_the_patterns_of_the_class(monkeypatch):
    def draw(seed, category="mug", wild=0.0):
        return random_finish(np.random.default_rng(seed), category, wild)

    assert np.array_equal(draw(3).texture, draw(3).texture)
    assert len({draw(seed).texture.tobytes() for seed in range(12)}) > 8
    for seed in range(20):
        finish = draw(seed)
        assert finish.texture.shape == (*TEXTURE_SIZE, 3) and finish.reflectance == 0
        assert 0.15 <= finish.specular <= 0.8 and 0.3 <= finish.shininess <= 0.9
    for pattern in ("label", "metal"):  # prints are for cans and bottles
        assert pattern not in {p.__name__ for p, _ in materials._PATTERNS["mug"]}
    wild = [draw(seed, wild=1.0) for seed in range(60)]
    assert min(f.specular for f in wild) < 0.1 and max(f.specular for f in wild) > 0.85


def test_texture_goes_once_around_the_object_and_from_bottom_to_top():
    mesh = trimesh.creation.cylinder(0.03, 0.1, sections=32)
    uv = around(mesh).reshape(-1, 3, 2)
    corners = mesh.vertices[mesh.faces]
    np.testing.assert_allclose(uv[..., 1], corners[..., 2] / 0.1 + 0.5, atol=1e-9)
    azimuth = np.arctan2(corners[..., 1], corners[..., 0])
    off_axis = np.hypot(corners[..., 0], corners[..., 1]) > 1e-6
    turns = uv[..., 0] - (azimuth / (2 * np.pi) + 0.5)
    np.testing.assert_allclose(turns[off_axis], np.round(turns[off_axis]), atol=1e-9)
    sides = np.abs(mesh.face_normals[:, 2]) < 0.5
    assert np.ptp(uv[sides, :, 0], axis=1).max() == pytest.approx(1 / 32, abs=1e-6)  # also over the seam


def test_wood_and_cardboard_keep_their_colour_with_little_contrast():
    color = (0.6, 0.45, 0.3)
    for make, contrast in ((wood, 0.15), (cardboard, 0.03)):
        image = make(np.random.default_rng(0), color) / 255
        np.testing.assert_allclose(image.mean(axis=(0, 1)), color, rtol=0.1)
        assert 0.005 < (image[..., 0] / color[0]).std() < contrast
    planks = wood(np.random.default_rng(0), color).astype(float).mean(axis=(1, 2))
    joints = np.linspace(0, 512, 7).astype(int)[:-1]
    assert (planks[joints] < 0.85 * planks.mean()).all()


def test_grounds_are_of_five_kinds_and_repeat_with_their_seed():
    grounds = [random_ground(np.random.default_rng(seed), (64, 48)) for seed in range(30)]
    assert all(ground.shape == (64, 48, 3) and ground.dtype == np.uint8 for ground in grounds)
    plain = [len(np.unique(ground.reshape(-1, 3), axis=0)) for ground in grounds]
    assert 1 in plain and 2 in plain and max(plain) > 20  # paint, tiles, wood or stone
    assert np.array_equal(grounds[4], random_ground(np.random.default_rng(4), (64, 48)))


@pytest.mark.parametrize("textured", [True, False])
def test_material_and_mesh_reach_the_compiled_model(textured):
    texture = np.random.default_rng(0).integers(0, 256, (16, 32, 3), dtype=np.uint8)
    spec = mujoco.MjSpec()
    assert add_material(spec, "glaze", Finish(texture, 0.3, 0.6, 0.1), (2.0, 3.0)) == "glaze"
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    assert add_mesh(spec, "box", mesh, textured) == "box"
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="box", material="glaze")
    model = spec.compile()
    np.testing.assert_array_equal(model.tex_data[: texture.size], texture.ravel())
    assert (model.texture("glaze").width[0], model.texture("glaze").height[0]) == (32, 16)
    material = model.mat("glaze")
    values = (material.specular[0], material.shininess[0], material.reflectance[0], *material.texrepeat)
    np.testing.assert_allclose(values, (0.3, 0.6, 0.1, 2.0, 3.0), rtol=1e-6)
    assert material.texid[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] == model.texture("glaze").id
    assert model.mesh_facenum[0] == 12 and model.mesh_texcoordnum[0] == (36 if textured else 0)
