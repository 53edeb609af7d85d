import sys
import threading

import pytest

from app.viewer.player import (
    HAND_OVER,
    HEAD_START,
    LAG,
    SHARE_OF_RUN,
    SHARE_OF_TIME,
    USUAL_HAND_OVER,
    Player,
    affordable,
)
from app.viewer.timeline import Story


@pytest.fixture
def player(recording):
    return Player(Story(recording), lambda: None)


def test_time_passes_at_its_speed_and_ends_with_the_story(player):
    player.advance(0.5)
    assert player.time == pytest.approx(0.5)
    player.speed = 4.0
    player.advance(0.5)
    assert player.time == pytest.approx(2.5)
    player.advance(1000)
    assert player.time == player.story.end and not player.playing
    player.play()
    assert player.time == 0.0 and player.playing  # from the beginning again


def test_pausing_and_seeking(player):
    player.pause()
    player.advance(1.0)
    assert player.time == 0.0
    player.seek(3.0)
    assert player.time == 3.0
    player.seek(1e300)
    assert player.time == player.story.end
    player.seek(-5)
    assert player.time == 0.0


def test_following_catches_up_and_waits_for_more(recording):
    player = Player(Story(recording), lambda: None, live=True)
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


def test_a_picture_that_fails_does_not_end_the_view(recording, caplog):
    drawn = threading.Event()
    attempts = []

    def draw():
        attempts.append(0)
        if len(attempts) > 3:
            drawn.set()
        raise ValueError("no such colour")

    player = Player(Story(recording), draw)
    player.start()
    assert drawn.wait(5)
    player.close()
    assert [record.message for record in caplog.records] == ["the viewer could not draw"]  # said once


def test_drawing_leaves_a_run_its_processor_time():
    assert affordable(own=HEAD_START - 0.01, process=HEAD_START, wall=0.0), "a head start"
    assert not affordable(own=HEAD_START + 0.1, process=HEAD_START + 0.1, wall=1.0), "the run got nothing"
    busy = 100.0
    most = HEAD_START + SHARE_OF_RUN * busy + SHARE_OF_TIME * busy
    assert affordable(own=most - 0.1, process=busy + most - 0.1, wall=busy)
    assert not affordable(own=most + 0.1, process=busy + most + 0.1, wall=busy)


def test_a_player_that_cannot_afford_to_draw_waits(recording, monkeypatch):
    drawn, asked = [], threading.Event()

    def never(own, process, wall):
        asked.set()
        return False

    monkeypatch.setattr("app.viewer.player.affordable", never)
    player = Player(Story(recording), lambda: drawn.append(0), live=True)
    player.give_way(True)
    assert sys.getswitchinterval() == pytest.approx(HAND_OVER)
    player.start()
    assert asked.wait(5)
    player.close()
    assert not drawn and sys.getswitchinterval() == pytest.approx(USUAL_HAND_OVER)
