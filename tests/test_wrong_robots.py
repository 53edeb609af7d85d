"""Wrong robot files and models on the command line: a line for each problem with its cure, exit code 2."""

import shutil
from pathlib import Path

import pytest

import sim_assets.robots
from app.cli import run as run_cli
from tests.sim_assets.robots.conftest import JOINTS, SLIDING, one_jaw
from tests.sim_assets.robots.conftest import write as write  # the fixture

SIXAXIS = Path(sim_assets.robots.__file__).parent / "sixaxis"
HEAD = '[gripper]\njoints = ["left", "right"]'
SERVO = '<actuator><position name="grip" joint="left" kp="{}" ctrlrange="-.1 .04"/></actuator>'
COUPLED = '<equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality></mujoco>'
NAMED = f'{HEAD}\nactuator = "grip"\nopen = 0.04\nclosed = 0.0\npress = -0.02\n#'
PAD = 'group="3" type="box" size=".05 .005'


def driven(kp):
    return ("xml", "</mujoco>", SERVO.format(kp) + COUPLED)


def servos(attributes, kp):
    named = "".join(f'<position joint="{name}" {attributes.format(kp)}/>' for name in JOINTS)
    return [("xml", "</mujoco>", f"<actuator>{named}</actuator></mujoco>")]


# Replacements of the files of a small arm, and the message.
SMALL = {
    "no TOML": ([("toml", "[arm]", "[arm")], "cannot be read as TOML"),
    "no model": ([("toml", "mjcf =", "# ")], "mjcf is missing"),
    "model elsewhere": ([("toml", "arm.xml", "arms.xml")], "arms.xml: no such MJCF file"),
    "variable": ([("toml", "arm.xml", "${NO_ARMS}/arm.xml")], "set the environment variable NO_ARMS"),
    "cut off": ([("xml", "</worldbody>", "")], "arm.xml cannot be read as MJCF"),
    "no MJCF": ([("xml", "<mujoco>", "<robot>")], "arm.xml cannot be read as MJCF"),
    "mesh": (
        [("xml", "<worldbody>", '<asset><mesh name="m" file="m.stl"/></asset><worldbody>')],
        "m.stl is missing",
    ),
    "material": ([("xml", 'name="foot"', 'name="foot" material="paint"')], "an unknown material 'paint'"),
    "joints": ([("toml", "joints = ['turn'", "# ")], "[arm] joints is missing"),
    "misspelt": ([("toml", "'turn'", "'trun'")], "no joint 'trun'; it has turn"),
    "twice": ([("toml", "'turn', 'lift'", "'turn', 'turn'")], "must be a list of different names"),
    "order": ([("toml", "'turn', 'lift'", "'lift', 'turn'")], "list [arm] joints from base to wrist"),
    "unlisted": (
        [("xml", '<joint name="lift"', '<joint name="tilt" axis="1 0 0" range="-1 1"/><joint name="lift"')],
        "'tilt' moves the arm but is not in [arm] joints: list it",
    ),
    "sliding joint": ([("xml", 'name="turn"', 'type="slide" name="turn"')], "'turn' must be a hinge"),
    "ball joint": (
        [("xml", 'name="turn" axis="0 0 1" range="-3 3"', 'name="turn" type="ball"')],
        "'turn' must be",
    ),
    "home count": ([("toml", "home = [0.0, ", "home = [")], "home has 3 entries, expected 4"),
    "home range": ([("xml", "-2.5 2.5", "-1 1")], "home 2 of joint 'bend' is outside its range -1..1 rad"),
    "home NaN": ([("toml", "home = [0.0", "home = [nan")], "home = [nan"),
    "speed": ([("toml", "velocity = [1", "velocity = [-1")], "a list of numbers of 0.02 to 50, in radians"),
    "jerk": ([("toml", "jerk =", "jerks =")], "jerk is missing"),
    "base": ([("toml", "[gripper]", "base = [0, 0]\n[gripper]")], "base has 2 entries"),
    "far": ([("toml", "[gripper]", "base = [99, 0, 0]\n[gripper]")], "of at most 10 in magnitude"),
    "unknown key": ([("toml", "[gripper]", "speed = 1\n[gripper]")], "speed is unknown"),
    "actuators": ([("toml", HEAD, f'actuators = ["a", "b", "c", "d"]\n{HEAD}')], "no actuator 'a'"),
    "torque": ([("toml", HEAD, f"torque = [1, 1, 0, 1]\n{HEAD}")], "torque"),
    "body": ([("toml", HEAD, f'body = "link0"\n{HEAD}')], "no body 'link0' ([arm] body); it has base"),
    "two arms": (
        [("xml", "<worldbody>", '<worldbody><body name="b"><joint name="other"/><geom size=".1"/></body>')],
        'keep the arm alone with [arm] body = "base"',
    ),
    "hand file": ([("toml", HEAD, f'[hand]\nmjcf = "h.xml"\nmount = "wrist"\n{HEAD}')], "h.xml: no such"),
    "mount": ([("toml", HEAD, f'[hand]\nmjcf = "arm.xml"\nmount = "x"\n{HEAD}')], "no site or body 'x'"),
    "finger": ([("toml", '["left", "right"]', '["thumb", "right"]')], "no joint 'thumb'"),
    "no finger": ([("toml", '["left", "right"]', '["lift", "right"]')], "finger joint 'lift' is not below"),
    "finger range": ([("xml", 'range="0 .04"', 'limited="false"')], "finger joint 'left' needs a range"),
    "force": ([("toml", "force = 30", "force = -3")], "force = -3 must be above 0"),
    "weak": ([driven(100), ("toml", HEAD, NAMED)], "too little to hold a can"),
    "command": ([driven(2000), ("toml", HEAD, NAMED.replace("0.04", "0.4"))], "is outside the actuator"),
    "no motion": ([driven(2000), ("toml", HEAD, NAMED.replace("0.04", "0.0"))], "are the same command"),
    "width": ([("toml", "force = 30", "max_width = 0.12")], "the pads open to 0.0820 m: leave it out"),
    "ghost": ([("xml", PAD, PAD.replace('group="3"', 'contype="0" conaffinity="0"'))] * 2, "no collision"),
    "tool": ([("toml", "force = 30", 'tcp = "tip"')], "no site 'tip'; it has none with a name"),
    "camera": (
        [("toml", HEAD, f'[camera]\nsite = {{ body = "x", position = [0, 0, 0] }}\n{HEAD}')],
        "no body 'x', on which the file places a site",
    ),
    "folder": ([("toml", '"arm.xml"', '"."')], "no such MJCF file"),
    "number as name": ([("toml", '"arm.xml"', "7")], "mjcf = 7 must be a name in quotes"),
    "empty table": ([("toml", HEAD, 'joints2 = ["a"]\n[gripper]')], "[gripper] joints is missing"),
    "three fingers": ([("toml", '"right"]', '"right", "roll"]')], "[gripper] joints has 3 entries"),
    "arm joint as finger": ([("toml", '["left"', '["roll"')], "finger joint 'roll' is not below"),
    "degrees": ([("toml", "-0.5, 2.0", "-30, 115")], "home -30 of joint 'lift' is outside its range"),
    "text as number": ([("toml", "force = 30", 'force = "30 N"')], "force = '30 N' must be a finite number"),
    "little force": ([("toml", "force = 30", "force = 5")], "the fingers press with 5.0 N"),
    "hand turned by nothing": (
        [("toml", HEAD, f'[hand]\nmjcf = "arm.xml"\nmount = "wrist"\nquaternion = [0, 0, 0, 0]\n{HEAD}')],
        "[hand] quaternion must not be zero",
    ),
    "tool turned by nothing": (
        [("toml", "force = 30", 'tcp = { body = "wrist", position = [0, 0, 0], quaternion = [0, 0, 0, 0] }')],
        "[gripper.tcp] quaternion must not be zero",
    ),
    "site key": (
        [("toml", HEAD, f'[camera]\nsite = {{ body = "wrist", position = [0, 0, 0], turn = 1 }}\n{HEAD}')],
        "[camera.site] turn is unknown",
    ),
    "texture": (
        [("xml", "<worldbody>", '<asset><texture type="2d" name="t" file="t.png"/></asset><worldbody>')],
        "texture file",
    ),
    "include": ([("xml", "<worldbody>", '<include file="parts.xml"/><worldbody>')], "cannot be read as MJCF"),
    "not finite": ([("xml", 'pos=".3 0 0"', 'pos="nan 0 0"')], "must be finite numbers"),
    "entities": (
        [("xml", "<mujoco>", '<!DOCTYPE m [<!ENTITY a "aa">]><mujoco model="&a;">')],
        "declares the XML entity 'a'",
    ),
    "free base": (
        [("xml", '<body name="base">', '<body name="base"><freejoint/>')],
        "but is not in [arm] joints",
    ),
    "held joint": (
        [("xml", "</mujoco>", '<equality><joint joint1="lift" joint2="turn"/></equality></mujoco>')],
        "holds the arm: remove it",
    ),
    "held hand": (
        [("xml", "</mujoco>", '<equality><weld name="w" body1="wrist"/></equality></mujoco>')],
        "the equality constraint w holds the arm",
    ),
    "camera of the cell": (
        [("toml", HEAD, f'[camera]\nsite = {{ body = "base", position = [0, 0, 1] }}\n{HEAD}')],
        "does not move with the hand",
    ),
    "palm": ([("toml", "force = 30", "palm = 3.0")], "palm = 3 m, but"),
    "closed hand": ([("toml", "force = 30", "min_width = 0.09")], "must be above the closed hand's"),
    "tool sideways": (
        [("toml", "force = 30", 'tcp = { body = "wrist", position = [0.1, 0, 0] }')],
        "tcp must have z out of the hand",
    ),
    "tool on the base": (
        [("toml", "force = 30", 'tcp = { body = "base", position = [0, 0, 0] }')],
        "is not on the hand",
    ),
    "fast": ([("toml", "velocity = [1", "velocity = [900")], "a list of numbers of 0.02 to 50, in radians"),
    "lens": ([("toml", HEAD, f"[camera]\nfovy = 200\n{HEAD}")], "fovy = 200 must be"),
    "pinhole": ([("toml", HEAD, f"[camera]\nfovy = 1\n{HEAD}")], "fovy = 1 must be of 10 to 120"),
    "hairline": ([("toml", "force = 30", "max_width = 0.011")], "open to 0.011 m, too little for any object"),
    "soft servo": (servos('kp="{}" kv="1"', 0.5), "too soft: raise its kp"),
    "swinging servo": (servos('kp="{}"', 800), "is not damped: give it kv"),
    "weak servo": (servos('kp="{}" kv="80" forcerange="-.2 .2"', 800), "has 0.2 Nm, but its acceleration"),
}  # fmt: skip

# Replacements of the files of an arm whose hand has one moving jaw.
FIXED = '<geom group="3" type="box" size=".05 .005 .008" pos=".06 -.005 0"/>'
PALM = '<geom name="palm" group="3" type="box" size=".02 .06 .03"/>'
JAW = {
    "jaw's range": ([("xml", 'range="0 1.5"', 'range="0 .02"')], "the jaw opens from 0.0 to"),
    "jaw without end": (
        [("xml", 'axis="0 0 1" range="0 1.5"', 'axis="0 0 1"')],
        "finger joint 'jaw' needs a range",
    ),
    "jaw alone": (
        [("xml", FIXED, ""), ("xml", PALM, PALM.replace('group="3"', 'contype="0" conaffinity="0"'))],
        "nothing of the hand is opposite to it",
    ),
    "jaw beside nothing": (
        [("xml", FIXED, FIXED.replace("-.005 0", "-.005 .2"))],
        "the jaw opens from",
    ),
    "jaw's tool": (
        [("toml", "force = 30", 'tcp = { body = "wrist", position = [0.1, 0, 0] }')],
        "lies on the fixed one of two jaws: leave it out",
    ),
    "jaw as an arm's joint": ([("toml", "'roll']", "'roll', 'jaw']")], "home has 4 entries, expected 5"),
    "weak jaw": ([("toml", "force = 30", "force = 4")], "the fingers press with"),
}  # fmt: skip

# Replacements of the six-axis arm's file: all parts are there, but no task can succeed.
SOUND = {
    "home": ([("toml", "home = [-0.4029, -0.3817,", "home = [-0.4029, 0.9,")], "home: "),
    "reach": ([("toml", "[arm]", "[arm]\nbase = [0, 0, 2.5]")], "reach: the hand cannot point down"),
    "camera": (
        [("toml", 'site = "camera"', 'site = { body = "hand", position = [0, 0, -0.1] }')],
        "camera: the arm covers",
    ),
}  # fmt: skip


def complaints(path, capsys):
    """Return the lines of standard error of a run that must end with exit code 2."""
    assert run_cli(["scan", "--robot", str(path)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines and lines[0].startswith("nodeslam: ") and all(line.startswith("  ") for line in lines[1:]), (
        lines
    )
    return lines


def replaced(folder, changes, names):
    for kind, old, new in changes:
        path = folder / names[kind]
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(("changes", "message"), SMALL.values(), ids=SMALL)
def test_faults_of_files_and_models(write, capsys, monkeypatch, changes, message):
    monkeypatch.delenv("NO_ARMS", raising=False)
    path = write(SLIDING)
    replaced(path.parent, changes, {"toml": "robot.toml", "xml": "arm.xml"})
    assert any(message in line for line in complaints(path, capsys))


@pytest.mark.parametrize(("changes", "message"), JAW.values(), ids=JAW)
def test_faults_of_hands_with_one_jaw(write, capsys, changes, message):
    path = write(one_jaw())
    joints = ("toml", 'joints = ["left", "right"]', 'joints = ["jaw"]')
    replaced(path.parent, [joints, *changes], {"toml": "robot.toml", "xml": "arm.xml"})
    assert any(message in line for line in complaints(path, capsys))


@pytest.mark.parametrize(("changes", "message"), SOUND.values(), ids=SOUND)
def test_arms_with_which_every_task_fails(tmp_path, capsys, changes, message):
    shutil.copytree(SIXAXIS, tmp_path / "arm")
    replaced(tmp_path / "arm", changes, {"toml": "robot.toml"})
    assert any(message in line for line in complaints(tmp_path / "arm" / "robot.toml", capsys))


def test_files_that_are_none(tmp_path, capsys):
    (tmp_path / "binary.toml").write_bytes(bytes(range(256)))
    for path in (tmp_path, tmp_path / "binary.toml", tmp_path / "none.toml", "arm"):
        assert len(complaints(path, capsys)) == 1


def test_all_problems_of_a_file_are_told_at_once(write, capsys):
    path = write(SLIDING, gripper="force = -3", arm="base = [0, 0]\nspeed = 1")
    path.write_text(path.read_text().replace("'turn'", "'twist'"))
    assert len(complaints(path, capsys)) == 4


def test_there_are_more_than_seventy():
    assert len(SMALL) + len(JAW) + len(SOUND) >= 70
