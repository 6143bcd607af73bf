"""A record: one frame of N bots as numpy arrays, checked, and as the bytes of `protocol.recording`.

This module knows nothing about files, nor about which records may follow each other. Shape letters as in
`protocol.features`.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, cast

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from protocol import arrays, codec
from protocol.codec import Format
from protocol.errors import BadSchema, BadShape, OutOfRange, TooLarge
from protocol.features import Feature
from protocol.messages import MAX_BOTS_PER_MESSAGE, MAX_FRAME, MAX_RETURN
from protocol.recording import MAX_RECORD_BYTES, Header, block
from protocol.values import check_frame, check_shape, check_values

__all__ = ["Record", "checked_record", "decode_record", "encode_record", "max_bots"]

_MAX_EPISODE = 2**64 - 1
_ROW_BYTES = 9 + 4 + 2  # of a bot: its episode at the widest, its reward, its flags
_FIXED_BYTES = 256  # names of fields, session, frame, lengths
_REWARD = (Feature("reward", 1, low=-MAX_RETURN, high=MAX_RETURN),)
_REWARD_RANGE = (np.array([-MAX_RETURN], dtype=np.float32), np.array([MAX_RETURN], dtype=np.float32))


class Record(NamedTuple):
    """One frame of N bots. Costly numbers that were not acquired are 0; an ended bot's action is the safe one."""

    session: int
    frame: int
    episodes: NDArray[np.uint64]  # [N]
    free: NDArray[np.float32]  # [N, F]
    acquired: NDArray[np.bool_]  # [N, M]
    costly: NDArray[np.float32]  # [N, D]
    actions: NDArray[np.float32]  # [N, A]
    rewards: NDArray[np.float32]  # [N], since each bot's record before
    terminated: NDArray[np.bool_]  # [N]
    truncated: NDArray[np.bool_]  # [N]

    @property
    def ended(self) -> NDArray[np.bool_]:
        """Whose episode ends here, shape [N]."""
        return self.terminated | self.truncated


class _Payload(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    session: Annotated[int, Meta(ge=0, le=MAX_FRAME)]
    frame: Annotated[int, Meta(ge=0, le=MAX_FRAME)]
    episodes: Annotated[list[Annotated[int, Meta(ge=0)]], Meta(min_length=1, max_length=MAX_BOTS_PER_MESSAGE)]
    free: bytes
    acquired: bytes
    values: bytes
    actions: bytes
    rewards: bytes
    terminated: bytes
    truncated: bytes


def max_bots(header: Header) -> int:
    """The most bots that a record may have."""
    features = header.features
    numbers = features.n_free + features.n_costly + header.action.size
    row_bytes = _ROW_BYTES + 4 * numbers + -(-features.n_queries // 8)
    return min(MAX_BOTS_PER_MESSAGE, (MAX_RECORD_BYTES - _FIXED_BYTES) // row_bytes)


def checked_record(
    header: Header,
    session: int,
    frame: int,
    episodes: Sequence[int] | NDArray[np.integer],
    *,
    free: ArrayLike,
    costly: ArrayLike,
    actions: ArrayLike,
    acquired: ArrayLike | None = None,
    rewards: ArrayLike | None = None,
    terminated: ArrayLike | None = None,
    truncated: ArrayLike | None = None,
) -> Record:
    """A record of what an engine says, as `Recorder.record` takes it; raises as that does."""
    features, ids = header.features, _integers("episodes", episodes)
    n = _checked_count(len(ids), header)
    for number in ids:
        if not 0 <= number <= _MAX_EPISODE:
            raise OutOfRange(f"episode {number} is named, expected 0 to {_MAX_EPISODE}")
    (frame,) = _integers("frame", [frame])
    check_frame(frame)
    record = Record(
        session,
        frame,
        np.array(ids, dtype=np.uint64),
        _floats("free", free, (n, features.n_free)),
        _flags("acquired", acquired, (n, features.n_queries), unsaid=True),
        _floats("costly", costly, (n, features.n_costly)),
        _floats("actions", actions, (n, header.action.size)),
        np.zeros(n, dtype=np.float32) if rewards is None else _floats("rewards", rewards, (n,)),
        _flags("terminated", terminated, (n,), unsaid=False),
        _flags("truncated", truncated, (n,), unsaid=False),
    )
    _check_content(record, header)
    return record


def encode_record(record: Record, header: Header) -> bytes:
    """The block of a record that has been checked."""
    return block(
        codec.encode(
            _Payload(
                record.session,
                record.frame,
                record.episodes.tolist(),
                _blob(record.free),
                _bits(record.acquired),
                _blob(record.costly[record.acquired[:, header.features.owner]]),
                _blob(record.actions[~record.ended]),
                _blob(record.rewards),
                _bits(record.terminated[None]),
                _bits(record.truncated[None]),
            ),
            Format.MSGPACK,
        )
    )


def decode_record(payload: bytes, header: Header) -> Record:
    """The record in a payload. Raises TooLarge, BadShape, NonFinite, OutOfRange, and as `codec.decode` does."""
    said = codec.decode(payload, Format.MSGPACK, _Payload)
    features, action, n = header.features, header.action, _checked_count(len(said.episodes), header)
    terminated = arrays.bits(said.terminated, (1, n), "terminated")[0]
    truncated = arrays.bits(said.truncated, (1, n), "truncated")[0]
    acquired = arrays.bits(said.acquired, (n, features.n_queries), "acquired")
    plays = ~(terminated | truncated)
    actions = np.tile(action.safe, (n, 1))
    actions[plays] = arrays.floats(said.actions, (int(plays.sum()), action.size), "actions")
    record = Record(
        said.session,
        said.frame,
        np.array(said.episodes, dtype=np.uint64),
        arrays.floats(said.free, (n, features.n_free), "free"),
        acquired,
        arrays.unpack_values(said.values, acquired, features),
        actions,
        arrays.floats(said.rewards, (n, 1), "rewards")[:, 0],
        terminated,
        truncated,
    )
    _check_content(record, header)
    return record


def _check_content(record: Record, header: Header) -> None:
    """Raises unless the numbers, of the right shapes, are legal. Bots are named by their place in the record."""
    if len(set(record.episodes.tolist())) < len(record.episodes):
        raise BadSchema("an episode is named more than once, expected at most once a record")
    features, action = header.features, header.action
    rows, plays_N1 = np.arange(len(record.episodes)), ~record.ended[:, None]
    check_values(record.free, None, rows, features.free, features.free_range)
    check_values(record.costly, record.acquired[:, features.owner], rows, features.costly, features.costly_range)
    check_values(record.actions, plays_N1, rows, action.components, action.range)
    check_values(record.rewards[:, None], None, rows, _REWARD, _REWARD_RANGE)


def _checked_count(bots: int, header: Header) -> int:
    """Bounds a record before anything is made for it."""
    if bots < 1:
        raise BadShape("a record has no bots, expected at least 1")
    if bots > max_bots(header):
        raise TooLarge(f"a record has {bots} bots, expected {max_bots(header)} or less with these features")
    return bots


def _integers(name: str, numbers: Sequence[int] | NDArray[np.integer]) -> list[int]:
    try:
        return [operator.index(number) for number in numbers]
    except TypeError as error:
        raise BadSchema(f"{name}: {error}, expected integers") from error


def _array(name: str, values: ArrayLike) -> NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError as error:
        raise BadShape(f"{name}: {error}") from error


def _floats(name: str, numbers: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    array = _array(name, numbers)
    if array.dtype.kind not in "fiu":
        raise BadShape(f"{name} is {array.dtype} {list(array.shape)}, expected numbers {list(shape)}")
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold becomes infinite, which is refused
        narrow = array.astype(np.float32)
    check_shape(name, narrow, shape, np.float32)
    return narrow


def _flags(name: str, flags: ArrayLike | None, shape: tuple[int, ...], *, unsaid: bool) -> NDArray[np.bool_]:
    if flags is None:
        return np.full(shape, unsaid)
    array = _array(name, flags)
    check_shape(name, array, shape, np.bool_)
    return array


def _blob(numbers: NDArray[np.float32]) -> bytes:
    return cast("bytes", arrays.pack_floats(numbers, Format.MSGPACK))


def _bits(flags: NDArray[np.bool_]) -> bytes:
    return cast("bytes", arrays.pack_bits(flags, Format.MSGPACK))
