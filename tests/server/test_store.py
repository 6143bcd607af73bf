from __future__ import annotations

from pathlib import Path

import pytest

from protocol.errors import BadBundle, NoBundle
from server.store import MAX_VERSIONS, Content, Record, Store

RECORD = Record(Content(2, "a" * 64), Content(1, "b" * 64))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for version in ("1", "2", "10", "0", "01", "-1", "2.part", "1234567890"):
        (tmp_path / "hard" / version).mkdir(parents=True)
    (tmp_path / "hard" / "3").write_text("a file")
    (tmp_path / "hard" / "4").symlink_to(tmp_path / "hard" / "1")
    for name in ("easy_2-b", "Hard", ".git", "x" * 65):
        (tmp_path / name).mkdir()
    (tmp_path / "linked").symlink_to(tmp_path / "hard")
    return tmp_path


def test_names_and_versions_are_folders_of_the_right_names_and_not_links(folder: Path) -> None:
    store = Store(folder)
    assert store.names() == ["easy_2-b", "hard"]
    assert store.versions("hard") == [1, 2, 10]
    assert store.versions("easy_2-b") == []
    assert store.path("hard", 10) == folder / "hard" / "10"


@pytest.mark.parametrize("name", ["", ".", "..", "../hard", "hard/1", "linked", "Hard", "none", "hard\0", "h" * 300])
def test_a_name_never_leads_out_of_the_store(folder: Path, name: str) -> None:
    store = Store(folder)
    for ask in (store.versions, store.record, lambda name: store.path(name, 1), lambda name: store.write(name, RECORD)):
        with pytest.raises(NoBundle):
            ask(name)


@pytest.mark.parametrize("version", [0, -1, 3, 4, 5, 10**9])
def test_versions_that_are_not_there(folder: Path, version: int) -> None:
    with pytest.raises(NoBundle, match=f"version {version}"):
        Store(folder).path("hard", version)


def test_the_record_is_what_was_written_last(folder: Path) -> None:
    store = Store(folder)
    assert store.record("hard") is None
    store.write("hard", RECORD)
    assert Store(folder).record("hard") == RECORD
    store.write("hard", Record(Content(1, "b" * 64)))
    assert store.record("hard") == Record(Content(1, "b" * 64), None)
    assert [path.name for path in (folder / "hard").glob("active*")] == ["active.json"]
    store.write("hard", None)
    store.write("hard", None)
    assert store.record("hard") is None


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff", b'{"active": 3}', b'{"active": {"version": "3"}}', b"x" * 5000]
)
def test_a_damaged_record_is_said_to_be_one(folder: Path, content: bytes) -> None:
    (folder / "hard" / "active.json").write_bytes(content)
    with pytest.raises(BadBundle, match=r"active\.json"):
        Store(folder).record("hard")


def test_a_record_is_never_read_through_a_link(folder: Path) -> None:
    (folder / "elsewhere").write_text('{"active": {"version": 1, "sha256": "x"}}')
    (folder / "hard" / "active.json").symlink_to(folder / "elsewhere")
    with pytest.raises(BadBundle):
        Store(folder).record("hard")


def test_there_are_not_too_many_versions(folder: Path) -> None:
    for version in range(1, MAX_VERSIONS + 2):
        (folder / "easy_2-b" / str(version)).mkdir()
    with pytest.raises(BadBundle, match=f"at most {MAX_VERSIONS}"):
        Store(folder).versions("easy_2-b")
