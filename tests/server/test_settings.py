from __future__ import annotations

from pathlib import Path

import pytest

from server.settings import Settings


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_loopback_needs_no_token(host: str) -> None:
    assert Settings(bundle=Path("b"), host=host).token is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.2", "example.org", ""])
def test_any_other_address_needs_a_token_or_an_explicit_word(host: str) -> None:
    with pytest.raises(ValueError, match="token"):
        Settings(bundle=Path("b"), host=host)
    assert Settings(bundle=Path("b"), host=host, token="t" * 16).host == host
    with pytest.raises(ValueError, match="at least 16"):
        Settings(bundle=Path("b"), host=host, token="t" * 15)
    assert Settings(bundle=Path("b"), host=host, insecure_no_token=True).host == host


def test_one_folder_or_a_store() -> None:
    for neither_nor_both in ({}, {"bundle": Path("b"), "store": Path("s")}):
        with pytest.raises(ValueError, match="either a bundle or a store"):
            Settings(**neither_nor_both)
    assert Settings(store=Path("s")).bundle is None


def test_tokens_come_from_files_too(tmp_path: Path) -> None:
    token, admin = tmp_path / "token", tmp_path / "admin"
    token.write_text("the engines' token\n")
    admin.write_text("operators' token")
    assert Settings(bundle=Path("b"), token="t").tokens() == ("t", None)
    settings = Settings(bundle=Path("b"), host="0.0.0.0", token_file=token, admin_token_file=admin)
    assert settings.tokens() == ("the engines' token", "operators' token")
    with pytest.raises(ValueError, match="not both"):
        Settings(bundle=Path("b"), token="t", token_file=token)
    with pytest.raises(OSError, match="none"):
        Settings(bundle=Path("b"), token_file=tmp_path / "none").tokens()
    for content in (
        b"",
        b"\n",
        b"x" * 15,
        b"two\nlines of a token\n",
        b"x" * 1025,
        b"\xff" * 20,
        b"a token with a\0 in it",
    ):
        token.write_bytes(content)
        with pytest.raises(ValueError, match=r"token|utf-8"):
            settings.tokens()


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_bots": 0},
        {"max_connections": 0},
        {"max_queue": 0},
        {"max_loaded": 0},
        {"idle_ttl_s": 0.0},
        {"drain_s": -1.0},
        {"frame_deadline_s": float("nan")},
        {"idle_ttl_s": float("inf")},
        {"port": 65536},
        {"tcp_port": -1},
        {"token": ""},
        {"inline_us": -1.0},
    ],
)
def test_limits_are_positive(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"must|expected"):
        Settings(bundle=Path("b"), **wrong)


@pytest.mark.parametrize("spin_us", [-1.0, 10_001.0, float("nan")])
def test_a_spin_is_short(spin_us: float) -> None:
    with pytest.raises(ValueError, match="spin_us"):
        Settings(bundle=Path("b"), spin_us=spin_us)


@pytest.mark.parametrize("process", ["", "P1", "p-1", "p" * 17, "p1\n"])
def test_a_process_is_named_by_letters_and_digits(process: str) -> None:
    with pytest.raises(ValueError, match="process"):
        Settings(bundle=Path("b"), process=process)
    assert Settings(bundle=Path("b"), process="p1").process == "p1"


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"stuck_after_s": 0.0}, "stuck_after_s"),
        ({"otlp_endpoint": "collector:4318"}, "expected a URL"),
        ({"otlp_every_s": 0.0}, "otlp_every_s"),
        ({"otlp_every_s": float("nan")}, "otlp_every_s"),
    ],
)
def test_what_cannot_be_watched_is_refused(wrong: dict[str, float | str], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Settings(bundle=Path("b"), **wrong)
