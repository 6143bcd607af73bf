"""What a bundle says about itself: its features, its action, the sizes of its context, and the hash of every file.

This module knows nothing about files on a disk, ONNX or bots.
"""

from __future__ import annotations

import math
import re
from typing import Literal

import msgspec

from protocol.features import ActionSpec, FeatureTable

__all__ = [
    "FILES",
    "MAX_CONTEXT_LENGTH",
    "MAX_INT8_TOLERANCE",
    "MAX_TOLERANCE",
    "SCHEMA_VERSION",
    "FileEntry",
    "Manifest",
]

SCHEMA_VERSION = 2
FILES = ("acquisition.onnx", "action.onnx", "golden.npz")
MAX_CONTEXT_LENGTH = 1024
MAX_TOLERANCE = 1e-2
MAX_INT8_TOLERANCE = 0.1  # where a last digit, rounded another way, is a whole step
_MAX_DIMENSION = 65536
_MAX_CONTEXT_NUMBERS = 16 * 2**20  # keys and values of one bot: 64 MiB
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


class FileEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Size in bytes and SHA-256 (lower-case hex) of one file of the bundle."""

    sha256: str
    bytes: int

    def __post_init__(self) -> None:
        if not _SHA256.fullmatch(self.sha256):
            raise ValueError(f"sha256 {self.sha256[:80]!r} is not 64 lower-case hex digits")
        if self.bytes < 1:
            raise ValueError(f"a file has {self.bytes} bytes, expected at least 1")


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Schema 2 of `manifest.json`. Raises ValueError (msgspec turns it into ValidationError) when a field is illegal.

    `budget` is the normalised C of the paper, in [0, 1]; 1 means unconstrained. `context_length` 1 means no context at
    all: a network without memory, whose layers, heads and width are 0. `prepared_width` is how many numbers the
    acquisition graph hands on to the action graph, none of which depends on the hidden state; `samples_action` says
    that the latter reads noise. `n_kv_heads` is how many heads of keys and values the `n_heads` heads share, each of
    them as many; None, and none is shared. `target_cost` is the share of the full cost that a budget-conditioned
    network is asked for by default; None, and the network has no such input. `tolerance` is the largest |Δ| that the
    golden replay accepts. `precision` is that of the graphs' large matrix products.
    """

    schema_version: Literal[2]
    name: str
    method: Literal["bdt", "rcbc", "bc", "iql"]
    features: FeatureTable
    action: ActionSpec
    context_length: int
    n_layers: int
    n_heads: int
    head_dim: int
    width: int
    prepared_width: int
    samples_action: bool
    target_return: float
    budget: float
    tolerance: float
    files: dict[str, FileEntry]
    provenance: dict[str, str]
    target_cost: float | None = None
    n_kv_heads: int | None = None
    precision: Literal["fp32", "int8"] = "fp32"

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"bundle name {self.name[:80]!r} does not match {_NAME.pattern}")
        self._check_context()
        if not math.isfinite(self.target_return):
            raise ValueError(f"target_return is {self.target_return}, expected a finite number")
        if not 0.0 <= self.budget <= 1.0:
            raise ValueError(f"budget is {self.budget}, expected 0 to 1")
        if self.target_cost is not None and not 0.0 <= self.target_cost <= 1.0:
            raise ValueError(f"target_cost is {self.target_cost}, expected 0 to 1 or null")
        most = MAX_INT8_TOLERANCE if self.precision == "int8" else MAX_TOLERANCE
        if not 0.0 < self.tolerance <= most:
            raise ValueError(f"tolerance is {self.tolerance}, expected more than 0 and at most {most}")
        if set(self.files) != set(FILES):
            raise ValueError(f"files are {sorted(self.files)}, expected {sorted(FILES)}")

    def _check_context(self) -> None:
        if not 1 <= self.context_length <= MAX_CONTEXT_LENGTH:
            raise ValueError(f"context_length is {self.context_length}, expected 1 to {MAX_CONTEXT_LENGTH}")
        low, high = (1, _MAX_DIMENSION) if self.has_context else (0, 0)
        for field in ("n_layers", "n_heads", "head_dim", "width"):
            if not low <= getattr(self, field) <= high:
                expected = f"{low} to {high} with context_length {self.context_length}"
                raise ValueError(f"{field} is {getattr(self, field)}, expected {expected}")
        if self.n_kv_heads is not None and (self.n_kv_heads < 1 or self.n_heads % self.n_kv_heads or not self.n_heads):
            raise ValueError(f"n_kv_heads is {self.n_kv_heads}, expected a divisor of n_heads, {self.n_heads}, or null")
        if not 1 <= self.prepared_width <= _MAX_DIMENSION:
            raise ValueError(f"prepared_width is {self.prepared_width}, expected 1 to {_MAX_DIMENSION}")
        if 2 * self.n_layers * self.n_slots * math.prod(self.token) > _MAX_CONTEXT_NUMBERS:
            raise ValueError(f"one bot's keys and values are more than {_MAX_CONTEXT_NUMBERS} numbers")

    @property
    def n_slots(self) -> int:
        """S: how many past turns the key/value cache holds, K - 1."""
        return self.context_length - 1

    @property
    def token(self) -> tuple[int, int]:
        """(G, d): heads of a key, and of a value, and numbers of each."""
        return self.n_heads if self.n_kv_heads is None else self.n_kv_heads, self.head_dim

    @property
    def replay_turns(self) -> int:
        """How many of a bot's last turns rebuild its context to the bit: with span K and L layers, L (K - 1) + 1.

        A layer's keys and values at turn t are felt for K - 1 turns by the next layer; one turn is the last action's.
        """
        return self.n_layers * self.n_slots + 1

    @property
    def has_context(self) -> bool:
        """Whether the network remembers earlier frames: it then has a hidden state, keys and values."""
        return self.context_length > 1

    @property
    def is_conditioned(self) -> bool:
        """Whether the acquisition head reads a target cost, so that one network serves every budget."""
        return self.target_cost is not None

    @property
    def is_unlimited(self) -> bool:
        """Whether the bundle was trained without a limit; then a bot has none unless it is given one."""
        return self.budget == 1.0

    @property
    def budget_us(self) -> float:
        """The default budget of one bot in µs, at the costs that the feature table declares."""
        return self.budget * float(self.features.costs_us.sum())
