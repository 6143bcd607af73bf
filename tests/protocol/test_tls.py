"""The client over TLS, to a proxy before a real server: with the certificate that it expects, and with others."""

from __future__ import annotations

import asyncio
import datetime
import ipaddress
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from protocol.client import BotClient
from protocol.resuming import ResumingClient
from tests.bundles import make_bundle
from tests.server.serving import Served, free_numbers, play, same, serve

SCHEMES = {"https": "http", "wss": "http", "tcps": "tcp"}


def certificate(folder: Path, *names: x509.GeneralName) -> tuple[Path, Path]:
    """A self-signed certificate for these names and its key, as PEM files."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "bots")])
    now = datetime.datetime.now(datetime.UTC)
    signed = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    folder.mkdir()
    (folder / "cert.pem").write_bytes(signed.public_bytes(Encoding.PEM))
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (folder / "key.pem").write_bytes(private)
    return folder / "cert.pem", folder / "key.pem"


class Proxy:
    """Ends TLS and hands on what is within, in a thread of its own."""

    def __init__(self, certificate: tuple[Path, Path], target: str) -> None:
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.load_cert_chain(*certificate)
        self._target = urlsplit(target)
        self._writers: set[asyncio.StreamWriter] = set()
        self._started, self.port = threading.Event(), 0

    def run(self) -> None:
        asyncio.run(self._main())

    async def _main(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        # A client that is between two requests does not read, so it does not say goodbye: half a minute, by default.
        server = await asyncio.start_server(self._serve, "127.0.0.1", 0, ssl=self._context, ssl_shutdown_timeout=0.1)
        self.port = server.sockets[0].getsockname()[1]
        self._started.set()
        await self._stop.wait()
        server.close()
        self._close_all()
        while self._writers:
            await asyncio.sleep(0.01)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        inner_reader, inner_writer = await asyncio.open_connection(self._target.hostname, self._target.port)
        await asyncio.gather(_pipe(reader, inner_writer), _pipe(inner_reader, writer))
        self._writers.discard(writer)

    def _close_all(self) -> None:
        for writer in tuple(self._writers):
            writer.close()

    def drop(self) -> None:
        """Close every open socket, and return once they are."""
        self._loop.call_soon_threadsafe(self._close_all)
        while self._writers:
            threading.Event().wait(0.01)

    def wait(self) -> None:
        self._started.wait()

    def end(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)


async def _pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    writer.close()
    with suppress(OSError):
        await writer.wait_closed()


@contextmanager
def before(served: Served, door: str, certificate: tuple[Path, Path]) -> Iterator[Proxy]:
    proxy = Proxy(certificate, served.addresses[door])
    thread = threading.Thread(target=proxy.run)
    thread.start()
    proxy.wait()
    try:
        yield proxy
    finally:
        proxy.end()
        thread.join()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("tls")
    with serve(make_bundle(folder / "tiny"), folder / "s") as running:
        yield running


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    address = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
    return certificate(tmp_path_factory.mktemp("certificate") / "own", address)


@pytest.mark.parametrize("scheme", list(SCHEMES))
def test_bots_play_over_tls_as_without(served: Served, own: tuple[Path, Path], scheme: str) -> None:
    with (
        before(served, SCHEMES[scheme], own) as proxy,
        BotClient(f"{scheme}://127.0.0.1:{proxy.port}", cafile=own[0]) as secret,
        BotClient(served.addresses["unix"]) as plain,
    ):
        played = [
            play(client, client.hello().features, client.start(2, seeds=[1, 2]), range(4)) for client in (secret, plain)
        ]
        assert same(*played)


@pytest.mark.parametrize("scheme", list(SCHEMES))
def test_a_server_that_cannot_prove_who_it_is_is_told_nothing(
    served: Served, own: tuple[Path, Path], tmp_path: Path, scheme: str
) -> None:
    other = certificate(tmp_path / "other", x509.DNSName("bots.example"))
    with before(served, SCHEMES[scheme], own) as proxy, before(served, SCHEMES[scheme], other) as misnamed:
        for port, cafile in ((proxy.port, None), (proxy.port, other[0]), (misnamed.port, other[0])):
            client = BotClient(f"{scheme}://127.0.0.1:{port}", cafile=cafile)
            with pytest.raises(ssl.SSLCertVerificationError):
                client.hello(token="secret")
            client.close()


def test_a_query_is_sent_again_where_the_socket_had_closed(served: Served, own: tuple[Path, Path]) -> None:
    with before(served, "http", own) as proxy, BotClient(f"https://127.0.0.1:{proxy.port}", cafile=own[0]) as client:
        table, bots = client.hello().features, client.start(1)
        for frame in range(3):
            proxy.drop()
            assert client.query(bots, frame, free_numbers(table, 1, frame), np.zeros(1)).frame == frame


def test_bots_are_resumed_over_tls(served: Served, own: tuple[Path, Path]) -> None:
    with (
        before(served, "tcp", own) as proxy,
        ResumingClient(f"tcps://127.0.0.1:{proxy.port}", cafile=own[0]) as client,
    ):
        table, bots = client.hello().features, client.start(1)
        for frame in range(2):
            proxy.drop()
            assert client.query(bots, frame, free_numbers(table, 1, frame), np.zeros(1)).frame == frame
        assert client.resumed == 2


def test_what_names_no_door_is_refused() -> None:
    for url in ("https://127.0.0.1", "tls://127.0.0.1:1", "unixs:///x", "tcps://127.0.0.1:1/path", "https:///x"):
        with pytest.raises(ValueError, match="is none of"):
            BotClient(url)
