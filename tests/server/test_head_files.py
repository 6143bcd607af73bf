"""The head's files from a real server: what the hash names, whole, or an error; and they run as the server's own."""

from __future__ import annotations

import http.server
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from bot_runtime.head import Head
from bot_runtime.head_files import HeadFiles
from protocol.client import BotClient
from protocol.errors import BadBundle, NoBundle, NoRoute, Unauthorized
from protocol.fetching import fetch
from protocol.transport import ReplyError
from tests.protocol.golden import TABLE
from tests.server.serving import Served, free_numbers, http_request, serve

TOKEN = "a-token-of-engines-ü"


def test_what_is_fetched_asks_for_what_the_server_asks_for(served: Served, bundle: Path) -> None:
    with BotClient(served.addresses["tcp"]) as client:
        welcome = client.hello()
        assert welcome.bundle_sha256 is not None
        files = HeadFiles.fetch(served.addresses["http"], welcome.bundle_sha256)
        assert files.acquisition == (bundle / "acquisition.onnx").read_bytes()
        head, bots = Head(files.manifest, files.acquisition, seeds=[7, 8]), client.start(2, seeds=[7, 8])
        for frame in range(4):
            free = free_numbers(TABLE, 2, frame)
            own = head.ask(frame, free)
            theirs = client.query(bots, frame, free)
            assert np.array_equal(own.query_NM, theirs.queries)
            actions = client.act(bots, frame, theirs.queries, np.zeros((2, TABLE.n_costly), np.float32), hidden=True)
            head.keep(actions.hidden, actions.turns)


def test_the_files_come_whole_and_may_be_kept_for_ever(served: Served, bundle: Path) -> None:
    with BotClient(served.addresses["http"]) as client:
        folder = f"/v1/bundles/{client.hello().bundle_sha256}"
    for name in ("manifest.json", "acquisition.onnx"):
        answer = http_request(served.addresses["http"], "GET", f"{folder}/{name}")
        assert (answer.status, answer.body) == (200, (bundle / name).read_bytes())
        assert "immutable" in answer.headers["cache-control"]
        assert "transfer-encoding" not in answer.headers
    # The trunk stays with the server: no engine needs it.
    assert http_request(served.addresses["http"], "GET", f"{folder}/action.onnx").status == 404
    assert http_request(served.addresses["http"], "POST", f"{folder}/manifest.json", b"{}").status == 405


@pytest.mark.parametrize("sha256", ["0" * 64, "hard", "..%2Fetc"])
def test_a_hash_that_nothing_in_memory_has_is_no_bundle(served: Served, sha256: str) -> None:
    with pytest.raises((NoBundle, NoRoute)):
        HeadFiles.fetch(served.addresses["http"], sha256)


def test_the_token_is_needed_where_there_is_one(bundle: Path, tmp_path: Path) -> None:
    (tmp_path / "token").write_text(TOKEN + "\n")
    with serve(bundle, tmp_path / "s", token_file=tmp_path / "token") as running:
        url = running.addresses["http"]
        with BotClient(url) as client:
            sha256 = client.hello(token=TOKEN).bundle_sha256
        assert sha256 is not None
        assert HeadFiles.fetch(url, sha256, token=TOKEN).manifest.features == TABLE
        for wrong in (None, TOKEN + "x"):
            with pytest.raises(Unauthorized):
                HeadFiles.fetch(url, sha256, token=wrong)


@contextmanager
def answering(*answers: tuple[int, bytes, int | None]) -> Iterator[str]:
    """A server that answers each request with the next status and body, and announces other lengths where told."""
    left = list(answers)

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            status, body, announced = left.pop(0)
            self.send_response(status)
            self.send_header("Content-Length", str(len(body) if announced is None else announced))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_server_that_sends_another_file_is_not_believed(served: Served, bundle: Path) -> None:
    with BotClient(served.addresses["http"]) as client:
        sha256 = str(client.hello().bundle_sha256)
    manifest, graph = ((bundle / name).read_bytes() for name in ("manifest.json", "acquisition.onnx"))
    other = graph[:-1] + bytes([graph[-1] ^ 1])
    for answers in ([(200, manifest + b" ", None)], [(200, manifest, None), (200, other, None)]):
        with answering(*answers) as url, pytest.raises(BadBundle, match="sha256"):
            HeadFiles.fetch(url, sha256)


@pytest.mark.parametrize(
    ("answer", "match"),
    [
        ((200, b"x" * 11, None), "more than 10"),
        ((200, b"x" * 5, 9), "early"),
        ((302, b"", None), "status 302"),
        ((500, b"{", None), "status 500"),
    ],
)
def test_answers_that_are_not_the_whole_file_are_errors(answer: tuple[int, bytes, int | None], match: str) -> None:
    with answering(answer) as url, pytest.raises(ReplyError, match=match):
        fetch(url, "/file", 10)


def test_only_http_is_fetched_from() -> None:
    for url in ("file:///etc/passwd", "ftp://host:1", "http://host", "http://host:80/elsewhere"):
        with pytest.raises(ValueError, match="neither"):
            fetch(url, "/file", 10)
