"""Which files are read as what: by suffix and by what they begin with."""

from __future__ import annotations

import gzip
import io
import os
import pickle
import zipfile
from itertools import chain
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.training.logs import WRITERS, column_map, rows, write_csv, write_parquet
from training.rows import SourceError
from training.source import read_rows


class Trap:
    """What a pickle of it would do."""

    def __reduce__(self) -> tuple:
        return (os._exit, (7,))


def zipped() -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as file:
        file.writestr("a", "b")
    return data.getvalue()


def hdf5() -> bytes:
    data = io.BytesIO()
    with h5py.File(data, "w") as file:
        file["a"] = [1]
    return data.getvalue()


def array() -> bytes:
    data = io.BytesIO()
    np.save(data, np.zeros(3))
    return data.getvalue()


FOREIGN = {
    "a pickle": pickle.dumps(Trap()),
    "a zip archive": zipped(),
    "HDF5": hdf5(),
    "a numpy array": array(),
    "gzip": gzip.compress(b"match,tick\n"),
    "UTF-16 text": "match,tick\n".encode("utf-16"),
}


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("kind", FOREIGN)
def test_refuses_other_content(tmp_path: Path, suffix: str, kind: str) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(FOREIGN[kind])
    with pytest.raises(SourceError, match=rf"log{suffix} begins like {kind}, expected what its suffix says"):
        read_rows(path, column_map())


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_refuses_parquet_under_another_suffix(tmp_path: Path, suffix: str) -> None:
    path = write_parquet(tmp_path / f"log{suffix}", rows(3))
    with pytest.raises(SourceError, match="begins like Parquet"):
        read_rows(path, column_map())


def test_refuses_text_as_parquet(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "log.parquet", rows(3))
    with pytest.raises(SourceError, match="begins like text or nothing"):
        read_rows(path, column_map())


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_a_pickle_of_plain_characters_is_read_as_text(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(pickle.dumps(Trap(), protocol=0))
    with pytest.raises(SourceError, match="line 1"):
        list(read_rows(path, column_map()))


@pytest.mark.parametrize("name", ["log.pkl", "log.npz", "log.hdf5", "log.json", "log.csv.gz", "log"])
def test_refuses_other_suffixes(tmp_path: Path, name: str) -> None:
    path = write_csv(tmp_path / name, rows(3))
    with pytest.raises(SourceError, match=r"expected one of \.csv, \.jsonl, \.parquet"):
        read_rows(path, column_map())


def test_refuses_what_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "log.csv").mkdir()
    for name in ("log.csv", "other.csv"):
        with pytest.raises(SourceError, match=f"{name} is not a file"):
            read_rows(tmp_path / name, column_map())


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_batch_is_read_when_it_is_asked_for(tmp_path: Path, suffix: str) -> None:
    path = WRITERS[suffix](tmp_path / f"log{suffix}", rows(2500))
    batches = read_rows(path, column_map())
    sizes, shares = zip(*((len(batch.rows), batch.done) for batch in batches), strict=True)
    assert sizes[:2] == (1024, 1024)
    assert sum(sizes) == 2500
    assert list(shares) == sorted(shares)
    assert 0.0 < shares[0] < 0.5
    assert shares[-1] == 1.0


@pytest.mark.parametrize(
    ("suffix", "where"), [(".csv", "line 4"), (".jsonl", "line 3"), (".parquet", r"row 2 (counted from 0)")]
)
def test_rows_know_where_they_stand(tmp_path: Path, suffix: str, where: str) -> None:
    path = WRITERS[suffix](tmp_path / f"log{suffix}", rows(5))
    read = list(chain.from_iterable(batch.rows for batch in read_rows(path, column_map())))
    assert read[2].where == f"{path}: {where}"
    assert list(read[2].cells) == ["m0", 12, False, False, 98.0, 0.25, 1.0, False, 0.5]


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_missing_column_is_named_with_those_that_are_there(tmp_path: Path, suffix: str) -> None:
    path = WRITERS[suffix](tmp_path / f"log{suffix}", rows(5))
    with pytest.raises(SourceError, match=r"no column 'points'; there are 'match', 'tick', 'health', .*'stopped'"):
        list(read_rows(path, column_map(reward="points")))
