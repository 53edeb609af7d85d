"""One job at a time, in a thread or at once, with the same result."""

import threading

import pytest

from perception.slam.joint_worker import DelayedJob


@pytest.mark.parametrize("concurrent", [True, False])
def test_the_result_is_taken_once(concurrent):
    job: DelayedJob[int] = DelayedJob(concurrent)
    assert job.due is None
    for value in (3, 4):
        job.start(lambda value=value: 2 * value, due=10)
        assert job.due == 10
        assert job.take() == 2 * value and job.due is None


def test_concurrent_jobs_run_in_another_thread():
    names = {}
    for concurrent in (True, False):
        job: DelayedJob[str] = DelayedJob(concurrent)
        job.start(lambda: threading.current_thread().name, due=0)
        names[concurrent] = job.take()
    assert names[True].startswith("joint") and names[False] == threading.current_thread().name


def test_errors_are_raised_when_the_result_is_taken():
    def fail():
        raise ValueError("singular")

    job: DelayedJob[None] = DelayedJob()
    job.start(fail, due=1)
    with pytest.raises(ValueError, match="singular"):
        job.take()
    assert job.due is None
