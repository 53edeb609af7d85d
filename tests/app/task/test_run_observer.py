"""The observer measures the stages."""

import pytest

from app.task.run_observer import RunObserver


def test_timings_exclude_pauses():
    class Paused(RunObserver):
        seconds = 0.0

        @property
        def paused_seconds(self):
            return self.seconds

    observer = Paused()
    observer.seconds = 50.0
    with pytest.raises(KeyError), observer.stage("scan"):
        observer.seconds += 100.0
        raise KeyError
    assert -100.0 < observer.timings["scan"] < -99.0  # measured time less the claimed pause
