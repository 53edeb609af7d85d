import asyncio
import contextlib
import threading

import msgspec.msgpack
import pytest
import viser
import websockets.asyncio.client

from app.viewer.load import load_run
from app.viewer.server import open_server
from app.viewer.viewer import Viewer


@pytest.fixture
def viewer(run_folder):
    viewer = Viewer(open_server(port=0), load_run(run_folder).recorder)
    viewer.set_title("Pack <b>", "1 of 1")
    viewer.start()
    yield viewer
    viewer.close()


def test_a_replay_loads_plays_and_scrubs_in_the_browser(viewer, open_page, until):
    page = open_page(viewer.server.url)
    page.page.get_by_text("Pack <b>").wait_for()  # escaped
    page.page.get_by_text("Reconstruct", exact=True).first.wait_for()
    until(lambda: viewer.player.time > 0)  # the first client starts it
    viewer.player.speed = 0.1
    viewer.player.seek(0.0)
    viewer.player.play()
    page.page.get_by_role("button", name="Pause").click()
    until(lambda: not viewer.player.playing)
    viewer.player.speed = 4.0
    page.page.get_by_role("button", name="Execute", exact=True).click()
    execute = next(span.begin for span in viewer.player.timeline.stages if span.name == "execute")
    until(lambda: viewer.player.time == pytest.approx(execute))
    page.page.get_by_text("Executing the pick-and-place plan").wait_for()
    slider = page.page.get_by_role("slider").first
    until(lambda: float(slider.get_attribute("aria-valuenow") or 0) == pytest.approx(execute, abs=0.2))
    slider.focus()

    def stepped():
        slider.press("ArrowRight")
        return viewer.player.time > execute

    until(stepped)
    page.page.get_by_role("button", name="Play").click()
    until(lambda: viewer.player.time >= viewer.player.timeline.end)
    page.page.get_by_role("tab", name="Objects").click()
    page.page.get_by_text("placed", exact=True).wait_for()
    assert page.problems == []


async def _watch(viewer, received, end, vanish):
    """Receive messages as a headless client and count them; disconnect abruptly if ``vanish``."""
    url = f"ws://127.0.0.1:{viewer.server.get_port()}"
    protocol = f"viser-v{viser.__version__}"
    connection = await websockets.asyncio.client.connect(url, subprotocols=[protocol], max_size=None)
    camera = {"position": [1, 0, 1], "wxyz": [1, 0, 0, 0], "look_at": [0, 0, 0], "up_direction": [0, 0, 1]}
    lens = {"fov": 1.0, "near": 0.1, "far": 9.0, "image_height": 10, "image_width": 10}
    await connection.send(msgspec.msgpack.encode({"type": "ViewerCameraMessage"} | camera | lens))
    while not end.is_set():
        with contextlib.suppress(TimeoutError):
            received.append(len(await asyncio.wait_for(connection.recv(), 0.1)))
    if vanish:
        connection.transport.abort()
    else:
        await connection.close()


def test_three_viewers_at_once_one_of_them_killed(viewer, until):
    counts, ends = [[], [], []], [threading.Event() for _ in range(3)]
    threads = [
        threading.Thread(target=lambda i=i: asyncio.run(_watch(viewer, counts[i], ends[i], vanish=i == 1)))
        for i in range(3)
    ]
    for thread in threads:
        thread.start()
    try:
        until(lambda: len(viewer.server.get_clients()) == 3)
        viewer.player.speed = 0.1
        ends[1].set()
        until(lambda: len(viewer.server.get_clients()) == 2)
        before = [len(count) for count in counts]
        until(lambda: all(len(counts[i]) > before[i] + 5 for i in (0, 2)))  # the others still receive it
    finally:
        for end in ends:
            end.set()
    for thread in threads:
        thread.join()
    until(lambda: not viewer.server.get_clients())
    viewer.player.speed = 8.0
    until(lambda: viewer.player.time == viewer.player.timeline.end)
