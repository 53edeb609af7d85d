"""Watching changes nothing, and costs little."""

import asyncio
import json
import logging
import threading
import time

import numpy as np
import pytest
import viser
import websockets.asyncio.client
import websockets.exceptions

from app.options import PackOptions
from app.perceive import load_perception
from app.screen import Screen
from app.task.cell import build_world
from app.task.command import run_in
from app.task.gate import Gate
from app.task.recording import CellRecorder
from app.viewer.server import open_server
from app.viewer.viewer import Viewer


def episode(folder, watched):
    """One episode; wall time, CPU time of this process [s]."""
    options = PackOptions(objects="mug=1,can=1", seed=1, out=folder)
    with build_world(options, "pack") as world:
        recording, perception = CellRecorder(world), load_perception("cpu")
        viewer = Viewer(open_server(port=0), recording.recorder, live=True) if watched else None
        ended = threading.Event()
        if viewer is not None:
            viewer.player.yielding = True
            viewer.start()
            threading.Thread(target=lambda: asyncio.run(_watch(viewer, ended)), daemon=True).start()
        begin, begin_cpu = time.perf_counter(), time.process_time()
        run_in(world, options, perception, recording, Screen(quiet=True), Gate())
        times = time.perf_counter() - begin, time.process_time() - begin_cpu
        ended.set()
        if viewer is not None:
            viewer.close()
    return times


async def _watch(viewer, ended):
    url, protocol = f"ws://127.0.0.1:{viewer.server.get_port()}", f"viser-v{viser.__version__}"
    async with websockets.asyncio.client.connect(url, subprotocols=[protocol], max_size=None) as connection:
        while not ended.is_set():
            try:
                await asyncio.wait_for(connection.recv(), 0.5)
            except TimeoutError:
                continue
            except websockets.exceptions.ConnectionClosed:
                break


def outcome(folder):
    """Everything that came out but times."""
    report = json.loads((folder / "report.json").read_text())
    del report["timings"]
    with np.load(folder / "replay.npz") as arrays:
        moved = {name: arrays[name] for name in ("time", "joint_positions", "gripper_width", "body_poses")}
    return report, json.loads((folder / "objects.json").read_text()), moved


@pytest.mark.slow
def test_watching_changes_nothing_and_costs_little(tmp_path):
    watched = episode(tmp_path / "watched", watched=True)  # first: what is loaded once counts against it
    alone = episode(tmp_path / "alone", watched=False)
    shares = watched[0] / alone[0], watched[1] / alone[1]
    logging.getLogger(__name__).info("wall and CPU time, watched : alone = %.2f, %.2f", *shares)
    report, objects, moved = outcome(tmp_path / "watched")
    report_alone, objects_alone, moved_alone = outcome(tmp_path / "alone")
    assert report == report_alone and objects == objects_alone
    for name, values in moved.items():
        np.testing.assert_array_equal(values, moved_alone[name])
    assert shares[1] < 1.3  # CPU time: what else this machine does does not count
