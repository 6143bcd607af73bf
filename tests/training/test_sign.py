from __future__ import annotations

from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
)

from bot_runtime.bundle import Bundle
from bot_runtime.signature import Keys
from protocol.errors import BadBundle
from tests.bundles import make_bundle
from training.sign import SignConfig, sign


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return make_bundle(tmp_path / "bundle")


def test_what_is_signed_loads_with_the_public_key_and_only_whole_bundles_are_signed(
    bundle: Path, tmp_path: Path
) -> None:
    key = Ed25519PrivateKey.generate()
    pem = tmp_path / "private.pem"
    pem.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    keys = Keys([key.public_key()])
    assert sign(SignConfig(bundle, pem)) == Bundle.load(bundle, keys=keys).signed_by
    assert sorted(path.name for path in bundle.iterdir() if "sig" in path.name) == ["manifest.sig"]
    (bundle / "manifest.sig").unlink()
    (bundle / "action.onnx").write_bytes(b"")
    with pytest.raises(BadBundle, match="action"):
        sign(SignConfig(bundle, pem))
    assert not (bundle / "manifest.sig").exists()


def test_the_key_is_an_unencrypted_ed25519_key(bundle: Path, tmp_path: Path) -> None:
    pem, ed25519 = tmp_path / "private.pem", Ed25519PrivateKey.generate()
    encrypted = ed25519.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"password"))
    curve = generate_private_key(SECP256R1()).private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    for content, said in ((encrypted, "unencrypted"), (b"", "PEM"), (curve, "Ed25519")):
        pem.write_bytes(content)
        with pytest.raises(ValueError, match=said):
            sign(SignConfig(bundle, pem))
