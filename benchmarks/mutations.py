"""Damaged and tampered bundles: `python -m benchmarks.mutations --count 10000`.

Each mutation changes one file of a bundle: bytes flipped, cut off, put in, left out, or another bundle's file in its
place. What must hold: every one that is not of the manifest is refused before the graph or the golden episode in it is
parsed at all, because hashes come first; and so is every one of the manifest where a signature is required. Without a
signature nothing protects the manifest but its schema and the golden replay: the last row counts what that lets
through, which is why servers that others can write bundles for should require signatures.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from rich.console import Console
from rich.progress import track
from rich.table import Table

from bot_runtime.bundle import Bundle
from bot_runtime.contents import MANIFEST_FILE, SIGNATURE_FILE, Contents
from bot_runtime.manifest import FILES
from bot_runtime.signature import Keys
from protocol.errors import BadBundle

__all__ = ["Mutations", "main", "measure", "mutate"]

_MAX_CHANGE_BYTES = 64
_BEFORE, _AFTER, _ACCEPTED = "before parsing", "after parsing", "accepted"


@dataclass(frozen=True)
class Mutations:
    """How many bundles are spoilt, and of what."""

    bundle: Path = Path("bundles/easy")
    count: int = 10_000  # of the files; as many again of the manifest with a signature, a tenth without one
    seed: int = 0
    json: bool = False  # print one JSON line instead of a table


def mutate(content: bytes, random: np.random.Generator) -> bytes:
    """Other bytes than these, nearly the same."""
    at, size = int(random.integers(len(content))), int(random.integers(1, _MAX_CHANGE_BYTES))
    match int(random.integers(5)):
        case 0:  # one bit
            return content[:at] + bytes([content[at] ^ (1 << int(random.integers(8)))]) + content[at + 1 :]
        case 1:  # some bytes, none of which stays what it is
            changed = bytes(byte ^ int(random.integers(1, 256)) for byte in content[at : at + size])
            return content[:at] + changed + content[at + size :]
        case 2:
            return content[:at]
        case 3:
            return content[:at] + random.bytes(size) + content[at:]
        case _:
            return content[:at] + content[at + size :]


def _fate(folder: Path, keys: Keys | None) -> str:
    """How far a bundle gets. Raises whatever is not BadBundle: nothing else may ever come out."""
    try:
        Contents.read(folder, keys)  # nothing but the manifest is parsed, and that only after its signature
    except BadBundle:
        return _BEFORE
    try:
        Bundle.load(folder, keys=keys)
    except BadBundle:
        return _AFTER
    return _ACCEPTED


def _fates(folder: Path, files: tuple[str, ...], count: int, keys: Keys | None, random: np.random.Generator) -> Counter:
    fates: Counter[str] = Counter()
    whole = {file: (folder / file).read_bytes() for file in files}
    for number in track(range(count), f"{', '.join(files)}", transient=True):
        file = files[number % len(files)]
        (folder / file).write_bytes(mutate(whole[file], random))
        fates[_fate(folder, keys)] += 1
        (folder / file).write_bytes(whole[file])
    return fates


def measure(asked: Mutations) -> dict[str, dict[str, int]]:
    """How far the spoilt bundles got, by what was spoilt. Raises BadBundle if the bundle itself does not load."""
    random, key = np.random.default_rng(asked.seed), Ed25519PrivateKey.generate()
    keys = Keys([key.public_key()])
    with tempfile.TemporaryDirectory(prefix="mutations-") as scratch:
        folder = Path(shutil.copytree(asked.bundle, Path(scratch) / "bundle"))
        (folder / SIGNATURE_FILE).write_bytes(key.sign((folder / MANIFEST_FILE).read_bytes()))
        Bundle.load(folder, keys=keys)
        fates = {
            "files": _fates(folder, FILES, asked.count, None, random),
            "manifest or signature, signed": _fates(folder, (MANIFEST_FILE, SIGNATURE_FILE), asked.count, keys, random),
            "manifest, unsigned": _fates(folder, (MANIFEST_FILE,), max(1, asked.count // 10), None, random),
        }
    return {name: {fate: counted[fate] for fate in (_BEFORE, _AFTER, _ACCEPTED)} for name, counted in fates.items()}


def main() -> None:
    """Command line."""
    asked = tyro.cli(Mutations, description=__doc__)
    measured = measure(asked)
    if asked.json:
        print(json.dumps({**asdict(asked), "bundle": str(asked.bundle)} | measured))
        return
    table = Table(title=f"spoilt copies of {asked.bundle}, refused")
    for column in ("spoilt", _BEFORE, _AFTER, _ACCEPTED):
        table.add_column(column, justify="right")
    for name, fates in measured.items():
        table.add_row(name, *(f"{count:,}" for count in fates.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
