"""Drafted robot files load as they are, from any folder; wrong models are refused with the remedy."""

import tomllib

import numpy as np
import pytest

from app.errors import UsageError
from app.robots import draft
from app.robots.draft import best_lift, draft_robot
from manipulation.kinematics import Kinematics
from manipulation.workspace import ReachFit, Workspace
from sim_assets.robots import load_robot
from tests.sim_assets.robots.conftest import JOINTS, SLIDING, one_jaw


@pytest.fixture(autouse=True)
def quick_home(monkeypatch):
    """The search for a home posture has a test of its own; that for the base's height too."""
    monkeypatch.setattr(draft, "best_lift", lambda kinematics: 0.0)
    monkeypatch.setattr(draft, "arm_workspace", lambda arm: ReachFit(Workspace(), 1.0))
    monkeypatch.setattr(draft, "find_home", lambda arm, kinematics: np.array([0.0, -0.5, 2.0, 0.0]))


def test_a_drafted_file_loads(arm_file, tmp_path):
    folder = tmp_path / "cell"
    folder.mkdir()
    text = draft_robot(arm_file, folder).text
    (folder / "robot.toml").write_text(text)
    entries = tomllib.loads(text)
    assert entries["mjcf"] == "../models/arm.xml"
    assert tuple(entries["arm"]["joints"]) == JOINTS and entries["gripper"]["joints"] == ["left", "right"]
    robot = load_robot(str(folder / "robot.toml"))
    np.testing.assert_allclose(robot.description.q_home, [0, -0.5, 2, 0])
    assert "servos" in " ".join(robot.assumptions)


def test_assumptions_are_in_the_file_and_returned(arm_file, tmp_path):
    result = draft_robot(arm_file, tmp_path)
    assert len(result.assumptions) >= 4
    for assumption in result.assumptions:
        assert f"# - {assumption}" in result.text


def test_a_cell_out_of_reach_is_named(arm_file, tmp_path, monkeypatch):
    monkeypatch.setattr(draft, "arm_workspace", lambda arm: ReachFit(Workspace(), 0.45))
    assert "only 45 % of a cell is in reach" in draft_robot(arm_file, tmp_path).text


def test_an_arm_elsewhere_in_its_file_is_moved_to_the_origin(tmp_path):
    (tmp_path / "arm.xml").write_text(
        SLIDING.replace('<body name="base">', '<body name="base" pos=".4 -.3 0">')
    )
    base = tomllib.loads(draft_robot(tmp_path / "arm.xml", tmp_path).text)["arm"]["base"]
    assert base == [-0.4, 0.3, 0.0]


def test_a_first_link_below_the_table_lifts_the_arm(tmp_path):
    low = SLIDING.replace('fromto="0 0 -.05 0 0 .05"', 'fromto="0 0 -.2 0 0 .05"')
    (tmp_path / "arm.xml").write_text(low)
    base = tomllib.loads(draft_robot(tmp_path / "arm.xml", tmp_path).text)["arm"]["base"]
    assert base[2] == pytest.approx(0.03, abs=1e-3)


def test_arm_and_hand_from_two_files(tmp_path):
    head, rest = SLIDING.split('            <body name="left">')
    fingers = '<body name="left">' + rest[: rest.index("          </body></body></body>")]
    (tmp_path / "hand.xml").write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="hand"><geom size=".02"/>'
        + fingers + "</body></worldbody></mujoco>"
    )  # fmt: skip
    (tmp_path / "arm.xml").write_text(
        head + '<site name="flange"/></body></body></body></body></body></worldbody></mujoco>'
    )
    text = draft_robot(tmp_path / "arm.xml", tmp_path, tmp_path / "hand.xml", "flange").text
    (tmp_path / "robot.toml").write_text(text)
    assert tomllib.loads(text)["hand"] == {"mjcf": "hand.xml", "mount": "flange"}
    assert load_robot(str(tmp_path / "robot.toml")).description.max_width == pytest.approx(0.082, abs=1e-3)
    with pytest.raises(UsageError, match="no site or body 'tip'"):
        draft_robot(tmp_path / "arm.xml", tmp_path, tmp_path / "hand.xml", "tip")


def test_one_arm_of_a_scene_with_two_and_a_camera_on_the_other(tmp_path):
    """The drafted file keeps the given arm alone, although nothing else is left once it is cut out."""
    other = '<body name="other"><joint name="o" type="slide"/><geom size=".1"/></body>'
    camera = '<camera name="watch" mode="targetbody" target="other" pos="1 0 1"/>'
    (tmp_path / "arm.xml").write_text(SLIDING.replace("<worldbody>", "<worldbody>" + camera + other))
    text = draft_robot(tmp_path / "arm.xml", tmp_path, root="base").text
    (tmp_path / "robot.toml").write_text(text)
    assert tomllib.loads(text)["arm"]["body"] == "base"
    assert load_robot(str(tmp_path / "robot.toml")).description.joint_names


def test_a_base_is_raised_to_the_height_of_the_largest_cell(arm_file, tmp_path, monkeypatch):
    fits = {0.0: (1.0, 0.9), 0.1: (0.9, 1.0), 0.2: (0.95, 0.97), 0.3: (0.95, 0.96)}  # 1.0 is not reached
    monkeypatch.setattr(
        draft, "fit_workspace", lambda kinematics, lift: ReachFit(Workspace(fits[lift][0]), fits[lift][1])
    )
    assert best_lift(Kinematics(load_robot("panda").description)) == 0.2
    monkeypatch.setattr(draft, "best_lift", lambda kinematics: 0.2)
    result = draft_robot(arm_file, tmp_path)
    assert tomllib.loads(result.text)["arm"]["base"] == [0.0, 0.0, 0.2]
    assert "the base stands 200 mm above the table" in " ".join(result.assumptions)


def test_no_home_posture_is_a_usage_error(arm_file, tmp_path, monkeypatch):
    monkeypatch.setattr(draft, "find_home", lambda arm, kinematics: None)
    with pytest.raises(UsageError, match="no posture was found in which the hand points down"):
        draft_robot(arm_file, tmp_path)


def test_a_base_whose_first_joint_is_far_from_its_middle_is_turned(tmp_path, monkeypatch):
    """The joint turns by -1 to 3: ahead, at 0, it is 1 from the middle of its range."""
    (tmp_path / "arm.xml").write_text(
        SLIDING.replace('axis="0 0 1" range="-3 3"', 'axis="0 0 1" range="-1 3"')
    )
    text = draft_robot(tmp_path / "arm.xml", tmp_path).text
    entries = tomllib.loads(text)["arm"]
    assert entries["base_yaw"] == pytest.approx(-1.0, abs=1e-4) and entries["home"][0] == 1.0
    (tmp_path / "robot.toml").write_text(text)
    arm = load_robot(str(tmp_path / "robot.toml")).description
    T = Kinematics(arm).forward(arm.q_home)
    assert T[1, 3] == pytest.approx(0, abs=1e-3) and T[0, 3] > 0.1


@pytest.mark.parametrize(("kv", "replaced"), [(0.0, True), (30.0, False)], ids=["swinging", "damped"])
def test_servos_that_swing_are_replaced_by_ones_of_the_same_torque(tmp_path, kv, replaced):
    servos = "".join(f'<position joint="{j}" kp="900" kv="{kv}" forcerange="-70 70"/>' for j in JOINTS)
    (tmp_path / "arm.xml").write_text(SLIDING.replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>"))
    text = draft_robot(tmp_path / "arm.xml", tmp_path).text
    assert tomllib.loads(text)["arm"].get("torque") == ([70.0] * len(JOINTS) if replaced else None)
    (tmp_path / "robot.toml").write_text(text)
    assert ("servos" in " ".join(load_robot(str(tmp_path / "robot.toml")).assumptions)) == replaced


def test_an_arm_with_one_jaw_is_drafted(tmp_path):
    (tmp_path / "arm.xml").write_text(one_jaw())
    text = draft_robot(tmp_path / "arm.xml", tmp_path).text
    assert tomllib.loads(text)["gripper"]["joints"] == ["jaw"]
    (tmp_path / "robot.toml").write_text(text)
    assert load_robot(str(tmp_path / "robot.toml")).description.gripper.one_jaw


def test_a_base_that_reaches_nothing_ahead_is_turned(arm_file, tmp_path, monkeypatch):
    found = iter([None, np.array([0.0, -0.5, 2.0, 0.0])])
    monkeypatch.setattr(draft, "find_home", lambda arm, kinematics: next(found))
    entries = tomllib.loads(draft_robot(arm_file, tmp_path).text)["arm"]
    assert entries["base_yaw"] == pytest.approx(np.pi, abs=1e-4)
