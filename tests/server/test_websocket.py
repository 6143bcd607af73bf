"""The WebSocket door, spoken to frame by frame: what is refused and how, who may open one, and deadlines."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import msgpack
import pytest
from websockets.client import ClientProtocol
from websockets.extensions.permessage_deflate import ClientPerMessageDeflateFactory
from websockets.frames import Frame, Opcode
from websockets.http11 import Response
from websockets.uri import WebSocketURI, parse_uri

from protocol.client import BotClient
from protocol.codec import Format, body_limit
from protocol.transport import ReplyError
from tests.protocol.golden import TABLE, VECTORS
from tests.server.serving import Served, play, serve

HELLO = VECTORS["hello"].body
PAGE = "https://game.example"


class RawSocket:
    """A WebSocket frame by frame, and a socket below it."""

    def __init__(self, address: str, path: str = "/v1/socket", **handshake: object) -> None:
        parts = urlsplit(address)
        uri = WebSocketURI(False, str(parts.hostname), int(str(parts.port)), path, "")
        self.speaks = ClientProtocol(uri, **handshake)
        self.socket = socket.create_connection((uri.host, uri.port), timeout=10)
        self.frames: list[Frame] = []
        self.speaks.send_request(self.speaks.connect())
        self.flush()
        self.status = 0
        while not self.status:
            self.status = next((event.status_code for event in self._events() if isinstance(event, Response)), 0)

    def flush(self) -> None:
        self.socket.sendall(b"".join(self.speaks.data_to_send()))

    def frame(self) -> Frame:
        while not self.frames:
            self._events()
        return self.frames.pop(0)

    def ask(self, body: bytes) -> dict[str, object]:
        self.speaks.send_binary(body)
        self.flush()
        return self.reply()

    def reply(self) -> dict[str, object]:
        frame = self.frame()
        assert frame.opcode is Opcode.BINARY
        return dict(msgpack.unpackb(frame.data))

    def close_code(self) -> int:
        """What the server closes the socket with; 0 if it does so without a word."""
        with suppress(ConnectionResetError):
            while True:
                frame = self.frame()
                if frame.opcode is Opcode.CLOSE:
                    return int(struct.unpack(">H", bytes(frame.data[:2]))[0])
        return 0

    def _events(self) -> list[object]:
        data = self.socket.recv(65536)
        if not data:
            raise ConnectionResetError("closed")
        self.speaks.receive_data(data)
        events = self.speaks.events_received()
        self.frames += [event for event in events if isinstance(event, Frame)]
        return events


@contextmanager
def _open(served: Served, path: str = "/v1/socket", **handshake: object) -> Iterator[RawSocket]:
    raw = RawSocket(served.addresses["ws"], path, **handshake)
    with raw.socket:
        yield raw


@pytest.fixture(scope="module")
def hasty(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    deadlines = {"frame_deadline_s": 0.2, "idle_ttl_s": 30.0, "ws_origins": (PAGE,), "max_connections": 2}
    with serve(bundle, tmp_path_factory.mktemp("hasty") / "s", **deadlines) as running:
        yield running


def test_the_address_is_the_http_port_and_a_path(served: Served) -> None:
    assert served.addresses["ws"] == served.addresses["http"].replace("http:", "ws:") + "/v1/socket"
    with BotClient(served.addresses["http"].replace("http:", "ws:")) as client:
        client.hello()
        play(client, TABLE, client.start(1), range(2))


def test_a_socket_is_a_connection(served: Served) -> None:
    with _open(served) as raw:
        assert raw.ask(msgpack.packb({"type": "start_bots", "count": 1}))["code"] == "NO_CONNECTION"
        assert raw.ask(HELLO)["type"] == "welcome"
        assert raw.ask(HELLO)["code"] == "BAD_SCHEMA"
        assert raw.ask(b"\xc1")["code"] == "BAD_MSGPACK"
        (bot,) = raw.ask(msgpack.packb({"type": "start_bots", "count": 1}))["bots"]
        with _open(served) as other:
            other.ask(HELLO)
            assert other.ask(msgpack.packb({"type": "stop_bots", "bots": [bot]}))["code"] == "NO_BOT"
        assert raw.ask(msgpack.packb({"type": "goodbye"}))["type"] == "farewell"
        assert raw.close_code() == 1000


def test_messages_in_pieces_and_pings_between_them(served: Served) -> None:
    with _open(served) as raw:
        raw.speaks.send_binary(HELLO[:2], fin=False)
        raw.speaks.send_ping(b"here?")
        raw.speaks.send_continuation(HELLO[2:], fin=True)
        raw.flush()
        assert (raw.frame().opcode, raw.reply()["type"]) == (Opcode.PONG, "welcome")


def test_frames_cut_at_every_byte_boundary(served: Served) -> None:
    with _open(served) as raw:
        raw.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        raw.ask(HELLO)
        raw.speaks.send_binary(msgpack.packb({"type": "start_bots", "count": 1}))
        for byte in b"".join(raw.speaks.data_to_send()):
            raw.socket.sendall(bytes([byte]))
        assert raw.reply()["type"] == "bots_started"


def test_requests_sent_at_once_are_answered_in_order(served: Served) -> None:
    with _open(served) as raw:
        for body in (HELLO, *[msgpack.packb({"type": "start_bots", "count": count}) for count in (1, 2, 3)]):
            raw.speaks.send_binary(body)
        raw.flush()
        assert raw.reply()["type"] == "welcome"
        assert [len(raw.reply()["bots"]) for _ in range(3)] == [1, 2, 3]


def test_text_is_refused(served: Served) -> None:
    with _open(served) as raw:
        raw.speaks.send_text(b'{"type": "hello"}')
        raw.flush()
        assert raw.close_code() == 1003


@pytest.mark.parametrize("pieces", [1, 4])
def test_a_message_over_the_limit_is_refused_unread(served: Served, pieces: int) -> None:
    with _open(served) as raw:
        limit = int(raw.ask(HELLO)["max_body_bytes"])
        raw.speaks.send_binary(bytes(limit // pieces), fin=False)
        for _ in range(pieces - 1):
            raw.speaks.send_continuation(bytes(limit // pieces), fin=False)
        raw.speaks.send_continuation(bytes(pieces + 1), fin=True)
        raw.flush()
        assert raw.close_code() == 1009


def test_before_hello_no_more_than_a_hello_is_read(served: Served) -> None:
    longest = body_limit(TABLE, 0, Format.MSGPACK)
    with _open(served) as raw:
        assert raw.ask(b"\xc0" * longest)["code"] == "BAD_MSGPACK"
        raw.speaks.send_binary(bytes(longest + 1))
        raw.flush()
        assert raw.close_code() == 1009


def test_bytes_that_are_no_frame_are_refused(served: Served) -> None:
    for wrong in (b"\xff\xff\xff\xff", b"\x82\x01\x00", b"\x83\x80\0\0\0\0"):  # reserved bits, no mask, no such opcode
        with _open(served) as raw:
            raw.socket.sendall(wrong)
            assert raw.close_code() == 1002


def test_only_pages_that_are_allowed_may_open_one(hasty: Served, served: Served) -> None:
    for origin, status in ((PAGE, 101), (None, 101), ("https://other.example", 403), ("null", 403), (PAGE + ".x", 403)):
        with _open(hasty, origin=origin) as raw:
            assert raw.status == status
    with _open(served, origin=PAGE) as raw:
        assert raw.status == 403


def test_other_paths_are_not_served_and_nothing_is_compressed(served: Served) -> None:
    with _open(served, path="/v1/query") as raw:
        assert raw.status == 404
    with _open(served, path="/v1/socket?a=b", extensions=[ClientPerMessageDeflateFactory()]) as raw:
        assert (raw.status, raw.speaks.extensions) == (101, [])
    with BotClient(served.addresses["ws"].replace("/v1/socket", "")) as client:
        client._transport._uri = parse_uri(served.addresses["ws"] + "s")
        with pytest.raises(ReplyError, match="404"):
            client.hello()


def test_sockets_beyond_the_limit_are_refused_and_make_room_when_they_close(hasty: Served) -> None:
    with _open(hasty) as first:
        first.ask(HELLO)
        with _open(hasty) as second, _open(hasty) as third:
            assert (second.status, third.status) == (101, 503)
            second.ask(HELLO)
            second.speaks.send_close(1000)
            second.flush()
            assert second.close_code() == 1000
        with BotClient(hasty.addresses["ws"]) as again:
            again.hello()


@pytest.mark.parametrize("sent", [b"", b"\x82", b"\x82\xfe\x00\x80\0\0\0\0" + bytes(20)])
@pytest.mark.parametrize("greeted", [True, False])
def test_what_does_not_end_in_time_closes_the_socket(hasty: Served, sent: bytes, greeted: bool) -> None:
    with _open(hasty) as raw:
        if greeted:
            assert raw.ask(HELLO)["type"] == "welcome"
            if not sent:
                return  # it may be silent
        raw.socket.sendall(sent)
        assert raw.close_code() == 0


def test_pings_do_not_keep_a_silent_socket_open(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", idle_ttl_s=0.2) as served, _open(served) as raw:
        raw.ask(HELLO)
        with pytest.raises(ConnectionError):
            _ping_until_closed(raw)


def _ping_until_closed(raw: RawSocket) -> None:
    for _ in range(10**5):
        raw.speaks.send_ping(b"")
        raw.flush()
        assert raw.frame().opcode is Opcode.PONG


def test_a_client_whose_socket_was_closed_hears_of_it_and_connects_again(served: Served) -> None:
    with BotClient(served.addresses["ws"]) as client:
        client.hello()
        client.exchange({"type": "goodbye"})  # upon which the server closes
        with pytest.raises(ConnectionError):
            client.start(1)
        client.hello()
        assert len(client.start(1)) == 1


def test_draining_says_that_the_server_goes_away(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s") as served, _open(served) as raw:
        raw.ask(HELLO)
        served.stop()
        assert raw.close_code() == 1001
