"""The runtime does not report its use to anyone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.bundles import make_bundle


def test_loading_and_running_a_bundle_leaves_no_device_identifier(tmp_path: Path) -> None:
    make_bundle(tmp_path / "tiny")
    load = f"Bundle.load(Path({str(tmp_path)!r}) / 'tiny')"
    code = f"from pathlib import Path; from bot_runtime.bundle import Bundle; {load}"
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    subprocess.run([sys.executable, "-c", code], check=True, env={**environment, "HOME": str(tmp_path)})
    assert [path.name for path in tmp_path.iterdir()] == ["tiny"]
