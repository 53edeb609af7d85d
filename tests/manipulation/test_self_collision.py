"""Pairs of links that collision checks ignore, and collisions of links with each other."""

from dataclasses import replace

import numpy as np

from manipulation.collision import CollisionWorld
from manipulation.obstacles import TABLE
from manipulation.robot import ArmDescription, FingerMotion
from manipulation.self_collision import link_contacts

# A folding arm: the second link can swing the third onto the post.
FOLDING = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="base">
  <geom group="3" type="capsule" size=".05" fromto="0 0 .05 0 0 {top}"/>
  <body name="turret" pos="0 0 .4"><joint name="a" axis="0 0 1" range="-3 3"/>
    <geom group="3" type="cylinder" size=".05 .39"/>
    <body name="upper"><joint name="b" axis="0 1 0" range="-3 3"/>
      <geom group="3" type="capsule" size=".04" fromto=".15 0 0 .5 0 0"/>
      <body name="fore" pos=".5 0 0"><joint name="c" axis="0 1 0" range="-3.1 3.1"/>
        <geom group="3" type="capsule" size=".04" fromto=".1 0 0 .5 0 0"/>
        <site name="tcp" pos=".55 0 0"/><site name="camera"/>
        <body name="l"><joint name="l" type="slide" axis="0 1 0" range="0 .04"/></body>
        <body name="r"><joint name="r" type="slide" axis="0 1 0" range="0 .04"/></body>
      </body></body></body></body></worldbody></mujoco>"""


def arm_of(top=0.1):
    return ArmDescription(
        mjcf=FOLDING.format(top=top),
        joint_names=("a", "b", "c"), fingers=FingerMotion.sliding(("l", "r"), 0.08),
        tcp_site="tcp", camera_site="camera", q_home=np.array([0.0, -0.5, 1.0]),
        velocity_limit=np.ones(3), acceleration_limit=np.ones(3), jerk_limit=np.ones(3),
    )  # fmt: skip


def test_neighbours_are_ignored_and_distant_links_are_not():
    ignored = link_contacts(arm_of()).ignored
    assert ("turret", "upper") in ignored and ("base", "turret") in ignored
    assert ("turret", "fore") not in ignored


def test_folding_the_arm_onto_its_turret_is_a_collision_that_names_both_links():
    world = CollisionWorld(arm_of(), [], ())
    assert world.contact(np.array([0.0, -0.5, 1.0]), 0.0) is None
    contact = world.contact(np.array([0.0, 0.0, 3.05]), 0.0)
    assert {contact.obstacle, contact.link} == {"turret", "fore"}
    assert str(contact) in ("collide with turret (fore)", "collide with fore (turret)")


def test_links_that_touch_at_home_are_ignored():
    arm = replace(arm_of(), q_home=np.array([0.0, 0.0, 3.05]))
    assert ("turret", "fore") in link_contacts(arm).ignored


def test_a_link_that_turns_about_the_vertical_alone_is_not_checked_against_the_table():
    """The turret ends 1 cm above the table, less than a margin of 2 cm; the upper arm is checked."""
    assert link_contacts(arm_of()).level == {"turret"}
    world = CollisionWorld(
        arm_of(),
        [],
        (TABLE,),
    )
    assert world.contact(np.array([1.0, -0.5, 1.0]), 0.0) is None
    assert world.contact(np.array([0.0, 0.9, 0.0]), 0.0).obstacle == "table"


def test_an_arm_with_a_horizontal_first_axis_has_no_level_links():
    lying = replace(
        arm_of(), mjcf=FOLDING.format(top=0.1).replace('name="a" axis="0 0 1"', 'name="a" axis="0 1 0"')
    )
    assert link_contacts(lying).level == frozenset()
