import subprocess
import sys

import pytest

import app.__main__ as main


def test_the_exit_code_is_that_of_the_command(monkeypatch):
    received = []
    monkeypatch.setattr(main, "run", lambda arguments: received.append(arguments) or 2)
    monkeypatch.setattr("app.interrupts.install", lambda: None)
    monkeypatch.setattr(sys, "argv", ["nodeslam", "pack", "--seed", "3"])
    with pytest.raises(SystemExit) as end:
        main.main()
    assert end.value.code == 2 and received == [["pack", "--seed", "3"]]


def test_thread_pools_are_limited_before_numpy_is_imported():
    code = (
        "import os, sys; os.environ.pop('OPENBLAS_NUM_THREADS', None); import app.__main__; "
        "print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "1", done.stderr
