"""Decisions of the guard, by the headers of requests."""

import pytest
import viser
from websockets.datastructures import Headers
from websockets.http11 import Request

from app.viewer.guard import Guard

PROTOCOL = f"viser-v{viser.__version__}"
HERE = "127.0.0.1:8080"


def request(*headers, host=HERE):
    return Request("/", Headers([("Host", host), *headers]))


def websocket(*headers, host=HERE, protocol=PROTOCOL):
    return request(("Upgrade", "WebSocket"), ("Sec-WebSocket-Protocol", protocol), *headers, host=host)


@pytest.mark.parametrize(
    ("listening", "host", "answered"),
    [
        ("127.0.0.1", "localhost:8080", True),
        ("127.0.0.1", "[::1]:8080", True),
        ("127.0.0.1", "192.0.2.7:8080", False),
        ("192.0.2.7", "192.0.2.7:8080", True),
        ("Robot", "robot", True),
        ("127.0.0.1", "evil.example", False),
        ("127.0.0.1", "[bad", False),
        ("0.0.0.0", "any.example", True),
        ("::", "any.example", True),
    ],
)
def test_the_host_must_be_a_name_of_the_server_unless_it_listens_everywhere(listening, host, answered):
    refusal = Guard(listening).refusal(request(host=host))
    assert refusal == (None if answered else f"{host!r} is not a name of this server")


@pytest.mark.parametrize(
    ("origin", "answered"),
    [
        (f"http://{HERE}", True),
        ("http://127.0.0.1:8081", False),
        ("http://localhost:8080", False),
        ("http://evil.example", False),
        ("null", False),
        ("http://[bad", False),
    ],
)
def test_a_page_must_come_from_this_server(origin, answered):
    refusal = Guard("127.0.0.1").refusal(websocket(("Origin", origin)))
    assert refusal == (None if answered else f"pages of {origin!r} may not connect")
    assert Guard("0.0.0.0").refusal(websocket(("Origin", "http://evil.example"))) is not None
    assert Guard("127.0.0.1").refusal(request(("Origin", origin))) is None  # plain requests change nothing


def test_programs_without_an_origin_may_connect():
    assert Guard("127.0.0.1").refusal(websocket()) is None
    assert Guard("127.0.0.1").refusal(websocket(protocol=f"other, {PROTOCOL} ")) is None


def test_pages_of_another_version_must_be_reloaded():
    assert "reload it" in Guard("127.0.0.1").refusal(websocket(protocol="viser-v0.0.1"))
    assert "reload it" in Guard("127.0.0.1").refusal(request(("Upgrade", "websocket")))


def test_repeated_or_missing_headers_are_refused():
    guard, origin = Guard("127.0.0.1"), ("Origin", f"http://{HERE}")
    assert guard.refusal(websocket(("Host", HERE))) == "malformed headers"
    assert guard.refusal(websocket(origin, origin)) == "malformed headers"
    assert guard.refusal(Request("/", Headers())) == "malformed headers"
