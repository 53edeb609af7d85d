"""Signals at every moment of a process end in one line and the conventional exit code."""

import signal
import subprocess
import sys
import time

import pytest

AT_WORK = """
import signal, time
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also where the tests run under nohup
from app import interrupts
interrupts.install()
interrupts.raise_if(lambda: {at_stake})
try:
    print("ready", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    interrupts.ignore()
    print("kept", flush=True)
    time.sleep(0.3)
    raise SystemExit(interrupts.exit_code() if interrupts.was_interrupted() else 1)
"""
CODES = [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]


@pytest.fixture(autouse=True)
def heeded_interrupts():
    """A shell starts background processes with SIGINT ignored, which their children inherit."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def signalled(code, number, times=1):
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for _ in range(times):
        process.send_signal(number)
        time.sleep(0.1)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


@pytest.mark.parametrize("number, code", CODES)
def test_results_at_stake_are_kept(number, code):
    assert signalled(AT_WORK.format(at_stake=True), number) == (code, "kept\n", "")


@pytest.mark.parametrize("number, code", CODES)
def test_with_nothing_at_stake_the_process_ends_at_once(number, code):
    assert signalled(AT_WORK.format(at_stake=False), number) == (code, "", "nodeslam: interrupted\n")


def test_a_second_signal_does_not_interrupt_the_end():
    assert signalled(AT_WORK.format(at_stake=True), signal.SIGINT, times=2) == (130, "kept\n", "")


@pytest.mark.parametrize("delay", [0.1, 0.2, 0.4])
def test_an_interrupt_during_the_imports_is_one_line(delay, tmp_path):
    command = [sys.executable, "-c", "from app.__main__ import main; print('ready', flush=True); main()"]
    command += ["reconstruct", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    time.sleep(delay)
    if process.poll() is not None:
        pytest.skip("on this machine the imports take less time")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "nodeslam: interrupted\n")


def test_a_signal_that_the_parent_ignores_stays_ignored():
    code = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n" + AT_WORK.format(at_stake=False)
    code = code.replace("time.sleep(60)", "time.sleep(0.5)")
    assert signalled(code, signal.SIGINT) == (0, "", "")


def test_a_signal_in_a_finaliser_is_not_lost():
    finaliser = """
import os, signal
class Interrupted:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):  # the handler raises here
            pass
"""
    code = finaliser + AT_WORK.format(at_stake=True).replace(
        'print("ready", flush=True)', 'print("ready", flush=True); Interrupted()'
    )
    assert signalled(code, signal.SIGTERM, times=0) == (143, "kept\n", "")


def test_other_exceptions_in_finalisers_are_reported():
    finaliser = """
class Broken:
    def __del__(self):
        raise ValueError("broken")
"""
    code = finaliser + AT_WORK.format(at_stake=True).replace("time.sleep(60)", "Broken()")
    code, out, err = signalled(code, signal.SIGTERM, times=0)
    assert (code, out) == (0, "") and "ValueError: broken" in err
