"""Finishes: patterns with known rows and colours, household prints, materials in a compiled model."""

import numpy as np
import pytest
import trimesh

from sim_assets.rendering import materials
from sim_assets.rendering.headless import mujoco
from sim_assets.rendering.materials import (
    ATLAS_SIZE,
    TEXTURE_SIZE,
    Finish,
    add_material,
    add_mesh,
    bands,
    distractor_finish,
    dots,
    gradient,
    household_finish,
    metal,
    packaging_finish,
    random_finish,
    solid,
    speckle,
    stripes,
    two_tone,
)
from sim_assets.rendering.texture_coordinates import ATTRIBUTE, faces

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


def test_household_crockery_is_mostly_white_and_packages_are_printed():
    def colors(category):
        drawn = [household_finish(np.random.default_rng(seed), category) for seed in range(60)]
        assert all(finish.texture.shape == (*TEXTURE_SIZE, 3) for finish in drawn)
        return np.array([np.median(finish.texture.reshape(-1, 3), axis=0) for finish in drawn])

    assert 0.3 < (colors("mug").min(axis=1) > 200).mean() < 0.8
    printed = [household_finish(np.random.default_rng(seed), "can").texture for seed in range(10)]
    assert all(len(np.unique(texture.reshape(-1, 3), axis=0)) > 20 for texture in printed)
    assert all((texture[0] == texture[-1]).all() for texture in printed)  # bare ends


@pytest.mark.parametrize(
    ("category", "following"),
    [
        ("mug", 0.017962035652556163),
        ("bowl", 0.09290142163654713),
        ("bottle", 0.23981765821431644),
        ("can", 0.20736007044427718),
        ("", 0.21102254399928255),
    ],
)
def test_tame_finishes_are_those_of_shipped_scenes(category, following):
    """Task scenes call random_finish with wild = 0, and must not change: the draws after it stay the same."""
    rng = np.random.default_rng(11)
    for _ in range(6):
        random_finish(rng, category)
    assert rng.random() == pytest.approx(following, abs=1e-12)


def test_finishes_of_distractors_follow_their_surfaces():
    leafy = distractor_finish(np.random.default_rng(0), ("leaf",), wild=0.0)
    assert leafy.texture.shape == (*ATLAS_SIZE, 3)
    assert leafy.texture[:128, :128].mean(axis=(0, 1)).argmax() == 1
    nothing = distractor_finish(np.random.default_rng(0))
    assert nothing.texture[-1].any()  # all cells are painted
    package = packaging_finish(np.random.default_rng(1)).texture
    assert len(np.unique(package[:128].reshape(-1, 3), axis=0)) > 10


def test_meshes_with_coordinates_of_their_own_keep_them():
    spec = mujoco.MjSpec()
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh.face_attributes[ATTRIBUTE] = faces(mesh)
    add_mesh(spec, "box", mesh)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="box")
    model = spec.compile()
    np.testing.assert_allclose(model.mesh_texcoord[:36], faces(mesh).reshape(-1, 2), atol=1e-6)


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
