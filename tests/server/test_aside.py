"""Log lines never wait for whoever reads them."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

import pytest

from server.aside import Aside
from tests.training.test_sink import most_bytes_of_a_file


@pytest.fixture
def pipe() -> Iterator[tuple[FileIO, FileIO]]:
    reader, writer = os.pipe()
    with FileIO(reader, "r") as read, FileIO(writer, "w") as written:
        yield read, written


def fill(writer: FileIO) -> int:
    """Bytes that went into the pipe until it was full."""
    os.set_blocking(writer.fileno(), False)
    size = 0
    while (taken := writer.write(b"x" * 4096)) is not None:
        size += taken
    os.set_blocking(writer.fileno(), True)
    return size


def test_every_line_is_there_in_order_at_the_end(tmp_path: Path) -> None:
    lines = [f"{i} ü \udc80\n" for i in range(900)]
    with (tmp_path / "log").open("wb") as file:
        with Aside(file.fileno()) as aside:
            for line in lines:
                aside.write(line)
        assert not aside.isatty()
    assert (tmp_path / "log").read_bytes() == "".join(lines).encode(errors="backslashreplace")


def test_a_full_pipe_stops_nobody_and_what_was_lost_is_said(
    pipe: tuple[FileIO, FileIO], caplog: pytest.LogCaptureFixture
) -> None:
    reader, writer = pipe
    stuffed = fill(writer)
    with Aside(writer.fileno(), limit=10) as aside:
        for i in range(1000):
            aside.write(f"{i}\n")  # would wait for ever
        got: list[bytes] = []
        thread = threading.Thread(target=lambda: got.append(reader.readall()))
        thread.start()
    writer.close()
    thread.join()
    written = [int(line) for line in got[0][stuffed:].split()]
    assert written[:10] == list(range(10))
    assert len(written) <= 11  # ten in the queue, one in hand
    [lost] = [record for record in caplog.records if record.message == "log lines lost"]
    assert lost.lines == 1000 - len(written)


def test_it_ends_though_nobody_reads(pipe: tuple[FileIO, FileIO]) -> None:
    reader, writer = pipe
    fill(writer)
    with Aside(writer.fileno(), limit=2) as aside:
        for i in range(10):
            aside.write(f"{i}\n")
    reader.close()  # and a reader that has gone ends the writer's wait, for pytest's sake
    aside._writer.join(10.0)


def test_a_reader_that_has_gone_costs_the_lines_only(pipe: tuple[FileIO, FileIO]) -> None:
    reader, writer = pipe
    reader.close()
    with Aside(writer.fileno()) as aside:
        for i in range(10):
            aside.write(f"{i}\n")
    assert not aside._writer.is_alive()


def test_a_pipe_that_does_not_block_is_waited_for(pipe: tuple[FileIO, FileIO]) -> None:
    reader, writer = pipe
    stuffed = fill(writer)
    os.set_blocking(writer.fileno(), False)
    with Aside(writer.fileno()) as aside:
        for i in range(100):
            aside.write(f"{i} {'x' * 5000}\n")
        got: list[bytes] = []
        thread = threading.Thread(target=lambda: got.append(reader.readall()))
        thread.start()
        while not aside._lines.empty():
            time.sleep(0.001)
    writer.close()
    thread.join()
    assert [int(line.split()[0]) for line in got[0][stuffed:].splitlines()] == list(range(100))


def test_a_disk_that_was_full_costs_lines_that_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with (tmp_path / "log").open("wb") as file, most_bytes_of_a_file(250), Aside(file.fileno()) as aside:
        for i in range(10):
            aside.write(f"{i} {'x' * 97}\n")
        while not aside._lines.empty():
            time.sleep(0.001)
        file.truncate(0)  # somebody makes room
        os.lseek(file.fileno(), 0, os.SEEK_SET)
        aside.write("after\n")
    assert "after" in (tmp_path / "log").read_text().splitlines()
    assert sum(record.lines for record in caplog.records if record.message == "log lines lost") == 8
