"""The catalogue: what there is to serve, on disk and in memory, and which version of it is active.

This module knows nothing about HTTP or tokens. It runs on the event loop; reading goes to other threads, verifying to
another process, and only the exchange of one serving for another to the worker, so that no frame waits for any of it.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

from bot_runtime.bundle import Bundle
from bot_runtime.signature import Keys
from protocol.errors import BadBundle, NoBundle, NotReady, ProtocolError
from server.logs import logger
from server.serving import Serving
from server.servings import Servings
from server.store import Content, Record, Store
from server.verifier import verify
from server.worker import Worker

__all__ = ["Catalogue"]

_MAX_VERIFIED = 256
_log = logger(__name__)


class Catalogue:
    """Activates versions of a store's bundles, one at a time. `keys` are files of those who may sign, none: anyone."""

    def __init__(
        self, store: Store, servings: Servings, worker: Worker, *, max_bots: int, keys: Sequence[Path] = ()
    ) -> None:
        self.store = store
        self._servings = servings
        self._worker = worker
        self._max_bots = max_bots
        self._key_paths = tuple(keys)
        self._keys = Keys.read(keys) if keys else None
        self._verified: dict[str, None] = {}  # contents that passed, in the order in which they did
        self._is_busy = False

    def open(self) -> None:
        """Load and activate, of each name, what was active last, else the highest version.

        For the start, before anything is served: it blocks. Raises BadBundle, OSError, and ValueError where the store
        is empty or has more names than there may be bundles in memory.
        """
        for name in self.store.names():
            record = self.store.record(name)
            versions = self.store.versions(name)
            if record is None and not versions:
                continue
            if len(list(self._servings)) == self._servings.max_loaded:
                raise ValueError(f"--max-loaded is {self._servings.max_loaded}, and the store has more names")
            version = versions[-1] if record is None else record.active.version
            bundle = Bundle.load(self.store.path(name, version), keys=self._keys)
            _check(bundle, name, version, None if record is None else record.active.sha256)
            self._remember(bundle.sha256)
            self._servings.activate(Serving(bundle, max_bots=self._max_bots, version=version))
            if record is None:
                self.store.write(name, Record(Content(version, bundle.sha256)))
        if not list(self._servings):
            raise ValueError("the store is empty: expected NAME/VERSION/manifest.json in it")

    async def activate(self, name: str, version: int, sha256: str | None = None) -> Record:
        """Serve this version to new connections, and to bots that are started on connections without any.

        `sha256` is what its manifest must have, where the caller wants to be sure. Activating what is active changes
        nothing. Raises NoBundle, BadBundle, NotReady, OSError; what was serving then goes on.
        """
        async with self._alone():
            record = await asyncio.to_thread(self.store.record, name)
            return await self._exchange(name, version, sha256, record)

    async def rollback(self, name: str) -> Record:
        """Activate again what was active before; a second time, what it was rolled back from. Raises as `activate`."""
        async with self._alone():
            record = await asyncio.to_thread(self.store.record, name)
            if record is None or record.previous is None:
                raise NoBundle(f"no version of {name} was active before")
            return await self._exchange(name, record.previous.version, record.previous.sha256, record)

    @asynccontextmanager
    async def _alone(self) -> AsyncIterator[None]:
        if self._is_busy:
            raise NotReady("another version is being activated", retry_after_s=1.0)
        self._is_busy = True
        try:
            yield
        finally:
            self._is_busy = False

    async def _exchange(self, name: str, version: int, sha256: str | None, record: Record | None) -> Record:
        active = self._servings.active(name)
        if record is not None and active is not None and active.version == record.active.version == version:
            _check(active.bots.bundle, name, version, sha256)
            return record
        try:
            serving = await self._load(name, version, sha256)
        except BadBundle as error:
            _log.warning("bundle refused", bundle=name, version=version, why=error.detail)
            raise
        changed = Record(Content(version, serving.sha256), None if record is None else record.active)
        # Recorded first: what cannot be recorded is not served, and what was recorded has been verified.
        await asyncio.to_thread(self.store.write, name, changed)
        try:
            await self._worker.run(partial(self._servings.activate, serving))
        except ProtocolError:
            await asyncio.to_thread(self.store.write, name, record)
            raise
        return changed

    async def _load(self, name: str, version: int, sha256: str | None) -> Serving:
        for serving in self._servings:
            if (serving.name, serving.version) == (name, version):  # connections hold it still
                _check(serving.bots.bundle, name, version, sha256)
                return serving
        path = await asyncio.to_thread(self.store.path, name, version)
        bundle = await asyncio.to_thread(Bundle.read, path, keys=self._keys)
        _check(bundle, name, version, sha256)
        if bundle.sha256 not in self._verified:
            if await verify(path, self._key_paths) != bundle.sha256:
                raise BadBundle(f"version {version} of {name} was changed while it was being verified")
            self._remember(bundle.sha256)
        return await asyncio.to_thread(Serving, bundle, max_bots=self._max_bots, version=version)

    def _remember(self, sha256: str) -> None:
        self._verified[sha256] = None
        if len(self._verified) > _MAX_VERIFIED:
            del self._verified[next(iter(self._verified))]


def _check(bundle: Bundle, name: str, version: int, sha256: str | None) -> None:
    """A version is where its name says, and stays what it was."""
    if bundle.name != name:
        raise BadBundle(f"version {version} of {name} is a bundle of name {bundle.name}")
    if sha256 is not None and bundle.sha256 != sha256:
        detail = f"version {version} of {name} has sha256 {bundle.sha256}, expected {sha256}"
        raise BadBundle(f"{detail}: versions never change, so give the other content a number of its own")
