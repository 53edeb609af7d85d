"""Geoms that collide, and those of the fingers, which hold."""

import pytest

from sim_assets.rendering.headless import mujoco
from sim_assets.robots.solid_geoms import is_solid, set_contacts

ARM = """<mujoco><worldbody><body name="base"><geom name="shell" size=".1" contype="0" conaffinity="0"/>
<body name="link"><joint name="turn"/><geom name="solid" group="3" size=".1"/><geom name="shown" size=".1"/>
<body name="finger"><joint name="slide" type="slide"/><geom name="stem" group="3" size=".01"/>
<body name="tip"><geom name="pad" size=".01"/></body></body></body></body></worldbody></mujoco>"""
OTHER = '<body><joint name="other" type="slide"/><geom group="3" size=".01"/></body>'


def geoms_of(mjcf, wrist="turn"):
    spec = mujoco.MjSpec.from_string(mjcf)
    set_contacts(spec, wrist)
    return {geom.name: geom for geom in spec.geoms}


def test_solid_geoms_are_those_of_group_3_or_else_those_that_collide():
    geoms = geoms_of(ARM)
    assert {name for name, geom in geoms.items() if is_solid(geom)} == {"shell", "solid", "stem", "pad"}
    assert all(geom.conaffinity == is_solid(geom) for geom in geoms.values())


def test_a_base_without_collision_geoms_is_solid_as_it_looks_and_other_links_are_not():
    assert is_solid(geoms_of(ARM)["shell"])
    carried = ARM.replace('<body name="base">', '<body name="base"><joint name="carry"/>')
    assert not is_solid(geoms_of(carried)["shell"])


@pytest.mark.parametrize(("more", "fixed"), [(OTHER, (0, 3)), ("", (1, 4))])
def test_the_fingers_hold_pads_and_of_one_jaw_the_fixed_part_too(more, fixed):
    geoms = geoms_of(ARM.replace('<body name="finger">', f'{more}<body name="finger">'))
    contacts = {name: (geom.priority, geom.condim) for name, geom in geoms.items()}
    assert contacts["stem"] == contacts["pad"] == (1, 4)
    assert contacts["solid"] == fixed and contacts["shell"] == (0, 3)


def test_an_arm_without_a_known_wrist_has_no_pads():
    assert all(geom.priority == 0 for geom in geoms_of(ARM, "").values())
    assert all(geom.priority == 0 for geom in geoms_of(ARM, "none").values())
