"""Signatures: made by tools that know nothing of ours, required by keys, checked before anything is parsed."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from bot_runtime.bundle import Bundle
from bot_runtime.signature import Keys, fingerprint
from protocol.errors import BadBundle

AUTHOR, OTHER = Ed25519PrivateKey.from_private_bytes(b"\1" * 32), Ed25519PrivateKey.from_private_bytes(b"\2" * 32)
TRUSTED = Keys([OTHER.public_key(), AUTHOR.public_key()])


@pytest.fixture
def signed(copy: Path) -> Path:
    (copy / "manifest.sig").write_bytes(AUTHOR.sign((copy / "manifest.json").read_bytes()))
    return copy


def test_a_signed_bundle_says_whose_key_signed_it(signed: Path) -> None:
    assert Bundle.load(signed, keys=TRUSTED).signed_by == fingerprint(AUTHOR.public_key())
    assert Bundle.read(signed, keys=TRUSTED) == Bundle.load(signed, keys=TRUSTED)
    assert Bundle.load(signed).signed_by is None


def test_an_unsigned_bundle_loads_only_where_no_key_is_given(copy: Path) -> None:
    Bundle.load(copy)
    with pytest.raises(BadBundle, match=r"manifest\.sig"):
        Bundle.load(copy, keys=TRUSTED)


@pytest.mark.parametrize("signature", [b"", b"\0" * 64, b"\0" * 63, b"x" * 1025, OTHER.sign(b"{}")])
def test_a_wrong_signature_is_refused(signed: Path, signature: bytes) -> None:
    (signed / "manifest.sig").write_bytes(signature)
    with pytest.raises(BadBundle, match=r"signature|bytes"):
        Bundle.load(signed, keys=TRUSTED)


def test_a_signature_by_a_key_that_is_not_trusted_is_refused(signed: Path) -> None:
    with pytest.raises(BadBundle, match="none of the trusted keys"):
        Bundle.load(signed, keys=Keys([OTHER.public_key()]))


def test_the_signature_comes_before_the_manifest_is_parsed_and_stands_for_every_file(signed: Path) -> None:
    manifest = (signed / "manifest.json").read_bytes()
    for changed in (manifest + b" ", b"\xff" + manifest, b"{"):
        (signed / "manifest.json").write_bytes(changed)
        with pytest.raises(BadBundle, match="signature"):
            Bundle.load(signed, keys=TRUSTED)
    (signed / "manifest.json").write_bytes(manifest)
    action = (signed / "action.onnx").read_bytes()
    (signed / "action.onnx").write_bytes(action[:-1] + bytes([action[-1] ^ 1]))
    with pytest.raises(BadBundle, match="sha256"):
        Bundle.load(signed, keys=TRUSTED)


def test_a_manifest_that_is_no_text_is_refused(copy: Path) -> None:
    manifest = (copy / "manifest.json").read_bytes()
    (copy / "manifest.json").write_bytes(manifest.replace(b"tiny", b"ti\xffy"))
    with pytest.raises(BadBundle, match=r"manifest\.json"):
        Bundle.load(copy)


def test_keys_are_ed25519_in_pem(tmp_path: Path) -> None:
    pem = [key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo) for key in (AUTHOR, OTHER)]
    paths = [tmp_path / name for name in ("author.pem", "other.pem")]
    for path, content in zip(paths, pem, strict=True):
        path.write_bytes(content)
    signature = AUTHOR.sign(b"anything")
    assert Keys.read(paths).signer(b"anything", signature) == fingerprint(AUTHOR.public_key())
    curve = generate_private_key(SECP256R1()).public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    for content, said in ((b"-----BEGIN", "PEM"), (b"", "PEM"), (curve, "Ed25519")):
        paths[0].write_bytes(content)
        with pytest.raises(ValueError, match=said):
            Keys.read(paths)
    with pytest.raises(ValueError, match="at least one"):
        Keys([])
