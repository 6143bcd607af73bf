from __future__ import annotations

import pytest

from protocol.errors import Unauthorized
from server.tokens import bearer, check


def test_a_token_is_the_same_or_it_is_not() -> None:
    check("s3cret é", "s3cret é")
    for wrong in (None, "", "s3cret", "s3cret e", "s3cret é ", "S3cret é"):
        with pytest.raises(Unauthorized):
            check(wrong, "s3cret é")


def test_the_token_of_a_header_is_utf_8_that_http_reads_as_latin_1() -> None:
    assert bearer("Bearer s3cret") == bearer("bearer s3cret") == "s3cret"
    assert bearer("Bearer " + "é".encode().decode("latin-1")) == "é"
    for nothing in ("", "Basic s3cret", "s3cret", "Bearer \xe9", "Bearer €"):
        assert bearer(nothing) is None
