from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.clients.engine import build


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The C client's library, its example and the test programs, all under the address and undefined sanitizers."""
    missing = [program for program in ("cc", "make", "ar") if shutil.which(program) is None]
    if missing:
        pytest.skip(f"the C client cannot be built: no {', '.join(missing)} here")
    return build(tmp_path_factory.mktemp("c"))
