"""Limits on MJCF files: counts, depth, memory, included files and assets, random damage."""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_assets.errors import RobotFileError
from sim_assets.robots import mjcf_limits
from sim_assets.robots.mjcf_limits import check_mjcf
from tests.fuzzing import SHORT, damaged_bytes

ARM = '<mujoco><asset><mesh file="a.stl"/></asset><worldbody><geom size=".1"/>{}</worldbody></mujoco>'


def written(tmp_path, content, name="arm.xml"):
    (tmp_path / name).write_text(content)
    return tmp_path / name


def test_a_usual_model_passes(tmp_path):
    (tmp_path / "part.xml").write_text("<mujocoinclude><body><geom/></body></mujocoinclude>")
    check_mjcf(written(tmp_path, ARM.format('<include file="part.xml"/>')))


REFUSED = {
    "more than 2000 geoms": "<geom/>" * 2001,
    "the arm has more than 2000 geoms": '<replicate count="1500"><geom/><geom/></replicate>',
    "count = 30 30 30 must be at most 2000": '<composite count="30 30 30"/>',
    "nested more than 100 deep": "<body>" * 5000 + "</body>" * 5000,
    "width = 100000 of <texture> must be at most 8192": '<texture width="100000"/>',
    "nuser_geom = 1000000000 of <size> must be at most 1000": '<size nuser_geom="1000000000"/>',
    "pos = nan 0 0 of <body> must be finite": '<body pos="nan 0 0"/>',
    "size = x of <geom> must be finite": '<geom size="x"/>',
    "forcerange = nan nan of <motor> must be two ascending": '<motor forcerange="nan nan"/>',
    "range = 2 -2 of <joint> must be two ascending": '<joint range="2 -2"/>',
    "mismatched tag": "<body>",
}


@pytest.mark.parametrize("message", REFUSED)
def test_excess_is_named(tmp_path, message):
    with pytest.raises(RobotFileError, match=message) as caught:
        check_mjcf(written(tmp_path, ARM.format(REFUSED[message])))
    assert "arm.xml" in str(caught.value)


def test_entities_are_refused(tmp_path):
    path = written(tmp_path, '<!DOCTYPE a [<!ENTITY lol "lol">]>' + ARM.format(""))
    with pytest.raises(RobotFileError, match="declares the XML entity 'lol'"):
        check_mjcf(path)


@pytest.mark.parametrize("place", ["a.stl", "meshes/a.stl", "part.xml"])
def test_pipes_in_place_of_files_are_refused(tmp_path, place):
    (tmp_path / "meshes").mkdir()
    os.mkfifo(tmp_path / place)
    path = written(tmp_path, ARM.format('<compiler meshdir="meshes"/><include file="part.xml"/>'))
    with pytest.raises(RobotFileError, match="is a named pipe, not a regular file"):
        check_mjcf(path)


def test_files_that_include_each_other_are_walked_once(tmp_path):
    written(tmp_path, '<mujocoinclude><include file="arm.xml"/></mujocoinclude>', "part.xml")
    check_mjcf(written(tmp_path, ARM.format('<include file="part.xml"/>')))  # MuJoCo refuses the cycle


def test_sizes_of_files_are_bounded(tmp_path, monkeypatch):
    path = written(tmp_path, ARM.format(""))
    (tmp_path / "a.stl").write_bytes(bytes(200))
    monkeypatch.setattr(mjcf_limits, "MAX_ASSET_BYTES", 100)
    with pytest.raises(RobotFileError, match=r"a\.stl is too large \(200 bytes"):
        check_mjcf(path)
    monkeypatch.setattr(mjcf_limits, "MAX_XML_BYTES", 10)
    with pytest.raises(RobotFileError, match=r"arm\.xml is too large"):
        check_mjcf(path)


@pytest.mark.parametrize("name", ["x" * 300 + ".stl", "../../../../etc/passwd"])
def test_names_of_any_length_and_place(tmp_path, name):
    path = written(tmp_path, ARM.format("").replace("a.stl", name))
    if len(name) < 255:
        check_mjcf(path)  # a regular file, which MuJoCo then refuses as a mesh
    else:
        with pytest.raises(RobotFileError, match="File name too long"):
            check_mjcf(path)


@SHORT
@given(data=st.data())
def test_random_damage_passes_or_is_refused(tmp_path, data):
    path = tmp_path / "arm.xml"
    path.write_bytes(data.draw(damaged_bytes(ARM.format('<size nuser_geom="1"/>').encode())))
    try:
        check_mjcf(path)
    except RobotFileError as error:
        assert "\n" not in str(error)
