from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.clients.engine import SANITIZED, build


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The C client's library, its example and the test programs, all under the address and undefined sanitizers."""
    missing = [program for program in ("cc", "make", "ar") if shutil.which(program) is None]
    if missing:
        pytest.skip(f"the C client cannot be built: no {', '.join(missing)} here")
    folder = tmp_path_factory.mktemp("c")
    (folder / "empty.c").write_text("int main(void) { return 0; }\n")
    tried = subprocess.run(["cc", *SANITIZED, folder / "empty.c", "-o", folder / "empty"], capture_output=True)
    if tried.returncode != 0:
        pytest.skip("the C compiler here has no address and undefined sanitizers")
    return build(folder)
