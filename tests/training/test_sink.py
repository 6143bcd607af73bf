"""What HDF5 writes through a sink is what it writes to a file; a write that fails is told by `check` alone."""

from __future__ import annotations

import errno
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest

from training.sink import Sink


@contextmanager
def most_bytes_of_a_file(size: int) -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))  # Python ignores SIGXFSZ: writes fail
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def write(sink: Sink, values: np.ndarray) -> None:
    with h5py.File(sink, "w") as file:
        for i in range(20):
            file.create_dataset(f"group/{i}", data=values + i, compression="lzf", chunks=(100,))


def test_hdf5_reads_what_it_wrote(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random(5000)
    sink = Sink(tmp_path / "a.hdf5")
    write(sink, values)
    sink.check()
    sink.close()
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert sorted(map(int, file["group"])) == list(range(20))
        np.testing.assert_array_equal(file["group/7"], values + 7)


@pytest.mark.parametrize("size", [0, 100, 5_000, 300_000])
def test_a_full_disk_is_an_error_and_no_signal(tmp_path: Path, size: int) -> None:
    sink = Sink(tmp_path / "a.hdf5")
    with most_bytes_of_a_file(size):
        write(sink, np.random.default_rng(0).random(5000))
    with pytest.raises(OSError, match="too large") as raised:
        sink.check()
    assert raised.value.errno == errno.EFBIG
    sink.close()
    assert (tmp_path / "a.hdf5").stat().st_size <= size


def test_no_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.hdf5").write_text("mine")
    with pytest.raises(FileExistsError):
        Sink(tmp_path / "a.hdf5")
