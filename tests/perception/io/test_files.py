"""Atomic writing and JSON reading."""

import json
import os
import stat

import pytest

from perception.errors import InvalidInputError
from perception.io.files import read_json, write_atomically, write_json


def test_text_and_bytes_replace_the_old_file(tmp_path):
    path = tmp_path / "new" / "a.txt"
    write_atomically(path, "first")
    write_atomically(path, b"second")
    assert path.read_bytes() == b"second" and os.listdir(path.parent) == ["a.txt"]


def test_a_failed_write_leaves_the_old_file_and_no_temporary_one(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    write_atomically(path, "old")

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, "new")
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_permissions_follow_the_umask(tmp_path):
    old = os.umask(0o027)
    try:
        write_atomically(tmp_path / "a.txt", "")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o640


def test_json_round_trip_refuses_what_json_cannot_represent(tmp_path):
    write_json(tmp_path / "a.json", {"x": [1, 2.5, None]})
    assert read_json(tmp_path / "a.json", "") == {"x": [1, 2.5, None]}
    assert (tmp_path / "a.json").read_text().endswith("}\n")
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", float("nan"))
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": [1, 2.5, None]}


def test_messages_name_file_problem_and_remedy(tmp_path):
    path = tmp_path / "a.json"
    with pytest.raises(InvalidInputError, match=r"a\.json is missing: copy it$"):
        read_json(path, "copy it")
    path.write_text('{"a": 1,\n  b}')
    with pytest.raises(
        InvalidInputError, match=r"a\.json is not valid JSON .* at line 2 column 3\): copy it$"
    ):
        read_json(path, "copy it")
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(InvalidInputError, match=r"a\.json cannot be read .*: copy it$"):
        read_json(path, "copy it")
