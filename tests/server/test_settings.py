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
    assert Settings(bundle=Path("b"), host=host, token="t").host == host
    assert Settings(bundle=Path("b"), host=host, insecure_no_token=True).host == host


@pytest.mark.parametrize(
    "wrong",
    [{"max_bots": 0}, {"max_connections": 0}, {"max_queue": 0}, {"idle_ttl_s": 0.0}, {"drain_s": -1.0}, {"token": ""}],
)
def test_limits_are_positive(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must"):
        Settings(bundle=Path("b"), **wrong)


@pytest.mark.parametrize("process", ["", "P1", "p-1", "p" * 17, "p1\n"])
def test_a_process_is_named_by_letters_and_digits(process: str) -> None:
    with pytest.raises(ValueError, match="process"):
        Settings(bundle=Path("b"), process=process)
    assert Settings(bundle=Path("b"), process="p1").process == "p1"
