"""Atomic writing and JSON reading."""

import json
import os
import socket
import stat
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.errors import InvalidInputError
from perception.io import files
from perception.io.files import (
    MAX_JSON_BYTES,
    parse_json,
    read_bytes,
    read_json,
    read_text,
    write_atomically,
    write_json,
)


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


@pytest.fixture
def special(tmp_path):
    """Paths that are not regular files: a reader would wait at the pipe for ever."""
    paths = {
        "a named pipe": tmp_path / "pipe",
        "a folder": tmp_path / "folder",
        "a device": Path("/dev/zero"),
    }
    os.mkfifo(paths["a named pipe"])
    paths["a folder"].mkdir()
    return paths | {"a device": Path("/dev/zero")}


@pytest.mark.parametrize("linked", [False, True])
@pytest.mark.parametrize("kind", ["a named pipe", "a folder", "a device"])
def test_what_is_not_a_regular_file_is_refused_at_once(tmp_path, special, kind, linked):
    path = special[kind]
    if linked:
        (tmp_path / "link.json").symlink_to(path)
        path = tmp_path / "link.json"
    with pytest.raises(InvalidInputError, match=rf"{path.name} is {kind}, not a regular file: copy it$"):
        read_json(path, "copy it")


def test_a_socket_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # addresses are short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
        with pytest.raises(InvalidInputError, match="is a socket, not a regular file"):
            read_bytes(tmp_path / "socket", 10)


def test_a_pipe_that_replaces_a_file_while_it_is_opened_is_refused(special, monkeypatch):
    monkeypatch.setattr(files, "check_regular", lambda *_: None)
    with pytest.raises(InvalidInputError, match="is a named pipe"):
        read_bytes(special["a named pipe"], 10)


def test_files_are_read_up_to_the_limit(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345"
    with pytest.raises(InvalidInputError, match=r"a\.bin is too large \(5 bytes; at most 4 are read\)$"):
        read_bytes(path, 4)
    with pytest.raises(InvalidInputError, match=r"too large \(more than 2 bytes; at most 2 are read\)"):
        read_bytes(Path("/proc/self/status"), 2)  # its size is given as 0


def test_large_json_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "a.json"
    with path.open("wb") as file:
        file.truncate(MAX_JSON_BYTES + 1)
    with pytest.raises(InvalidInputError, match=r"a\.json is too large .*: copy it$"):
        read_json(path, "copy it")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("9" * 5000, r"holds an integer of 5000 digits, at most 18 are supported"),
        ("-" + "9" * 400, r"holds an integer of 400 digits, at most 18 are supported"),
        ("9" * 19, r"holds an integer of 19 digits"),
        ("1e999", r"holds the number 1e999, which is too large"),
        ("-1." + "1" * 500 + "e400", r"holds the number -1\.1{27}, which is too large"),
        ("[" * 100_000, r"cannot be read \(nested too deeply\)"),
    ],
    ids=["5000 digits", "400 digits", "19 digits", "infinity", "minus infinity", "depth"],
)
def test_extreme_json_is_refused_in_one_line(tmp_path, text, problem):
    path = tmp_path / "a.json"
    path.write_text('{"a": ' + text + "}")
    with pytest.raises(InvalidInputError, match=rf"a\.json {problem}.*: copy it$") as caught:
        read_json(path, "copy it")
    assert len(str(caught.value).splitlines()) == 1


def test_integers_of_18_digits_are_exact(tmp_path):
    write_json(tmp_path / "a.json", [-(10**18 - 1), 0.1])
    assert read_json(tmp_path / "a.json", "") == [-(10**18 - 1), 0.1]


@given(
    content=st.binary(max_size=60) | st.text(alphabet='{}[]":,0123456789eE.-nulltrueNaIfity ').map(str.encode)
)
def test_any_content_is_read_or_refused(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("json") / "a.json"
    path.write_bytes(content)
    try:
        read_json(path, "copy it")
    except InvalidInputError as error:
        assert str(error).endswith(": copy it") and len(str(error).splitlines()) == 1


def test_what_is_no_regular_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name in ("pipe", "link"):
        with pytest.raises(InvalidInputError, match="is a named pipe, not a regular file"):
            write_atomically(tmp_path / name, "text")
    assert (tmp_path / "pipe").is_fifo() and len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("text", ['"\\ud800"', '{"\\uDFff": 1}', '["\\ud83d \\ude00"]'])
def test_halves_of_surrogate_pairs_are_no_text(text):
    with pytest.raises(ValueError, match="half of a surrogate pair"):
        parse_json(text.encode())


def test_surrogate_pairs_are_text():
    assert parse_json(b'"\\ud83d\\ude00"') == "\U0001f600"


def test_names_that_are_no_unicode_can_be_written(tmp_path):
    write_json(tmp_path / "a.json", {"scan": "/\udcff", "\U0001f600": 1})
    assert read_json(tmp_path / "a.json", "") == {"scan": "/?", "\U0001f600": 1}


def test_a_byte_order_mark_is_skipped(tmp_path):
    (tmp_path / "a.json").write_text('{"a": 1}', encoding="utf-8-sig")
    assert read_json(tmp_path / "a.json", "") == {"a": 1}
    assert read_text(tmp_path / "a.json") == '{"a": 1}'


@pytest.mark.parametrize("text", ['{"a": 1, "b": 2, "a": 1}', '[{"x": {"a": 1, "a": 2}}]'])
def test_a_name_occurs_once_in_an_object(text):
    with pytest.raises(ValueError, match="holds the name 'a' twice in one object"):
        parse_json(text.encode())


def test_nan_is_no_number_unless_it_is_expected():
    with pytest.raises(ValueError, match="holds -Infinity, which is no number in JSON"):
        parse_json(b"[1, -Infinity]")
    assert parse_json(b"[-Infinity]", nan_allowed=True) == [float("-inf")]
