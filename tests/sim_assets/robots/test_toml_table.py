"""Reading of tables: values, defaults, and all problems at once."""

import numpy as np
import pytest

from sim_assets.robots.toml_table import TomlTable


def table(**entries):
    return TomlTable("arm", entries, [])


def test_good_entries_are_returned_without_problems():
    t = table(name="x", names=["a", "b"], number=2, numbers=[1, 2.5], positive=[1.0])
    assert (t.text("name"), t.names("names", (2,)), t.number("number")) == ("x", ("a", "b"), 2.0)
    np.testing.assert_array_equal(t.numbers("numbers", 2), [1, 2.5])
    np.testing.assert_array_equal(t.positive_numbers("positive", 1), [1])
    t.refuse_others()
    assert not t.problems


def test_defaults_stand_for_missing_entries():
    t = table()
    assert t.text("name", "") == "" and t.number("n", 3.0) == 3 and t.names("names", optional=True) == ()
    np.testing.assert_array_equal(t.numbers("v", 2, (1, 2)), [1, 2])
    assert not t.problems


def test_every_problem_is_collected():
    t = table(name=3, names=["a", "a"], few=["a"], number=True, vector=[1, "x"], width=-1, typo=1)
    t.text("name"), t.names("names"), t.names("few", (2, 3)), t.number("number"), t.numbers("vector", 2)
    t.positive("width"), t.text("absent"), t.refuse_others()
    assert t.problems == [
        "[arm] name = 3 must be a name in quotes",
        "[arm] names = ['a', 'a'] must be a list of different names",
        "[arm] few has 1 entries, expected 2 or 3",
        "[arm] number = True must be a finite number of at most 1e+06 in magnitude",
        "[arm] vector = [1, 'x'] must be a list of 2 finite numbers of at most 1e+06 in magnitude",
        "[arm] width = -1 must be above 0",
        "[arm] absent is missing",
        "[arm] typo is unknown; known are absent, few, name, names, number, vector, width",
    ]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "1"])
def test_numbers_are_finite(value):
    t = table(n=value)
    t.number("n")
    assert "must be a finite number" in t.problems[0]


def test_paths_expand_variables_and_name_those_that_are_not_set(tmp_path, monkeypatch):
    monkeypatch.setenv("ARMS", str(tmp_path))
    monkeypatch.delenv("NO_ARMS", raising=False)
    t = table(mjcf="${ARMS}/arm.xml", hand="${NO_ARMS}/hand.xml", near="arm.xml")
    assert t.path("mjcf", tmp_path / "x") == tmp_path / "arm.xml"
    assert t.path("near", tmp_path / "x") == tmp_path / "x" / "arm.xml"
    t.path("hand", tmp_path)
    assert t.problems == ["[arm] hand: set the environment variable NO_ARMS"]


def test_sites_by_name_or_by_body_and_pose():
    t = table(tcp="tip", eye={"body": "hand", "position": [0, 0, 1], "quaternion": [2, 0, 0, 0]})
    assert t.site("tcp", "new") == ("tip", None)
    name, pose = t.site("eye", "new")
    assert (name, pose.name, pose.body) == ("new", "new", "hand")
    np.testing.assert_array_equal(pose.frame.quaternion, [1, 0, 0, 0])
    assert not t.problems
    t = table(eye={"body": "hand", "position": [0, 0, 1], "quaternion": [0, 0, 0, 0]})
    t.site("eye", "new")
    assert t.problems == ["[arm.eye] quaternion must not be zero"]


def test_a_table_that_is_none():
    t = table(hand=3)
    t.table("hand"), t.table("camera"), t.table("more", optional=True)
    assert t.problems == ["[hand] must be a table", "[arm] camera is missing"]
