"""Arm and hand are found in models: with branches, other mechanisms, actuators, and no names to go by."""

import pytest

from app.errors import UsageError
from app.robots.chain import find_chain
from sim_assets.rendering.headless import mujoco
from tests.sim_assets.robots.conftest import JOINTS, SLIDING, linkage, one_jaw


def chain_of(mjcf, root=""):
    return find_chain(mujoco.MjModel.from_xml_string(mjcf), root)


@pytest.mark.parametrize("mjcf", [SLIDING, linkage()], ids=["sliding", "linkage"])
def test_the_arm_ends_where_the_chain_branches(mjcf):
    chain = chain_of(mjcf)
    assert (chain.joints, chain.fingers, chain.root) == (JOINTS, ("left", "right"), "")
    assert not chain.assumptions


def test_the_joints_with_actuators_drive_the_hand():
    """Here a tendon over the outer joints of a linkage."""
    wraps = '<joint joint="right" coef=".5"/><joint joint="left" coef=".5"/>'
    tendon = f'<tendon><fixed name="t">{wraps}</fixed></tendon>'
    mjcf = linkage().replace(
        "</mujoco>", tendon + '<actuator><position tendon="t" kp="1"/></actuator></mujoco>'
    )
    assert set(chain_of(mjcf).fingers) == {"left", "right"}


def test_a_joint_that_mirrors_the_driven_one_is_driven_too():
    more = '<equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality>'
    more += '<actuator><position joint="left" kp="1"/></actuator></mujoco>'
    assert chain_of(SLIDING.replace("</mujoco>", more)).fingers == ("left", "right")
    alone = '<actuator><position joint="left" kp="1"/></actuator></mujoco>'
    assert chain_of(SLIDING.replace("</mujoco>", alone)).fingers == ("left",)


def test_one_arm_of_several():
    other = '<body name="cart"><joint name="cart" type="slide"/><geom size=".1"/></body><body name="base">'
    mjcf = SLIDING.replace('<body name="base">', other)
    chain = chain_of(mjcf, "base")
    assert chain.root == "base" and chain.joints == JOINTS
    found = chain_of(mjcf)
    assert found.joints == JOINTS and "'one' of one is the arm (--body)" in found.assumptions[0]
    with pytest.raises(UsageError, match="--body table is no body with joints; there are cart, base, one"):
        chain_of(mjcf, "table")


def test_an_arm_on_a_cart_begins_at_its_first_hinge():
    cart = '<body name="base"><joint name="drive" type="slide"/><body name="head"><joint name="nod"/>'
    mjcf = SLIDING.replace('<body name="base">', cart + '<geom size=".05"/></body>')
    chain = chain_of(mjcf)
    assert (chain.root, chain.joints, chain.fingers) == ("one", JOINTS, ("left", "right"))
    assert chain_of(mjcf, "one").joints == JOINTS


def test_joints_that_turn_without_end_belong_to_the_arm():
    chain = chain_of(SLIDING.replace('axis="1 0 0" range="-3 3"', 'axis="1 0 0"'))
    assert chain.joints == JOINTS and "'roll'" in chain.assumptions[0]


def test_the_last_joint_may_move_a_jaw_opposite_to_a_fixed_one():
    chain = chain_of(one_jaw())
    assert (chain.joints, chain.fingers) == (JOINTS, ("jaw",))
    assert chain.assumptions == ("joint 'jaw' moves one jaw, the other is fixed",)


def test_a_flange_that_turns_is_no_jaw():
    head, rest = SLIDING.split('            <body name="left">')
    flange = '<body name="flange" pos=".04 0 0"><joint name="flange" axis="1 0 0" range="-3 3"/>'
    flange += '<geom group="3" type="cylinder" size=".03 .02" euler="0 1.57 0"/></body>'
    mjcf = head + flange + rest[rest.index("          </body></body></body>") :]
    with pytest.raises(UsageError, match="the arm ends at joint 'flange' without a hand"):
        chain_of(mjcf)


@pytest.mark.parametrize(
    ("mjcf", "message"),
    [
        ("<mujoco/>", "the model has no joints"),
        (SLIDING.split('            <body name="left">')[0] + 5 * "</body>" + "</worldbody></mujoco>",
         "the arm ends at joint 'roll' without a hand: give --hand HAND.xml --mount SITE"),
    ],
)  # fmt: skip
def test_what_is_missing_is_named(mjcf, message):
    with pytest.raises(UsageError, match=message):
        chain_of(mjcf)
