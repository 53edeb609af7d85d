"""Watching changes nothing, and costs little."""

import asyncio
import contextlib
import json
import logging
import threading
import time

import msgspec.msgpack
import numpy as np
import pytest
import viser
import websockets.asyncio.client
import websockets.exceptions

from app.options import PackOptions
from app.screen import Screen
from app.task.cell import build_world
from app.task.recording import CellRecorder
from app.task.run import run_and_store
from app.task.run_control import RunControl
from app.task.run_writer import RunSession
from app.viewer.live import RunButtons
from app.viewer.server import open_server
from app.viewer.viewer import Viewer
from perception.pipeline import load_perception

CAMERA = {
    "type": "ViewerCameraMessage", "position": [1, 0, 1], "wxyz": [1, 0, 0, 0], "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1], "fov": 1.0, "near": 0.1, "far": 9.0, "image_height": 10, "image_width": 10,
}  # fmt: skip


def episode(folder, watchers=()):
    """One episode with viewers and buttons; wall time, CPU time of this process [s].

    Args:
        watchers: coroutine functions of a viewer and an event that says that the episode is over.
    """
    options = PackOptions(objects="mug=1,can=1", seed=1, out=folder)
    with build_world(options, "pack") as world:
        recording, perception = CellRecorder(world), load_perception("cpu")
        viewer, control, ended = None, RunControl(), threading.Event()
        if watchers:
            viewer = Viewer(open_server(port=0), recording.recorder, live=True)
            RunButtons(viewer.server.gui, lambda: control).update(running=True)
            viewer.player.set_yielding(True)
            viewer.start()
        threads = [threading.Thread(target=lambda w=w: asyncio.run(w(viewer, ended))) for w in watchers]
        for thread in threads:
            thread.start()
        begin, begin_cpu = time.perf_counter(), time.process_time()
        run_and_store(options, perception, RunSession(world, recording, control, Screen(quiet=True)))
        times = time.perf_counter() - begin, time.process_time() - begin_cpu
        ended.set()
        for thread in threads:
            thread.join()
        if viewer is not None:
            viewer.close()
    return times


def connect(viewer):
    url, protocol = f"ws://127.0.0.1:{viewer.server.get_port()}", f"viser-v{viser.__version__}"
    return websockets.asyncio.client.connect(url, subprotocols=[protocol], max_size=None)


async def watch(viewer, ended, leaves=None):
    """Look until the episode is over, or until ``leaves`` says so; then vanish without a goodbye."""
    async with connect(viewer) as connection:
        while not ended.is_set():
            if leaves is not None and leaves():
                connection.transport.abort()
                break
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(connection.recv(), 0.5)


async def be_killed(viewer, ended):
    """A viewer that is killed while the arm moves."""
    stages = lambda: [span.name for span in viewer.player.timeline.stages]  # noqa: E731
    await watch(viewer, ended, leaves=lambda: "execute" in stages())


async def babble(viewer, ended):
    """A thousand messages that make no sense: noise, and nonsense for every control, Stop among them."""
    rng = np.random.default_rng(0)
    sent = 0
    while sent < 1000:
        with contextlib.suppress(websockets.exceptions.ConnectionClosed):
            async with connect(viewer) as connection:
                await connection.send(msgspec.msgpack.encode(CAMERA))  # from then on controls listen
                for uuid in list(viewer.server.gui._gui_input_handle_from_uuid):
                    for value in ("nonsense", -1e300, 2**40):
                        message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
                        await connection.send(msgspec.msgpack.encode(message))
                        sent += 1
                for _ in range(20):
                    await connection.send(rng.bytes(int(rng.integers(0, 200))))
                    sent += 1
                    await asyncio.sleep(0.02)


def outcome(folder):
    """Everything that came out but times."""
    report = json.loads((folder / "report.json").read_text())
    del report["timings"]
    with np.load(folder / "replay.npz") as arrays:
        moved = {name: arrays[name] for name in ("time", "joint_positions", "gripper_width", "body_poses")}
    return report, json.loads((folder / "objects.json").read_text()), moved


def assert_same(folder, other):
    report, objects, moved = outcome(folder)
    report_other, objects_other, moved_other = outcome(other)
    assert report == report_other and objects == objects_other
    for name, values in moved.items():
        np.testing.assert_array_equal(values, moved_other[name])


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Folder and times of the episode that nobody watches."""
    folder = tmp_path_factory.mktemp("alone") / "run"
    episode(folder.with_name("first"))  # what is loaded and compiled once counts for nobody
    return folder, episode(folder)


@pytest.mark.slow
def test_watching_changes_nothing_and_costs_little(alone, tmp_path):
    folder, times = alone
    watched = episode(tmp_path / "watched", [watch])
    shares = watched[0] / times[0], watched[1] / times[1]
    logging.getLogger(__name__).warning("wall and CPU time, watched : alone = %.2f, %.2f", *shares)
    assert_same(tmp_path / "watched", folder)
    assert shares[1] < 1.3  # CPU time: what else this machine does does not count


@pytest.mark.slow
def test_three_viewers_one_killed_and_one_that_babbles_change_nothing(alone, tmp_path):
    episode(tmp_path / "watched", [watch, be_killed, babble])
    assert_same(tmp_path / "watched", alone[0])
