"""Imports point one way, as docs/architecture.md draws them, and what runs in a frame runs without torch."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ARROWS = {  # room -> rooms that it may import, besides itself
    "protocol": set(),
    "bot_runtime": {"protocol"},
    "server": {"bot_runtime", "protocol"},
    "training": {"bot_runtime", "protocol"},
    "game": {"protocol"},
    "benchmarks": {"protocol", "bot_runtime", "server", "training", "game"},
}
RUN_TIME = ("protocol", "bot_runtime", "server", "game")
HEAVY = {"torch", "onnx", "tensorboard", "ray"}
PROTOCOL_NEEDS = {"msgspec", "msgpack", "numpy"} | sys.stdlib_module_names
ONLY_HERE = {Path("protocol/websocket.py"): {"websockets"}}  # loaded when a client asks for that transport
FILES = [file for room in ARROWS for file in sorted((ROOT / room).rglob("*.py"))]


def imported(source: str, package: str) -> set[str]:
    """Every module that `source` imports, at any depth and under any condition, as absolute dotted names."""
    modules = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            modules |= {module} if node.module else {f"{module}.{alias.name}" for alias in node.names}
    return modules


def forbidden(room: str, modules: set[str]) -> set[str]:
    tops = {module.split(".")[0] for module in modules}
    wrong = tops & (set(ARROWS) | {"tests"}) - ARROWS[room] - {room}
    if room in RUN_TIME:
        wrong |= tops & HEAVY
    if room == "protocol":
        wrong |= tops - PROTOCOL_NEEDS - {room}
    return wrong


def test_every_package_is_a_room() -> None:
    packages = {init.parent.name for init in ROOT.glob("*/__init__.py")} - {"tests"}
    assert packages == set(ARROWS)


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_imports_point_one_way(file: Path) -> None:
    relative = file.relative_to(ROOT)
    modules = imported(file.read_text(encoding="utf-8"), ".".join(relative.parent.parts))
    wrong = forbidden(relative.parts[0], modules) - ONLY_HERE.get(relative, set())
    assert not wrong, f"{relative} may not import these"


@pytest.mark.parametrize(
    ("room", "source", "wrong"),
    [
        ("protocol", "from server import app", {"server"}),
        ("protocol", "import fastapi", {"fastapi"}),
        ("bot_runtime", "def f():\n    import server.app as s", {"server"}),
        ("bot_runtime", "try:\n    import torch.nn\nexcept ImportError:\n    pass", {"torch"}),
        ("bot_runtime", "import onnxruntime, onnx", {"onnx"}),
        ("game", "from bot_runtime.bots import Bots", {"bot_runtime"}),
        ("training", "from server.app import app; import game.env", {"server", "game"}),
        ("server", "from ..training import train", {"training"}),
        ("server", "from . import worker\nfrom bot_runtime import bots\nimport onnxruntime", set()),
        ("training", "import torch, onnx, protocol.features", set()),
        ("game", "from tests import bundles", {"tests"}),
    ],
)
def test_the_walk_finds_what_it_should(room: str, source: str, wrong: set[str]) -> None:
    assert forbidden(room, imported(source, f"{room}")) == wrong


def test_client_and_server_decode_independently() -> None:
    """Two implementations meet in every test only as long as neither borrows the other's."""
    client, server = ("client", "replies", "transport", "vectors/__main__"), ("codec", "arrays", "messages")
    for names, foreign in ((client, {"msgspec", "protocol.codec", "protocol.arrays"}), (server, {"msgpack"})):
        for name in names:
            source = (ROOT / "protocol" / f"{name}.py").read_text(encoding="utf-8")
            assert not imported(source, "protocol") & foreign, name


@pytest.mark.parametrize("room", RUN_TIME)
def test_run_time_rooms_import_without_torch(room: str) -> None:
    """In a process of its own, where importing torch or onnx fails as it does on a machine without them."""
    names = [
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for file in FILES
        if file.relative_to(ROOT).parts[0] == room
    ]
    modules = [name.removesuffix(".__init__") for name in names if not name.endswith("__main__")]
    program = (
        "import importlib, sys\n"
        f"for heavy in {sorted(HEAVY)}: sys.modules[heavy] = None\n"
        f"for module in {modules}: importlib.import_module(module)\n"
    )
    finished = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
