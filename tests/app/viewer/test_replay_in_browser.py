import time

import pytest

from app.viewer.load import load_run
from app.viewer.server import open_server
from app.viewer.viewer import Viewer


@pytest.fixture
def viewer(run_folder):
    shown = load_run(run_folder)
    viewer = Viewer(open_server(port=0), shown.recorder)
    viewer.title("Pack <b>", "1 of 1")
    viewer.start()
    yield viewer
    viewer.close()


def until(condition, seconds=20):
    """Wait for something to become true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.05)


def test_a_replay_loads_plays_and_scrubs_in_the_browser(viewer, open_page):
    page = open_page(viewer.server.url)
    page.page.get_by_text("Pack <b>").wait_for()  # escaped
    page.page.get_by_text("Reconstruct", exact=True).first.wait_for()
    until(lambda: viewer.player.time > 0.5)
    page.page.get_by_role("button", name="Pause").click()
    until(lambda: not viewer.player.playing)
    page.page.get_by_role("button", name="Act", exact=True).click()
    act = next(span.begin for span in viewer.player.story.stages if span.name == "execute")
    until(lambda: viewer.player.time == pytest.approx(act))
    page.page.get_by_text("The arm carries one object after another").wait_for()
    page.page.get_by_role("button", name="Play").click()
    until(lambda: viewer.player.time >= viewer.player.story.end)
    page.page.get_by_role("tab", name="Objects").click()
    page.page.get_by_text("put down").wait_for()
    assert page.problems == []
