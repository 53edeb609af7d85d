"""Load of the web viewer: many clients watch a live cell, one after the other and at once.

    python -m tests.viewer_load --out runs/load [--clients 1000] [--at-once 200] [--seconds 600]

The cell packs two objects with one seed, again and again. After some runs without clients, another process
keeps ``at-once`` clients connected and lets ``clients`` further ones come and go, for as long as asked. Every
run must have the result of the first one, and when the clients have left, the resident memory must be within
10 % of what it was before they came. A line for each run is appended to ``load.jsonl``.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hashlib
import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import msgspec.msgpack
import viser
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

from tests.soak import state

RUNS_ALONE = 6  # without clients, before and after
LARGEST_GROWTH = 0.1  # of the resident memory
MESSAGES, LONGEST_VISIT = 20, 2.0  # that a visitor reads before it leaves, and the time for them [s]
# The first message of a page: the viewer takes a client for connected when it has come.
CAMERA = msgspec.msgpack.encode({
    "type": "ViewerCameraMessage", "position": [1, 0, 1], "wxyz": [1, 0, 0, 0], "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1], "fov": 1.0, "near": 0.1, "far": 9.0, "image_height": 480, "image_width": 640,
})  # fmt: skip
Line = dict[str, Any]


@dataclass
class Clients:
    """Clients of a viewer, in a process of their own.

    Attributes:
        port: Port of the viewer.
        at_once: Number of clients that stay.
        visitors: Number of clients that come and go.
        seconds: Time for which they do [s].
        counts: What has happened, by name.
    """

    port: int
    at_once: int
    visitors: int
    seconds: float
    counts: Counter[str]

    async def run(self) -> None:
        """Connect all clients, and disconnect them when the time is over."""
        end = time.monotonic() + self.seconds
        async with asyncio.TaskGroup() as group:
            for _ in range(self.at_once):
                group.create_task(self._stay(end))
            for number in range(self.visitors):
                await asyncio.sleep(max(self._begin(number, end) - time.monotonic(), 0))
                await self._visit()

    def _begin(self, number: int, end: float) -> float:
        return end - self.seconds * (1 - number / self.visitors)

    async def _stay(self, end: float) -> None:
        """Read messages until the end, and connect again if the connection is lost."""
        while time.monotonic() < end:
            async with self._connection("stayed") as connection:
                while time.monotonic() < end:
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(connection.recv(), 1.0)

    async def _visit(self) -> None:
        async with self._connection("visited") as connection:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LONGEST_VISIT):
                    for _ in range(MESSAGES):
                        await connection.recv()

    @contextlib.asynccontextmanager
    async def _connection(self, name: str) -> AsyncIterator[ClientConnection]:
        url, protocol = f"ws://127.0.0.1:{self.port}", Subprotocol(f"viser-v{viser.__version__}")
        try:
            async with connect(url, subprotocols=[protocol], max_size=None, open_timeout=60) as connection:
                await connection.send(CAMERA)
                yield connection
                self.counts[name] += 1
        except (OSError, WebSocketException, TimeoutError) as error:
            self.counts[f"{name}: {type(error).__name__}"] += 1


class Cell:
    """A viewer, and a cell that is run again and again in it."""

    def __init__(self, out: Path) -> None:
        from app.viewer.server import open_server
        from app.viewer.viewer import Viewer
        from perception.pipeline import load_perception

        self._out, self._viewer = out, Viewer(open_server(port=0), live=True)
        self._perception = load_perception("auto")
        self._viewer.player.set_yielding(True)
        self._viewer.start()
        self.port = self._viewer.server.get_port()
        self.lines: list[Line] = []

    def run(self, clients: bool) -> None:
        """Run the episode once; write its result and the state of the process into the ledger."""
        from app.memory import release_freed_memory
        from app.options import PackOptions
        from app.screen import Screen
        from app.task.cell import build_world
        from app.task.recording import CellRecorder
        from app.task.run import run_and_store
        from app.task.run_control import RunControl
        from app.task.run_writer import RunSession

        begin = time.perf_counter()
        options = PackOptions(objects="2", scan_views=2, seed=1, quiet=True, out=self._out / "run")
        with build_world(options, "pack") as world:
            recording = CellRecorder(world)
            self._viewer.show(recording.recorder, live=True)
            session = RunSession(world, recording, RunControl(), Screen(quiet=True))
            report = run_and_store(options, self._perception, session).as_json()
        del report["timings"]
        result = json.dumps(report).encode() + (self._out / "run" / "replay.npz").read_bytes()
        connected = len(self._viewer.server.get_clients())
        release_freed_memory()
        line = {"clients": clients, "connected": connected, "seconds": time.perf_counter() - begin}
        line |= {"result": hashlib.sha256(result).hexdigest(), **state(self._out / "tmp")}
        self.lines.append(line)
        with (self._out / "load.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")

    def close(self) -> None:
        self._viewer.close()


def problems(lines: list[Line]) -> list[str]:
    """Return what is wrong: runs with another result, and memory that was not given back."""
    found = [f"run {number} has another result" for number, line in enumerate(lines)
             if line["result"] != lines[0]["result"]]  # fmt: skip
    first = next(number for number, line in enumerate(lines) if line["clients"])
    before = median(line["resident"] for line in lines[first - RUNS_ALONE // 2 : first])
    after = median(line["resident"] for line in lines[-(RUNS_ALONE // 2) :])
    sys.stdout.write(
        f"resident memory {before / 1e6:.0f} MB before the clients, {after / 1e6:.0f} MB after\n"
    )
    if after > before * (1 + LARGEST_GROWTH):
        found.append(f"memory grew by {after / before - 1:.1%}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--clients", type=int, default=1000)
    parser.add_argument("--at-once", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)  # the process of the clients
    options = parser.parse_args()
    if options.port is not None:
        clients = Clients(options.port, options.at_once, options.clients, options.seconds, Counter())
        asyncio.run(clients.run())
        sys.stdout.write(json.dumps(dict(clients.counts)))
        return
    options.out.mkdir(parents=True, exist_ok=True)
    cell = Cell(options.out)
    for _ in range(RUNS_ALONE):
        cell.run(clients=False)
    command = [sys.executable, "-m", "tests.viewer_load", *sys.argv[1:], "--port", str(cell.port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            cell.run(clients=True)
        counts = process.stdout.read() if process.stdout else ""
    for _ in range(RUNS_ALONE):
        cell.run(clients=False)
    cell.close()
    wrong = problems(cell.lines)
    watched = [line["connected"] for line in cell.lines if line["clients"]]
    sys.stdout.write(f"{len(cell.lines)} runs, {max(watched)} clients at most; {counts}\n" + "\n".join(wrong))
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
