import sys
import threading

import pytest

from app.viewer.player import (
    CPU_CREDIT,
    DEFAULT_SWITCH_INTERVAL,
    LAG,
    SHARE_OF_RUN,
    SHARE_OF_WALL,
    YIELDING_SWITCH_INTERVAL,
    Player,
    within_cpu_budget,
)
from app.viewer.timeline import Timeline


@pytest.fixture
def player(recording):
    return Player(Timeline(recording), lambda: None)


def test_time_advances_at_its_speed_and_stops_at_the_end(player):
    player.advance(0.5)
    assert player.time == pytest.approx(0.5)
    player.speed = 4.0
    player.advance(0.5)
    assert player.time == pytest.approx(2.5)
    player.advance(1000)
    assert player.time == player.timeline.end and not player.playing
    player.play()
    assert player.time == 0.0 and player.playing  # restarts


def test_pause_and_seek(player):
    player.pause()
    player.advance(1.0)
    assert player.time == 0.0
    player.seek(3.0)
    assert player.time == 3.0
    player.seek(1e300)
    assert player.time == player.timeline.end
    player.seek(-5)
    assert player.time == 0.0


def test_following_catches_up_with_a_growing_recording(recording):
    player = Player(Timeline(recording), lambda: None, live=True)
    for _ in range(200):
        player.advance(0.1)
    assert recording.now - player.time < 0.05 * LAG and player.playing
    recording.now += 2.0
    player.advance(0.1)
    assert recording.now - 2.0 < player.time < recording.now
    player.seek(1.0)
    assert not player.following
    player.follow()
    assert player.following and player.playing


def test_an_error_in_drawing_is_logged_once_and_does_not_stop_the_viewer(recording, caplog):
    drawn = threading.Event()
    attempts = []

    def draw():
        attempts.append(0)
        if len(attempts) > 3:
            drawn.set()
        raise ValueError("unknown colour")

    player = Player(Timeline(recording), draw)
    player.start()
    assert drawn.wait(5)
    player.close()
    assert [record.message for record in caplog.records] == ["the viewer could not draw"]


def test_drawing_stays_within_its_share_of_cpu_time():
    assert within_cpu_budget(drawing=CPU_CREDIT - 0.01, process=CPU_CREDIT, wall=0.0)
    assert not within_cpu_budget(drawing=CPU_CREDIT + 0.1, process=CPU_CREDIT + 0.1, wall=1.0)
    busy = 100.0
    most = CPU_CREDIT + SHARE_OF_RUN * busy + SHARE_OF_WALL * busy
    assert within_cpu_budget(drawing=most - 0.1, process=busy + most - 0.1, wall=busy)
    assert not within_cpu_budget(drawing=most + 0.1, process=busy + most + 0.1, wall=busy)


def test_a_yielding_player_draws_within_its_cpu_budget_only(recording, monkeypatch):
    drawn, asked = [], threading.Event()

    def never(drawing, process, wall):
        asked.set()
        return False

    monkeypatch.setattr("app.viewer.player.within_cpu_budget", never)
    player = Player(Timeline(recording), lambda: drawn.append(0), live=True)
    player.set_yielding(True)
    assert sys.getswitchinterval() == pytest.approx(YIELDING_SWITCH_INTERVAL)
    player.start()
    assert asked.wait(5)
    player.close()
    assert not drawn and sys.getswitchinterval() == pytest.approx(DEFAULT_SWITCH_INTERVAL)
