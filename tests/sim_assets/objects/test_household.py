"""Household sizes: valid solids of the split's families in the stated ranges; contents inside the cavity."""

import numpy as np
import pytest

from perception.types import CATEGORIES
from sim_assets.objects.bottle import KINDS as BOTTLES
from sim_assets.objects.bowl import SIDES
from sim_assets.objects.can import BENDS, SLIGHT_BENDS
from sim_assets.objects.can import KINDS as CANS
from sim_assets.objects.families import SPLITS, make_solid, sample_parameters
from sim_assets.objects.household import (
    BOTTLE_HEIGHT,
    BOWL_HEIGHT,
    CAN_HEIGHT,
    MUG_HEIGHT,
    contents_of,
    sample_household,
)
from sim_assets.objects.mug import BODIES
from sim_assets.rendering.texture_coordinates import ATTRIBUTE

FAMILIES = {
    "mug": ("body", BODIES),
    "bowl": ("side", SIDES),
    "bottle": ("kind", BOTTLES),
    "can": ("kind", {"train": (*CANS["train"], *SLIGHT_BENDS), "test": CANS["test"]}),
}
HEIGHT = {"mug": MUG_HEIGHT, "bowl": BOWL_HEIGHT, "bottle": BOTTLE_HEIGHT, "can": CAN_HEIGHT}


def sampled(category, split="train", count=400, seed=0):
    rng = np.random.default_rng(seed)
    return [sample_household(category, split, rng) for _ in range(count)]


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("category", CATEGORIES)
def test_solids_are_watertight_and_of_the_size_and_families_asked_for(category, split):
    name, families = FAMILIES[category]
    for p in sampled(category, split, 30):
        mesh = make_solid(p).mesh()
        assert mesh.is_watertight and mesh.volume > 0
        assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
        assert mesh.extents[2] == pytest.approx(p.height, abs=1e-3)
        assert HEIGHT[category][0] <= p.height <= HEIGHT[category][1]
        assert getattr(p, name) in families[split]


def near(p, diameter, height, tolerance=0.15):
    return abs(2 * p.radius / diameter - 1) < tolerance and abs(p.height / height - 1) < tolerance


@pytest.mark.parametrize(
    ("category", "diameter", "height"),
    [
        ("can", 0.085, 0.033),  # tuna
        ("can", 0.066, 0.101),  # soup
        ("can", 0.102, 0.139),  # coffee
        ("can", 0.075, 0.250),  # tube of crisps
        ("can", 0.090, 0.190),  # wipes
        ("bowl", 0.160, 0.055),
        ("bowl", 0.250, 0.110),
        ("bowl", 0.092, 0.040),  # dip
        ("mug", 0.080, 0.095),
        ("mug", 0.060, 0.058),  # espresso
        ("bottle", 0.110, 0.320),
        ("bottle", 0.050, 0.160),
        ("bottle", 0.070, 0.110),  # jam jar
    ],
)
def test_packages_and_crockery_on_sale_occur(category, diameter, height):
    assert any(near(p, diameter, height) for p in sampled(category, count=1500))


def test_families_themselves_end_where_a_gripper_ends():
    """Training grids and task scenes depend on the family samplers, which household sizes leave alone."""
    rng = np.random.default_rng(0)
    cans = [sample_parameters("can", "train", rng) for _ in range(200)]
    assert max(p.radius for p in cans) <= 0.038 and max(p.height for p in cans) <= 0.170


def test_same_seed_same_sample():
    assert sampled("can", count=5) == sampled("can", count=5) != sampled("can", count=5, seed=1)


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("category", ["bowl", "mug"])
def test_contents_lie_in_the_cavity(category, split):
    rng = np.random.default_rng(2)
    filled = 0
    for p in sampled(category, split, 25):
        contents = contents_of(p, rng)
        if contents is None:
            continue
        filled += 1
        assert contents.is_watertight and contents.volume > 0
        assert contents.bounds[0, 2] > 0 and contents.bounds[1, 2] <= p.height
        assert not make_solid(p).inside(contents.vertices).any()
    assert filled > 20


def test_liquids_are_flat_and_food_in_heaps():
    rng = np.random.default_rng(3)
    mug = contents_of(sampled("mug", count=1)[0], rng)
    assert mug.metadata["surfaces"] == ("liquid",) and ATTRIBUTE in mug.face_attributes
    top = mug.vertices[mug.vertices[:, 2] > mug.bounds[1, 2] - 1e-9]
    assert len(top) > 40  # all of the surface, rim of the liquid included
    kinds = {contents_of(p, rng).metadata["surfaces"] for p in sampled("bowl", count=20)}
    assert kinds == {("liquid",), ("food",)}


def test_closed_objects_hold_nothing():
    rng = np.random.default_rng(4)
    for category in ("bottle", "can"):
        assert contents_of(sampled(category, count=1)[0], rng) is None


def test_training_cans_are_less_curved_than_any_test_can():
    rng = np.random.default_rng(0)
    cans = [sample_household("can", "train", rng) for _ in range(200)]
    kinds = {can.kind for can in cans}
    assert set(SLIGHT_BENDS) <= kinds and not kinds & set(CANS["test"])
    relatives = {"ribbed": "beaded", "bowed": "keg", "drawn": "waisted", "conic": "tapered"}
    curved = [can for can in cans if can.kind in relatives]
    assert curved and all(can.bend < BENDS[relatives[can.kind]][0] for can in curved)
    assert {sample_household("can", "test", rng).kind for _ in range(60)} == set(CANS["test"])
