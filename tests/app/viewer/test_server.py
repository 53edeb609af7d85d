"""The server with its guard, by requests of browsers and scripts."""

import asyncio
import contextlib
import socket
import time
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import msgspec.msgpack
import numpy as np
import pytest
import viser
import websockets.asyncio.client
from websockets.exceptions import ConnectionClosed, InvalidStatus

from app.errors import UsageError
from app.viewer.messages import INVALID_VALUE, check_message
from app.viewer.server import LOOPBACK, ViewerServer, _ThreadSafeEvent, open_server
from app.viewer.timeline import Timeline
from app.viewer.viewer import Viewer

PROTOCOL = f"viser-v{viser.__version__}"


def run_apart(conversation):
    """Run a coroutine in a thread of its own: the event loop of a browser test may run in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, conversation).result()


@pytest.fixture(scope="module")
def server():
    server = open_server(port=0)
    yield server
    server.stop()


def fetch(server, host):
    request = urllib.request.Request(f"http://127.0.0.1:{server.get_port()}/", headers={"Host": host})
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.status


def connect(server, origin=None, protocol=PROTOCOL, **options):
    return websockets.asyncio.client.connect(
        f"ws://127.0.0.1:{server.get_port()}", origin=origin, subprotocols=[protocol], **options
    )


def talk(server, messages, origin=None, protocol=PROTOCOL):
    """Send messages on one connection; return True if it is still open afterwards."""

    async def conversation():
        async with connect(server, origin, protocol, max_size=None) as connection:
            for message in messages:
                await connection.send(message)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.5):
                    while True:
                        await connection.recv()
            await connection.ping()
            return True

    return run_apart(conversation())


def test_it_listens_on_the_loopback_interface_only(server):
    assert server.get_host() == LOOPBACK == "127.0.0.1"
    addresses = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in addresses - {"127.0.0.1"}:
        if not address.startswith("127."):
            with pytest.raises(OSError):
                socket.create_connection((address, server.get_port()), timeout=2)


def test_requests_with_another_host_name_are_refused(server):
    port = server.get_port()
    assert fetch(server, f"localhost:{port}") == fetch(server, f"127.0.0.1:{port}") == 200
    with pytest.raises(urllib.error.HTTPError, match="403") as refused:
        fetch(server, "evil.example")
    refused.value.close()


def test_pages_of_other_origins_are_refused(server):
    port = server.get_port()
    assert talk(server, [], origin=None)  # a local program
    run_apart(_open_and_close(server, f"http://127.0.0.1:{port}"))
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{port + 1}", f"http://localhost:{port}"):
        with pytest.raises(InvalidStatus, match="403"):
            run_apart(_open_and_close(server, origin))
    with pytest.raises(InvalidStatus, match="403"):
        talk(server, [], protocol="viser-v0.0.1")


async def _open_and_close(server, origin):
    async with connect(server, origin):
        pass


def test_public_tunnels_are_refused(server, monkeypatch):
    asked = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *args: asked.append(args))
    assert talk(server, [msgspec.msgpack.encode({"type": "ShareUrlRequest"})])
    time.sleep(0.2)
    assert server.request_share_url() is None and asked == []


@pytest.mark.parametrize("port", [-1, 65536])
def test_an_invalid_port_is_reported_with_the_valid_range(port):
    with pytest.raises(UsageError, match=f"--port {port} must be between 0 and 65535; 0 selects a free port"):
        open_server(port=port)


def test_the_address_names_the_host():
    address = SimpleNamespace(get_port=lambda: 8123)
    for host, name in (("0.0.0.0", "localhost"), ("127.0.0.1", "localhost"), ("192.0.2.7", "192.0.2.7")):
        address.get_host = lambda host=host: host
        assert ViewerServer.url.fget(address) == f"http://{name}:8123"


def test_a_busy_port_is_reported_and_the_default_is_the_next_free_one(server, monkeypatch):
    port = server.get_port()
    with pytest.raises(UsageError, match=f"--port {port}: address already in use; give another"):
        open_server(port=port)
    monkeypatch.setattr("app.viewer.server.DEFAULT_PORT", port)
    other = open_server()
    assert port < other.get_port() < port + 20
    other.stop()
    with pytest.raises(UsageError, match=r"--host no\.such\.host is not an address of this machine"):
        open_server("no.such.host")
    with pytest.raises(UsageError, match=r"--host 192\.0\.2\.1 is not an address of this machine"):
        open_server("192.0.2.1")  # for documentation only, RFC 5737


def encoded(**message):
    return msgspec.msgpack.encode(message)


CAMERA = {"position": [0, 0, 1], "wxyz": [1, 0, 0, 0], "look_at": [0, 0, 0], "up_direction": [0, 0, 1.0]}
LENS = {"fov": 1.0, "near": 0.1, "far": 9.0, "image_height": 10, "image_width": 10}
WHOLE_CAMERA = encoded(type="ViewerCameraMessage", **CAMERA, **LENS)  # the first message of a page


def test_controls_accept_valid_values_only(server):
    gui = server.gui
    button, number = gui.add_button("Stop"), gui.add_number("Seed", 3, min=0, max=9, step=1)
    box, menu = gui.add_checkbox("Names", True), gui.add_dropdown("Speed", ("1x", "2x"))
    pressed = []
    button.on_click(lambda _: pressed.append(1))
    handles = {handle._impl.uuid: handle for handle in (button, number, box, menu)}

    def kind(handle, value):
        message = encoded(type="GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})
        return check_message(message, handles.get)

    for handle, good, bad in (
        (button, [True], ["nonsense", 1, ""]),
        (number, [0, 9, 4.0], ["7", True, -5, 2**40]),
        (box, [False, True], ["", 0]),
        (menu, ["1x", "2x"], ["3x", 0, True]),
    ):
        assert {kind(handle, value) for value in good} == {"GuiUpdateMessage"}
        assert {kind(handle, value) for value in bad} == {INVALID_VALUE}
    wrong = [("nonsense", button), (-1e300, number), ("", box), ("3x", menu)]
    wrong = [encoded(type="GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})
             for value, handle in wrong]  # fmt: skip
    assert talk(server, [WHOLE_CAMERA, *wrong])
    assert not pressed and (number.value, box.value, menu.value) == (3, True, "1x")
    press = encoded(type="GuiUpdateMessage", uuid=button._impl.uuid, updates={"value": True})
    assert talk(server, [WHOLE_CAMERA, press])
    end = time.monotonic() + 10
    while not pressed:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_thousand_malformed_messages_change_nothing(recording):
    viewer = Viewer(open_server(port=0), recording)
    viewer.start()
    rng = np.random.default_rng(0)
    uuids = list(viewer.server.gui._gui_input_handle_from_uuid)
    wrong = [
        encoded(type="GuiUpdateMessage", uuid=uuid, updates={"value": value})
        for value in ("nonsense", -1e300, 2**40, "")
        for uuid in uuids
    ]
    noise = [rng.bytes(int(rng.integers(0, 200))) for _ in range(1000 - len(wrong))]
    try:
        run_apart(_send(viewer.server, wrong))
        for batch in range(0, len(noise), 50):
            with contextlib.suppress(ConnectionClosed):
                run_apart(_send(viewer.server, noise[batch : batch + 50]))
        timeline = Timeline(recording)
        assert timeline.end == viewer.player.timeline.end and timeline.stages == viewer.player.timeline.stages
        assert viewer.player._thread.is_alive()
        assert talk(viewer.server, [WHOLE_CAMERA])
    finally:
        viewer.close()


async def _send(server, messages):
    async with connect(server, max_size=None) as connection:
        for message in messages:
            await connection.send(message)


def test_any_thread_may_set_the_event_of_many_waiting_clients():
    async def conversation():
        loop = asyncio.get_running_loop()
        event, woken = _ThreadSafeEvent(loop), 0

        async def client():
            nonlocal woken
            for _ in range(50):
                await event.wait()
                event.clear()
                woken += 1

        clients = [loop.create_task(client()) for _ in range(100)]

        def send():
            while any(not client.done() for client in clients):
                event.set()  # asyncio's own: "deque mutated during iteration"

        await asyncio.wait_for(asyncio.gather(loop.run_in_executor(None, send), *clients), timeout=30)
        return woken

    assert run_apart(conversation()) == 5000


def test_an_event_may_be_set_after_its_loop_has_ended():
    loop = asyncio.new_event_loop()
    event = _ThreadSafeEvent(loop)
    loop.close()
    event.set()
    assert not event.is_set()


def test_messages_of_the_server_and_of_clients_come_from_any_thread(server):
    events = []

    async def conversation():
        async with connect(server, max_size=None) as connection:
            await connection.send(WHOLE_CAMERA)
            end = time.monotonic() + 10
            while not (clients := server.get_clients()) and time.monotonic() < end:
                await asyncio.sleep(0.01)
            (client,) = clients.values()
            events.append(client._websock_connection.get_message_buffer().message_event)

    run_apart(conversation())
    events.append(server._websock_server.get_message_buffer().message_event)
    assert [type(event) for event in events] == 2 * [_ThreadSafeEvent]
