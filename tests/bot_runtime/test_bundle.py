"""A bundle loads, or BadBundle says what is wrong with it; nothing else ever comes out of the loader."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bot_runtime import bundle as bundle_module
from bot_runtime import contents as contents_module
from bot_runtime.bundle import Bundle
from bot_runtime.manifest import FILES
from protocol.errors import BadBundle
from tests.bundles import make_bundle, rehash


def change_manifest(path: Path, **fields: object) -> None:
    manifest = msgspec.json.decode((path / "manifest.json").read_bytes())
    (path / "manifest.json").write_bytes(msgspec.json.encode({**manifest, **fields}))


def change_golden(path: Path, change: Callable[[dict[str, np.ndarray]], None]) -> None:
    with np.load(path / "golden.npz") as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(path / "golden.npz", **arrays)
    rehash(path)


@pytest.mark.parametrize(
    "shape",
    [
        {},
        {"context_length": 2, "n_layers": 1, "n_heads": 1, "head_dim": 3},
        {"context_length": 7, "seed": 9},
        {"n_heads": 4, "n_kv_heads": 1},
        {"n_heads": 4, "n_kv_heads": 2},
        {"context_length": 1},
    ],
    ids=str,
)
def test_loads(tmp_path: Path, shape: dict[str, int]) -> None:
    loaded = Bundle.load(make_bundle(tmp_path / "tiny", **shape))
    assert loaded.name == "tiny"
    assert loaded.manifest.budget_us == pytest.approx(0.5 * (1.25 + 2.5 + 7.1 + 11.3 + 0.3))


def test_other_files_are_ignored(copy: Path) -> None:
    (copy / "config.json").write_text("{")
    (copy / "policy.pkl").write_bytes(b"\x80\x04.")
    Bundle.load(copy)


@pytest.mark.parametrize("file", ["manifest.json", *FILES])
def test_missing_linked_or_not_a_file(copy: Path, file: str) -> None:
    target = copy / file
    content = target.read_bytes()
    target.unlink()
    with pytest.raises(BadBundle, match=file):
        Bundle.load(copy)
    elsewhere = copy / "elsewhere"
    elsewhere.write_bytes(content)
    target.symlink_to(elsewhere)
    with pytest.raises(BadBundle, match=file):
        Bundle.load(copy)
    target.unlink()
    os.mkfifo(target)  # opening it must not wait for a writer
    with pytest.raises(BadBundle, match=f"{file} is not a regular file"):
        Bundle.load(copy)
    target.unlink()
    target.mkdir()
    with pytest.raises(BadBundle, match=file):
        Bundle.load(copy)


@pytest.mark.parametrize(
    "fields",
    [
        {"schema_version": 3},
        {"schema_version": "2"},
        {"prepared_width": 0},
        {"samples_action": 1},
        {"name": "../evil"},
        {"name": "Tiny"},
        {"name": "tiny\n"},
        {"name": "a" * 65},
        {"method": "ppo"},
        {"context_length": 0},
        {"context_length": 1},
        {"context_length": 1, "n_layers": 0, "n_heads": 0, "head_dim": 0},
        {"target_cost": 1.01},
        {"target_cost": -0.1},
        {"target_cost": "0.5"},
        {"context_length": 10**6},
        {"n_layers": 0},
        {"head_dim": 65537},
        {"n_layers": 60000, "n_heads": 60000},
        {"n_kv_heads": 0},
        {"n_kv_heads": -1},
        {"n_kv_heads": 3},
        {"n_kv_heads": "1"},
        {"budget": 1.5},
        {"budget": None},
        {"tolerance": 1.0},
        {"tolerance": 0.0},
        {"tolerance": 0.05},
        {"tolerance": 0.2, "precision": "int8"},
        {"precision": "int4"},
        {"files": {}},
        {"files": {"../x": {"sha256": "0" * 64, "bytes": 1}}},
        {"files": {file: {"sha256": "xyz", "bytes": 1} for file in FILES}},
        {"surprise": 1},
        {"features": {"features": []}},
        {"action": {"components": []}},
        {"features": {"features": [{"name": "a", "size": 1, "high": 1e39}]}},  # infinite as float32: no limit at all
        {"action": {"components": [{"name": "a", "low": -1e39, "high": 1.0}]}},
    ],
    ids=lambda fields: "-".join(fields),
)
def test_illegal_manifest(copy: Path, fields: dict[str, object]) -> None:
    change_manifest(copy, **fields)
    with pytest.raises(BadBundle, match=r"manifest\.json"):
        Bundle.load(copy)


def test_a_manifest_that_says_nothing_of_precision_is_float32(copy: Path) -> None:
    manifest = msgspec.json.decode((copy / "manifest.json").read_bytes())
    del manifest["precision"]
    (copy / "manifest.json").write_bytes(msgspec.json.encode(manifest))
    assert Bundle.load(copy).manifest.precision == "fp32"
    change_manifest(copy, tolerance=0.05, precision="int8")
    assert Bundle.load(copy).manifest.precision == "int8"


def test_a_manifest_that_says_nothing_of_shared_heads_has_none(copy: Path, tmp_path: Path) -> None:
    manifest = msgspec.json.decode((copy / "manifest.json").read_bytes())
    del manifest["n_kv_heads"]
    (copy / "manifest.json").write_bytes(msgspec.json.encode(manifest))
    assert Bundle.load(copy).manifest.token == (2, 8)
    shared = Bundle.load(make_bundle(tmp_path / "shared", n_kv_heads=1)).manifest
    assert shared.token == (1, 8)
    change_manifest(copy, n_kv_heads=1)
    with pytest.raises(BadBundle, match="keys_0 has shape"):
        Bundle.load(copy)


def test_shared_heads_of_a_network_without_any_are_refused(tmp_path: Path) -> None:
    path = make_bundle(tmp_path / "blind", context_length=1)
    change_manifest(path, n_kv_heads=1)
    with pytest.raises(BadBundle, match=r"n_kv_heads is 1, expected a divisor of n_heads, 0"):
        Bundle.load(path)


def test_a_bundle_of_an_earlier_schema_says_what_to_do(copy: Path) -> None:
    """Before its other fields are looked at: those were others then."""
    change_manifest(copy, schema_version=1, width="64")
    with pytest.raises(BadBundle, match=r"manifest\.json has schema_version 1, expected 2: export the run again"):
        Bundle.load(copy)


@pytest.mark.parametrize("content", [b"", b"{", b"[" * 10**6, b"\xff\xfe", b'{"\xcf": 1}', b" " * (2**20 + 1)])
def test_manifest_that_is_not_json(copy: Path, content: bytes) -> None:
    (copy / "manifest.json").write_bytes(content)
    with pytest.raises(BadBundle, match=r"manifest\.json"):
        Bundle.load(copy)


@pytest.mark.parametrize("field", ["width", "context_length", "n_heads", "n_layers", "head_dim"])
def test_graphs_of_other_sizes_than_the_manifest_says(copy: Path, field: str) -> None:
    manifest = msgspec.json.decode((copy / "manifest.json").read_bytes())
    change_manifest(copy, **{field: manifest[field] + 1})
    with pytest.raises(BadBundle, match="expected"):
        Bundle.load(copy)


def test_any_damaged_byte_is_refused_before_parsing(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """10,000 mutations are the long form; hashes make each byte equal, so a few hundred places do."""

    def parse(*_: object) -> None:
        raise AssertionError("parsed before its hash was checked")

    for reader in ("check_graph", "read_golden", "Policy"):
        monkeypatch.setattr(bundle_module, reader, parse)
    random = np.random.default_rng(0)
    for file in FILES:
        content = (copy / file).read_bytes()
        for place in random.integers(0, len(content), 60):
            damaged = bytearray(content)
            damaged[place] ^= 1 << int(random.integers(8))
            (copy / file).write_bytes(damaged)
            with pytest.raises(BadBundle, match=f"{file} has sha256"):
                Bundle.load(copy)
        for wrong in (content[:-1], content + b"\0", b""):
            (copy / file).write_bytes(wrong)
            with pytest.raises(BadBundle, match=f"{file} has {len(wrong)} bytes"):
                Bundle.load(copy)
        (copy / file).write_bytes(content)


def test_larger_than_any_bundle(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contents_module, "MAX_FILE_BYTES", 100)
    with pytest.raises(BadBundle, match="more than 100 bytes"):
        Bundle.load(copy)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_mutated_and_rehashed_is_loaded_or_refused(copy: Path, bundle_path: Path, data: st.DataObject) -> None:
    """An author with the hashes on their side still gets a bundle or a BadBundle, never another exception."""
    file = data.draw(st.sampled_from(FILES))
    content = bytearray((bundle_path / file).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    shutil.copytree(bundle_path, copy, dirs_exist_ok=True)
    (copy / file).write_bytes(content[: data.draw(st.integers(1, len(content)))])
    rehash(copy)
    with contextlib.suppress(BadBundle):
        Bundle.load(copy)


def test_a_turn_that_is_never_fast_enough_is_refused(copy: Path) -> None:
    limit_ns = int(bundle_module.MAX_TURN_MS * 1e6)
    slow = itertools.count(0, limit_ns + 1)
    with pytest.raises(BadBundle, match="a turn of tiny takes 100 ms"):
        Bundle.load(copy, clock=slow.__next__)
    stalled_once = iter([0, 10 * limit_ns, 20 * limit_ns, 21 * limit_ns])
    Bundle.load(copy, clock=stalled_once.__next__)


@pytest.mark.parametrize("name", ["probs", "actions", "hidden"])
def test_golden_replay_notices_a_difference(copy: Path, name: str) -> None:
    def nudge(arrays: dict[str, np.ndarray]) -> None:
        arrays[name][-1, -1] += 3e-4

    change_golden(copy, nudge)
    with pytest.raises(BadBundle, match=f"{name} of turn 13 differ"):
        Bundle.load(copy)
    Bundle.load(copy, replay=False)


@pytest.mark.parametrize("name", ["free", "costly", "rewards", "queries", "seed", "target_return"])
def test_golden_replay_reads_every_input(copy: Path, name: str) -> None:
    def nudge(arrays: dict[str, np.ndarray]) -> None:
        if name == "queries":
            arrays[name][0] ^= 1
        elif name == "costly":
            arrays[name][arrays["queries"].any(axis=1)] += 1.0
        else:
            arrays[name] = arrays[name] + arrays[name].dtype.type(1)

    change_golden(copy, nudge)
    with pytest.raises(BadBundle, match="golden replay"):
        Bundle.load(copy)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda arrays: arrays.pop("hidden"), "holds"),
        (lambda arrays: arrays.update(extra=np.zeros(1)), "holds"),
        (lambda arrays: arrays.update(probs=arrays["probs"][:, 1:]), "probs has shape"),
        (lambda arrays: arrays["free"].__setitem__((0, 0), np.nan), "free is float32, expected finite"),
        (lambda arrays: arrays["queries"].__setitem__((0, 0), 2), "other numbers than 0 and 1"),
        (lambda arrays: arrays.update({k: v[:4] for k, v in arrays.items() if v.ndim}), "4 turns, expected more"),
        (lambda arrays: arrays.update(seed=np.array("x")), "seed is <U1"),
    ],
)
def test_illegal_golden(copy: Path, change: Callable[[dict[str, np.ndarray]], None], match: str) -> None:
    change_golden(copy, change)
    with pytest.raises(BadBundle, match=match):
        Bundle.load(copy)


def test_no_pickle_in_golden(copy: Path) -> None:
    np.savez(copy / "golden.npz", seed=np.array([print], dtype=object))
    rehash(copy)
    with pytest.raises(BadBundle, match="plain arrays"):
        Bundle.load(copy)


def test_zip_bomb_in_golden(copy: Path) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("free.npy", b"\0" * (65 * 2**20))
    (copy / "golden.npz").write_bytes(packed.getvalue())
    rehash(copy)
    with pytest.raises(BadBundle, match="unpacks to"):
        Bundle.load(copy)
