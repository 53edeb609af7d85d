"""Ledgers of results: appended lines, resumption, and damaged files."""

import json
import os

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.errors import UsageError
from app.evaluation.ledger import SETTINGS, Ledger, LedgerFormat
from app.options import EvaluateOptions
from perception.errors import InvalidInputError

FORMAT = LedgerFormat("evaluate-tasks", "rows.jsonl", "seed")


def opened(out, settings=None, format=FORMAT, **changes):
    options = EvaluateOptions(what="tasks", out=out, **changes)
    return Ledger.open(options, format, settings or {"task": "pack"})


def test_lines_are_read_back_by_key(tmp_path):
    ledger, finished = opened(tmp_path)
    assert finished == {}
    ledger.append({"seed": 4, "value": 0.5})
    ledger.append({"seed": 2, "value": 1.5})
    again, finished = opened(tmp_path, resume=True)
    assert finished == {4: {"seed": 4, "value": 0.5}, 2: {"seed": 2, "value": 1.5}}
    assert again.path == ledger.path and again.folder.path == tmp_path


@pytest.mark.parametrize(
    "damage",
    [
        b'{"seed": 2, "va',
        '{"seed": 2, "name": "Z\u00fc'.encode()[:-1],
        b'{"value": 1}\n',
        b"[1]\n",
        b'{"seed": [2]}\n',
        b'{"seed": true}\n',
        b'{"seed": 1, "value": "again"}\n',
        b'{"seed": 2, "value": ' + b"9" * 5000 + b"}\n",
        b"[" * 100_000 + b"\n",
        b"\x00\xff\n",
    ],
)
def test_damaged_lines_are_dropped_from_the_file_with_a_warning(tmp_path, caplog, damage):
    ledger, _ = opened(tmp_path)
    ledger.append({"seed": 1})
    with ledger.path.open("ab") as file:
        file.write(damage)
    assert ledger.read() == {1: {"seed": 1}}
    assert ledger.path.read_bytes() == b'{"seed": 1}\n'
    (record,) = caplog.records
    assert "rows.jsonl, line 2 is dropped and its job repeated" in record.message
    assert len(record.message.splitlines()) == 1


def test_lines_that_fail_the_check_are_dropped(tmp_path, caplog):
    ledger, _ = opened(tmp_path, format=LedgerFormat("e", "rows.jsonl", "seed", lambda line: line["value"]))
    ledger.append({"seed": 1})
    ledger.append({"seed": 2, "value": 3})
    assert list(ledger.read()) == [2]
    assert "line 1 is dropped and its job repeated (KeyError: 'value')" in caplog.text


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_damage_leaves_whole_lines_and_a_file_that_reads_the_same_again(tmp_path, data):
    ledger, _ = opened(tmp_path)
    for seed in range(3):
        ledger.append({"seed": seed, "name": "M\u00fcller"})
    content = bytearray(ledger.path.read_bytes())
    begin = data.draw(st.integers(0, len(content)))
    end = data.draw(st.integers(begin, len(content)))
    content[begin:end] = data.draw(st.binary(max_size=8))
    ledger.path.write_bytes(content)
    lines = ledger.read()
    kept = ledger.path.read_bytes()
    assert ledger.read() == lines and ledger.path.read_bytes() == kept
    assert [json.loads(line) for line in kept.splitlines()] == list(lines.values())


def test_an_intact_file_is_not_rewritten(tmp_path):
    ledger, _ = opened(tmp_path)
    ledger.append({"seed": 1})
    before = ledger.path.stat().st_ino
    ledger.read()
    assert ledger.path.stat().st_ino == before


def test_a_new_evaluation_removes_old_lines(tmp_path):
    ledger, _ = opened(tmp_path)
    ledger.append({"seed": 1})
    assert opened(tmp_path)[0].read() == {}
    stored = json.loads((tmp_path / SETTINGS).read_text())
    assert stored == {"task": "pack", "evaluation": "evaluate-tasks"}


def test_settings_must_agree_to_resume(tmp_path):
    opened(tmp_path, {"task": "pack", "box": "a"})
    with pytest.raises(UsageError, match="was made with another box, task"):
        opened(tmp_path, {"task": "sort", "box": "b"}, resume=True)
    opened(tmp_path, {"task": "pack", "box": "a", "robot": "panda"}, resume=True)  # the default of --robot
    with pytest.raises(UsageError, match="--resume needs --out"):
        opened(None, resume=True)


def test_another_kind_of_evaluation_is_not_resumed(tmp_path):
    opened(tmp_path)
    with pytest.raises(UsageError, match="belongs to evaluate-tasks, not to evaluate-slam"):
        opened(tmp_path, format=LedgerFormat("evaluate-slam", "rows.jsonl", "key"), resume=True)
    (tmp_path / SETTINGS).write_text("[]")
    with pytest.raises(UsageError, match=r"evaluation\.json does not hold the settings of an evaluation"):
        opened(tmp_path, resume=True)


def test_a_pipe_in_place_of_the_ledger_is_refused(tmp_path):
    ledger, _ = opened(tmp_path)
    os.mkfifo(ledger.path)
    with pytest.raises(InvalidInputError, match=r"rows\.jsonl is a named pipe"):
        ledger.read()
