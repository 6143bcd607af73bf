"""Whether one of the trusted keys signed a manifest.

This module knows nothing about files of a bundle or what a manifest says. A signature is Ed25519 (RFC 8032) over the
manifest's very bytes, 64 bytes raw: what `openssl pkeyutl -sign -rawin` writes too. The manifest has the hash of every
other file, so it stands for all of them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_public_key

from protocol.errors import BadBundle

__all__ = ["Keys", "fingerprint"]

_FINGERPRINT_DIGITS = 16


def fingerprint(key: Ed25519PublicKey) -> str:
    """How people tell keys apart: the first 16 hex digits of the SHA-256 of the raw public key."""
    raw = key.public_bytes(Encoding.Raw, PublicFormat.Raw)
    return hashlib.sha256(raw).hexdigest()[:_FINGERPRINT_DIGITS]


class Keys:
    """The public keys of those who may say what is served, at least one."""

    def __init__(self, keys: Sequence[Ed25519PublicKey]) -> None:
        if not keys:
            raise ValueError("there is no key, expected at least one")
        self._keys = tuple(keys)

    @classmethod
    def read(cls, paths: Sequence[Path]) -> Self:
        """The keys in these PEM files; raises OSError, ValueError."""
        return cls([_read_key(path) for path in paths])

    def signer(self, content: bytes, signature: bytes) -> str:
        """The fingerprint of the key that signed this; raises BadBundle."""
        for key in self._keys:
            try:
                key.verify(signature, content)
            except InvalidSignature:
                continue
            return fingerprint(key)
        known = ", ".join(fingerprint(key) for key in self._keys)
        raise BadBundle(f"the manifest's signature is by none of the trusted keys ({known})")


def _read_key(path: Path) -> Ed25519PublicKey:
    try:
        key = load_pem_public_key(path.read_bytes())
    except (ValueError, UnsupportedAlgorithm) as error:
        raise ValueError(f"{path} is not a public key in PEM: {error}") from error
    if not isinstance(key, Ed25519PublicKey):
        raise ValueError(f"{path} is a {type(key).__name__}, expected an Ed25519 public key")
    return key
