"""One process at a time writes to a folder, and the lock of a dead process is taken over."""

import os
import signal
import subprocess
import sys

import pytest

from app.errors import UsageError
from app.runs.lock import LOCK_FILE, FolderLock

HOLD = "import sys, time; from pathlib import Path; from app.runs.lock import FolderLock\n" + (
    "lock = FolderLock(Path(sys.argv[1])); print('locked', flush=True); time.sleep(60)"
)


@pytest.fixture
def holder(tmp_path):
    """Return a process that holds the lock of ``tmp_path``."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"locked\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_folder_in_use_is_refused_with_the_process_that_uses_it(tmp_path, holder):
    with pytest.raises(
        UsageError, match=rf"is in use by another run \(process {holder.pid}, started 20\d\d-"
    ):
        FolderLock(tmp_path)


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path, holder):
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    assert (tmp_path / LOCK_FILE).exists()
    FolderLock(tmp_path).release()
    assert not (tmp_path / LOCK_FILE).exists()


def test_a_released_lock_can_be_taken_again(tmp_path):
    first = FolderLock(tmp_path)
    with pytest.raises(UsageError, match="in use"):
        FolderLock(tmp_path)
    first.release()
    second = FolderLock(tmp_path)
    first.release()  # no effect on the lock that is held now
    assert (tmp_path / LOCK_FILE).exists()
    second.release()


def test_an_empty_lock_file_is_no_lock(tmp_path):
    (tmp_path / LOCK_FILE).touch()
    FolderLock(tmp_path).release()


def test_a_link_in_place_of_the_lock_file_is_not_followed(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / LOCK_FILE).symlink_to(tmp_path / "mine.txt")
    with pytest.raises(OSError):
        FolderLock(tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "mine"
