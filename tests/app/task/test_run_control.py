import threading
import time

import pytest

from app.task.run_control import RunControl, RunStopped


def test_a_run_pauses_steps_resumes_and_stops():
    control, passed = RunControl(), []

    def run():
        try:
            for sample in range(1000):
                control.enter_step() if sample % 10 == 0 else control.wait_if_paused()
                passed.append(sample)
                time.sleep(0.001)
        except RunStopped:
            passed.append("stopped")

    control.pause()
    thread = threading.Thread(target=run)
    thread.start()
    time.sleep(0.05)
    assert passed == [] and control.paused
    control.step()
    wait_until(lambda: (control.paused and len(passed) == 0) or len(passed) == 10)
    control.step()
    wait_until(lambda: len(passed) % 10 == 0 and len(passed) > 0 and control.paused)
    control.resume()
    wait_until(lambda: len(passed) > 30)
    control.stop()
    thread.join(5)
    assert passed[-1] == "stopped" and control.paused_seconds > 0.04


def test_a_free_run_does_not_wait():
    control = RunControl()
    control.enter_step()
    control.wait_if_paused()
    assert not control.paused and control.paused_seconds == 0.0


def test_resume_cancels_a_step():
    control = RunControl()
    control.step()
    control.resume()
    control.enter_step()
    assert not control.paused


def test_stop_ends_a_paused_run():
    control = RunControl()
    control.pause()
    control.stop()
    with pytest.raises(RunStopped):
        control.wait_if_paused()


def wait_until(condition):
    end = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)
