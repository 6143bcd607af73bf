"""Sign a bundle: `python -m training.sign --bundle runs/hard/bundle --key private.pem`.

Writes `manifest.sig` beside the manifest, for servers that are told to serve nothing unsigned (`--signing-key`). The
bundle is verified first, whole: a signature says that somebody stands for it. The key is an unencrypted Ed25519 private
key in PEM (`openssl genpkey -algorithm ed25519 -out private.pem`, its public half by `openssl pkey -pubout`); it stays
where bundles are made, and a server never needs it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import tyro
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from bot_runtime.bundle import Bundle
from bot_runtime.contents import MANIFEST_FILE, MAX_MANIFEST_BYTES, SIGNATURE_FILE, read_file
from bot_runtime.signature import Keys
from training.command import command

__all__ = ["SignConfig", "main", "sign"]


@dataclass(frozen=True)
class SignConfig:
    """Sign a bundle."""

    bundle: Path  # folder of the bundle
    key: Path  # private key, PEM


def sign(config: SignConfig) -> str:
    """Write the signature and return the key's fingerprint. Raises BadBundle, OSError, ValueError."""
    key = _read_private_key(config.key)
    verified = Bundle.load(config.bundle)
    content = read_file(config.bundle / MANIFEST_FILE, MAX_MANIFEST_BYTES)
    signature = key.sign(content)
    unfinished = config.bundle / f"{SIGNATURE_FILE}.{os.getpid()}"
    unfinished.write_bytes(signature)
    unfinished.replace(config.bundle / SIGNATURE_FILE)
    signed = Bundle.read(config.bundle, keys=Keys([key.public_key()]))
    if signed.sha256 != verified.sha256 or signed.signed_by is None:
        raise ValueError(f"{config.bundle} was changed while it was being signed")
    return signed.signed_by


def _read_private_key(path: Path) -> Ed25519PrivateKey:
    try:
        key = load_pem_private_key(path.read_bytes(), password=None)
    except (ValueError, TypeError) as error:  # TypeError where it is encrypted
        raise ValueError(f"{path} is not an unencrypted private key in PEM: {error}") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise ValueError(f"{path} is a {type(key).__name__}, expected an Ed25519 private key")
    return key


def main() -> None:
    """Command line."""
    with command():
        config = tyro.cli(SignConfig, description=__doc__)
        print(f"{config.bundle / SIGNATURE_FILE}: signed by key {sign(config)}")


if __name__ == "__main__":
    main()
