"""What is fuzzed: each target takes any bytes, checks everything that must hold for them, and names what came of it.

This module knows nothing about where the bytes come from. A broken promise is an AssertionError, or whatever escapes.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import msgpack
import msgspec

from bot_runtime.bundle import Bundle
from bot_runtime.contents import MANIFEST_FILE
from protocol import codec
from protocol.codec import Format
from protocol.errors import BadBundle, ProtocolError
from protocol.messages import Request
from protocol.recording import BLOCK, MAX_RECORD_BYTES, PREAMBLE, RecordingError, block
from protocol.recording_reader import Ending, read_recording
from protocol.replies import read_actions, read_queries, read_reply, read_welcome
from protocol.transport import ReplyError
from tests.bundles import make_bundle
from tests.fuzz.campaign import Target
from tests.fuzz.desk import PENDING_FRAME, Exchange, Twins
from tests.fuzz.mutation import changed_bytes, changed_json, changed_msgpack
from tests.protocol.golden import BOTS, REFUSED, REPLIES, REQUESTS, TABLE, WELCOME
from tests.protocol.recordings import write

__all__ = ["TARGETS"]

_KINDS: tuple[type[Request], ...] = Request.__args__
_FORMS = (Format.MSGPACK, Format.JSON)
_DECODING = {"BAD_MSGPACK", "BAD_JSON", "TOO_DEEP", "BAD_SCHEMA"}


def _said(control: int, body: bytes) -> bytes:
    """An input that is a message: the first byte says which format, which door and whether it names a connection."""
    return bytes([control]) + body


def _exchange(data: bytes) -> Exchange:
    control = data[0] if data else 0
    kind = _KINDS[(control >> 2) % len(_KINDS)] if control & 2 else None
    return Exchange(data[1:], _FORMS[control & 1], kind, control < 224)


def _requests(extra: list[dict[str, Any]] | None = None) -> list[bytes]:
    """Every golden request as both formats, and every body that is refused."""
    bodies = [vector.body for vector in (*REQUESTS, *REFUSED)] + [msgpack.packb(each) for each in extra or []]
    as_json = [msgspec.json.encode(vector.message) for vector in REQUESTS]
    return [_said(0, body) for body in bodies] + [_said(1, body) for body in as_json]


def _changed_message(data: bytes, random: Random) -> bytes:
    control = data[0] if data else 0
    if random.random() < 0.15:
        control = random.choice((0, 1, random.randrange(256)))
    change = random.choice((changed_bytes, changed_json if control & 1 else changed_msgpack))
    return _said(control, change(data[1:], random))


def _documented(error: ProtocolError, codes: set[str]) -> str:
    assert error.code in codes, error
    assert error.detail
    return error.code


class CodecTarget:
    """Requests are decoded, or refused as documented; what was decoded survives being written and read again."""

    def __init__(self, folder: Path) -> None:
        self.seeds = _requests()
        self.change = _changed_message

    def run(self, data: bytes) -> str:
        """See Target."""
        said = _exchange(data)
        try:
            if said.kind is None:
                message = codec.decode_request(said.body, said.form)
            else:
                message = codec.decode(said.body, said.form, said.kind)
        except ProtocolError as error:
            return _documented(error, _DECODING)
        again = codec.encode(message, said.form)
        assert codec.encode(codec.decode_request(again, said.form), said.form) == again
        return type(message).__name__


class ReplyTarget:
    """A client that reads any bytes for a reply raises ReplyError or the refusal that they say, nothing else."""

    _READ: tuple[tuple[str, Callable[[dict[str, Any]], Any]], ...] = (
        ("hello", read_welcome),
        ("request_queries", lambda reply: read_queries(reply, 2, TABLE)),
        ("submit_features", lambda reply: read_actions(reply, 2, WELCOME.action)),
        ("start_bots", dict), ("stop_bots", dict), ("goodbye", dict),
    )  # fmt: skip

    def __init__(self, folder: Path) -> None:
        self.seeds = [_said(n % len(self._READ) << 1, vector.body) for vector in REPLIES for n in range(3)]
        self.change = _changed_message

    def run(self, data: bytes) -> str:
        """See Target."""
        kind, read = self._READ[((data[0] if data else 0) >> 1) % len(self._READ)]
        try:
            return type(read(read_reply(data[1:], kind))).__name__
        except ReplyError:
            return "ReplyError"
        except ProtocolError as error:
            return error.code


class TurnTarget:
    """Any bytes get one documented answer, and what is refused changes nothing: see `tests.fuzz.desk`."""

    _SESSION = 128  # inputs until both desks are compared and begin anew

    def __init__(self, folder: Path) -> None:
        self._twins = Twins(Bundle.load(make_bundle(folder / "bundle", features=TABLE, action=WELCOME.action)))
        self._left = self._SESSION
        desk = self._twins.fuzzed
        answered = desk.submission(PENDING_FRAME, desk.pending_NM)
        size = len(answered["acquired"])
        legal = [
            answered,
            answered | {"acquire_us": 12.5},
            answered | {"acquired": bytes(size), "values": b"", "failed": answered["acquired"]},
            desk.request(PENDING_FRAME),
            *(desk.request(frame) | {"rewards": [1.0, -1.0]} for frame in (8, 9)),
            answered | desk.request(PENDING_FRAME + 1) | {"type": "take_turn", "hidden": True},
        ]
        self.seeds = _requests([message | ({"bots": BOTS} if "bots" in message else {}) for message in legal])
        self.change = _changed_message

    def run(self, data: bytes) -> str:
        """See Target."""
        if self._left == 0:
            self._twins.compare(3)
            self._twins.open()
            self._left = self._SESSION
        self._left -= 1
        said = _exchange(data)
        return self._twins.ask(said._replace(body=self._named(said)))

    def _named(self, said: Exchange) -> bytes:
        """The body with the names of the bots that there are, where it has the golden ones."""
        body = said.body
        for golden, handle in zip(BOTS, self._twins.fuzzed.handles, strict=True):
            if said.form is Format.JSON:
                body = body.replace(b"%d" % golden, b"%d" % handle)
            else:
                packed = b"\xcf" + struct.pack(">Q", golden)
                body = body.replace(packed, b"\xcf" + struct.pack(">Q", handle))
        return body


class RecordingTarget:
    """Any file is a recording of legal records up to some byte, or none; the reader says which and never fails."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "recording"
        write(self._path)
        self.seeds = [self._path.read_bytes()]

    def run(self, data: bytes) -> str:
        """See Target."""
        self._path.write_bytes(data)
        try:
            recording = read_recording(self._path)
        except RecordingError:
            return "RecordingError"
        records = sum(1 for _ in recording)
        tail = recording.tail
        assert tail.offset + tail.left_out == len(data)
        assert (tail.ending is Ending.WHOLE) == (tail.left_out == 0)
        assert tail.resumes_at is None or tail.offset <= tail.resumes_at < len(data)
        return f"{tail.ending.value} after {min(records, 4)}"

    def change(self, data: bytes, random: Random) -> bytes:
        """Bytes as they come; or one block's payload as an author would change it, with the CRC that it then needs."""
        at = PREAMBLE.size
        places = []
        while at + BLOCK.size <= len(data):
            length = min(BLOCK.unpack_from(data, at)[0], MAX_RECORD_BYTES)
            places.append((at, at + BLOCK.size + length))
            at += BLOCK.size + length
        if not places or random.random() < 0.3:
            return changed_bytes(data, random)
        begin, end = random.choice(places)
        payload = changed_msgpack(data[begin + BLOCK.size : end], random)
        return data[:begin] + block(payload) + data[end:]


class ManifestTarget:
    """A bundle with any manifest is refused as a bad bundle, or serves: nothing else escapes."""

    def __init__(self, folder: Path) -> None:
        whole = make_bundle(folder / "whole", features=TABLE, action=WELCOME.action)
        self._folder = Path(shutil.copytree(whole, folder / "changed"))
        self.seeds = [(whole / MANIFEST_FILE).read_bytes()]

    def run(self, data: bytes) -> str:
        """See Target."""
        (self._folder / MANIFEST_FILE).write_bytes(data)
        try:
            return type(Bundle.load(self._folder)).__name__
        except BadBundle as error:
            return _documented(error, {"BAD_BUNDLE"})

    def change(self, data: bytes, random: Random) -> bytes:
        """See Target."""
        return random.choice((changed_bytes, changed_json))(data, random)


TARGETS: dict[str, Callable[[Path], Target]] = {
    "codec": CodecTarget,
    "replies": ReplyTarget,
    "turn": TurnTarget,
    "recording": RecordingTarget,
    "manifest": ManifestTarget,
}
