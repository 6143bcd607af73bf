"""One tiny bundle for the whole room, an engine that plays any bots, and a policy that can be spoilt."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from bot_runtime.batch import Batch
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.policy import Policy
from bot_runtime.turns import Actions, Queries
from protocol.features import FeatureTable
from tests.bundles import make_bundle


class Engine:
    """Plays `bots`: the values of frame f depend on the seed and f only, never on what was asked or played before."""

    def __init__(self, bots: Bots, seed: int = 0) -> None:
        self.bots = bots
        self.table: FeatureTable = bots.bundle.manifest.features
        self.seed = seed

    def free(self, frame: int, n_bots: int) -> np.ndarray:
        return self._draw(frame, 1, n_bots, self.table.free_range)

    def costly(self, frame: int, n_bots: int) -> np.ndarray:
        return self._draw(frame, 2, n_bots, self.table.costly_range)

    def rewards(self, frame: int, n_bots: int) -> np.ndarray:
        return np.random.default_rng([self.seed, frame, 3]).normal(0.5, 0.5, n_bots)

    def ask(self, handles: np.ndarray, frame: int, **options: object) -> Queries:
        n_bots = handles.size
        return self.bots.request_queries(
            handles, frame, self.free(frame, n_bots), self.rewards(frame, n_bots), **options
        )

    def submit(self, handles: np.ndarray, frame: int, queries: Queries) -> Actions:
        costly = self.costly(frame, handles.size)
        return self.bots.submit_features(handles, frame, queries.query_NM, costly)

    def turn(self, handles: np.ndarray, frame: int) -> Actions:
        return self.submit(handles, frame, self.ask(handles, frame))

    def play(self, handles: np.ndarray, frames: range) -> list[bytes]:
        """The bytes of every query and action: equal lists mean byte-identical play."""
        played = []
        for frame in frames:
            queries = self.ask(handles, frame)
            actions = self.submit(handles, frame, queries)
            played.append(queries.query_NM.tobytes() + queries.probs_NM.tobytes() + actions.action_NA.tobytes())
        return played

    def _draw(self, frame: int, stream: int, n_bots: int, limits: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        low, high = (np.clip(limit, -20.0, 20.0) for limit in limits)
        random = np.random.default_rng([self.seed, frame, stream])
        return random.uniform(low, high, (n_bots, low.size)).astype(np.float32)


class Poisoned:
    """A policy whose output is spoilt for some rows of the batch, for as long as the test says."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.probs: dict[int, float] = {}
        self.step: dict[int, tuple[str, float]] = {}

    def query_probs(self, batch: Batch) -> None:
        self._policy.query_probs(batch)
        for row, number in self.probs.items():
            batch.probs_NM[row, -1] = number

    def act(self, batch: Batch) -> None:
        self._policy.act(batch)
        for row, (field, number) in self.step.items():
            kind = {"keys": 0, "values": 1}.get(field)
            (getattr(batch, field)[row] if kind is None else batch.tokens[:, kind, row])[..., -1] = number


@pytest.fixture(scope="session")
def bundle_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


@pytest.fixture
def copy(bundle_path: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(bundle_path, tmp_path / "copy"))


@pytest.fixture(scope="session")
def bundle(bundle_path: Path) -> Bundle:
    return Bundle.load(bundle_path)


@pytest.fixture(scope="session")
def memoryless(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """A bundle without a context."""
    return Bundle.load(make_bundle(tmp_path_factory.mktemp("bundles") / "none", context_length=1, method="rcbc"))


@pytest.fixture(scope="session")
def conditioned(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """A bundle that serves every budget; without one, it is asked for a quarter of the full cost and has no limit."""
    return Bundle.load(make_bundle(tmp_path_factory.mktemp("bundles") / "any", target_cost=0.25, budget=1.0))


@pytest.fixture
def engine(bundle: Bundle) -> Engine:
    return Engine(Bots(bundle, max_bots=8))


@pytest.fixture
def poisoned(engine: Engine) -> Poisoned:
    engine.bots._policy = Poisoned(engine.bots._policy)
    return engine.bots._policy
