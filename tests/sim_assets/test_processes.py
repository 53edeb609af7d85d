"""Child processes end with their parent."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from sim_assets.processes import probe

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux kills children with their parent")


def test_a_probe_reports_how_its_program_ended():
    ended = probe("print(2); raise SystemExit(3)", 10)
    assert (ended.returncode, ended.stdout) == (3, "2\n")
    assert probe("import os; os.abort()", 10).returncode < 0
    with pytest.raises(subprocess.TimeoutExpired):
        probe("import time; time.sleep(60)", 0.1)


def test_a_probe_is_killed_with_the_process_that_started_it(tmp_path):
    note = tmp_path / "child"
    child = f"import os, time; open({str(note)!r}, 'w').write(f'{{os.getpid()}} '); time.sleep(60)"
    code = f"from sim_assets.processes import probe; probe({child!r}, 60)"
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        wait_until(lambda: note.exists() and note.read_text().endswith(" "))
        process.kill()
    wait_until(lambda: not is_running(int(note.read_text())))


@pytest.mark.parametrize("parent", ["os.getppid()", "1"])  # 1: it ended before the child asked
def test_a_process_is_killed_with_the_one_that_started_it(parent):
    child = f"import os, time; from sim_assets.processes import kill_with; kill_with({parent}); "
    child += "print(os.getpid(), flush=True); time.sleep(60)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        process.kill()
    assert bool(line) == (parent != "1")
    wait_until(lambda: not line or not is_running(int(line)))


def wait_until(condition):
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def is_running(process: int) -> bool:
    """Return whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
