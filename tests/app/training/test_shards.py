"""Shards: written by this process, from workers and a cluster alike; resumed; lost workers."""

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from app.jobs import Workers
from app.training import shards as shards_module
from app.training.shards import write_shards
from perception.errors import PerceptionError

MODULE = """
import os, signal
from dataclasses import dataclass
from pathlib import Path

@dataclass(frozen=True)
class Piece:
    folder: Path
    number: int

    @property
    def files(self):
        return self.folder / f"{self.number}.a", self.folder / f"{self.number}.b"

def contents(piece):
    if piece.number == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    return str(piece.number).encode(), bytes(piece.number)
"""


@dataclass(frozen=True)
class Piece:
    folder: Path
    number: int

    @property
    def files(self) -> tuple[Path, ...]:
        return self.folder / f"{self.number}.a", self.folder / f"{self.number}.b"


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module with shards that other processes can import."""
    (tmp_path / "shards_of_workers.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "shards_of_workers", raising=False)
    import shards_of_workers  # pyright: ignore[reportMissingImports]

    return shards_of_workers


def test_missing_shards_are_written_with_progress(tmp_path):
    pieces = [Piece(tmp_path / "new", number) for number in range(3)]
    pieces[0].folder.mkdir()
    for file in pieces[1].files:
        file.write_bytes(b"finished before")
    pieces[2].files[0].write_bytes(b"its second file is missing")
    steps, asked = [], []

    def contents(piece):
        asked.append(piece.number)
        return b"first", b"second"

    write_shards(pieces, contents, Workers(), "making", lambda *step: steps.append(step))
    assert asked == [0, 2] and steps == [("making", 2 / 3), ("making", 1.0)]
    assert [file.read_bytes() for file in pieces[2].files] == [b"first", b"second"]
    assert pieces[1].files[0].read_bytes() == b"finished before"


def test_workers_return_contents_and_a_lost_one_is_an_error(tmp_path, module):
    folder = tmp_path / "data"
    write_shards([module.Piece(folder, n) for n in (1, 2, 3)], module.contents, Workers(2), "making")
    assert [(folder / f"{n}.a").read_text() for n in (1, 2, 3)] == ["1", "2", "3"]
    assert (folder / "3.b").read_bytes() == bytes(3)
    pieces = [module.Piece(folder, 7)]
    expected = (
        r"making: shard 7 crashed: its worker process died 2 times \(SIGKILL, then SIGKILL\).*; the same"
    )
    with pytest.raises(PerceptionError, match=expected):
        write_shards(pieces, module.contents, Workers(2), "making")
    assert len(list(folder.iterdir())) == 6


def test_the_jobs_run_where_they_are_asked_for(tmp_path, monkeypatch):
    used = []

    def run(jobs, workers):
        used.append((jobs.items, workers))
        yield from map(jobs.work, jobs.items)

    monkeypatch.setattr(shards_module, "run_jobs", run)
    workers = Workers(3, ray="auto")
    write_shards([Piece(tmp_path, 5)], lambda piece: (b"", b"x"), workers, "making")
    assert used == [([Piece(tmp_path, 5)], workers)] and (tmp_path / "5.b").read_bytes() == b"x"
