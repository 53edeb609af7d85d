"""A stage without progress ends with its name, also inside native code."""

import signal
import subprocess
import sys
import threading
import time

import pytest

from app.errors import StalledError
from app.screen import Screen
from app.watchdog import STALLED_EXIT_CODE, Watchdog

# A blocked signal is like native code: no Python code runs on the main thread when it arrives.
NATIVE = """
import signal, time
from app.watchdog import Watchdog
with Watchdog("Planning", 0.1, grace=0.2):
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
    time.sleep(60)
"""


def test_a_stage_without_progress_is_ended_by_name():
    message = r"Planning: no progress for 0\.5 s: give it smaller input, or a larger --stage-limit"
    with pytest.raises(StalledError, match=message), Watchdog("Planning", 0.5):
        time.sleep(5)


def test_progress_restarts_the_time():
    with Watchdog("Planning", 1.0) as watchdog:
        for _ in range(6):
            time.sleep(0.2)
            watchdog.progress()


def test_a_stage_of_the_screen_is_watched_whether_it_is_shown_or_not():
    for quiet in (True, False):
        with pytest.raises(StalledError, match="Scanning"), Screen(quiet, stage_limit=0.5).stage("Scanning"):
            time.sleep(5)


def test_a_second_stall_is_noticed_as_well():
    with Watchdog("Evaluating", 0.5) as watchdog:
        for _ in range(2):
            with pytest.raises(StalledError):
                time.sleep(5)
            watchdog.progress()


def test_nothing_is_left_behind():
    before = signal.getsignal(signal.SIGALRM)
    with Watchdog("Planning", 100):
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 0
    assert signal.getsignal(signal.SIGALRM) == before and signal.getitimer(signal.ITIMER_REAL)[0] == 0
    with Watchdog("Planning", 0):
        assert signal.getitimer(signal.ITIMER_REAL)[0] == 0


def test_other_threads_are_not_watched():
    errors = []

    def work():
        try:
            with Watchdog("Serving", 0.01) as watchdog:
                time.sleep(0.1)
                watchdog.progress()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not errors


def test_a_stage_that_ignores_the_alarm_ends_the_process():
    ended = subprocess.run([sys.executable, "-c", NATIVE], capture_output=True, text=True, timeout=60)
    assert ended.returncode == STALLED_EXIT_CODE
    assert ended.stderr.startswith("nodeslam: Planning: no progress for 0.1 s")
    assert len(ended.stderr.splitlines()) == 1
