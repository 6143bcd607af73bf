"""Servings: the active bundle of each name, and earlier ones that connections still hold.

This module knows nothing about files, messages or transports. It belongs to the worker; only `max_body_bytes`
and `max_hello_bytes`, which are replaced whole, may be read from elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator

from protocol.codec import Format
from protocol.errors import NoBundle, NotReady, TooManyBots
from server.logs import logger
from server.serving import Serving

__all__ = ["Servings"]

_RETRY_AFTER_S = 1.0
_log = logger(__name__)


class Servings:
    """Every bundle in memory, at most `max_loaded`. All of them together serve at most `max_bots` bots.

    A connection holds the serving that it was opened with, so that what it was told stays true; a serving that is no
    longer active is forgotten with its last connection.
    """

    def __init__(self, max_bots: int, max_loaded: int = 8) -> None:
        self._active: dict[str, Serving] = {}
        self._loaded: list[Serving] = []
        self._max_bots = max_bots
        self.max_loaded = max_loaded
        self.max_body_bytes = dict.fromkeys(Format, 0)
        self.max_hello_bytes = dict.fromkeys(Format, 0)

    def __iter__(self) -> Iterator[Serving]:
        return iter(tuple(self._loaded))

    @property
    def n_bots(self) -> int:
        """How many bots there are, of all bundles."""
        return sum(serving.bots.n_bots for serving in self._loaded)

    def active(self, name: str) -> Serving | None:
        """The active one of this name, if there is one."""
        return self._active.get(name)

    def open_breakers(self) -> list[str]:
        """The bundles that fall back now because they are too slow; safe from any thread."""
        return [serving.name for serving in self if serving.bots.haste.breaker.is_open]

    def named(self, bundle: str | None) -> Serving:
        """The active one of this name, or NAME@VERSION in memory; None is the only name there is. Raises NoBundle."""
        if bundle is None:
            if len(self._active) != 1:
                raise NoBundle(f"{len(self._active)} bundles are served: name one of {', '.join(sorted(self._active))}")
            return next(iter(self._active.values()))
        if bundle in self._active:
            return self._active[bundle]
        for serving in self._loaded:
            if f"{serving.name}@{serving.version}" == bundle:
                return serving
        raise NoBundle(f"no bundle {bundle!r} is served")

    def of(self, sha256: str) -> Serving:
        """The one in memory with this content, active or held. Raises NoBundle."""
        for serving in self._loaded:
            if serving.sha256 == sha256:
                return serving
        raise NoBundle("no bundle with this hash is in memory: say hello again")

    def successor(self, serving: Serving) -> Serving:
        """The active one of the same name if it keeps what was promised of `serving`, else `serving` itself."""
        active = self._active[serving.name]
        return active if active is not serving and active.keeps_promises_of(serving) else serving

    def activate(self, serving: Serving) -> None:
        """From now on new connections get this one where they would have got the one of the same name.

        It may be one that connections hold still. Raises NotReady where they hold on to too many others.
        """
        replaced = self._active.get(serving.name)
        if serving not in self._loaded:
            if replaced is None or replaced.n_connections:
                self._check_place()
            self._loaded.append(serving)
        self._active[serving.name] = serving
        _log.info("bundle active", bundle=serving.name, version=serving.version, sha256=serving.sha256)
        if replaced is not None:
            self._forget_unused(replaced)
        self._limit_bodies()

    def hold(self, serving: Serving) -> None:
        """One more connection holds this."""
        serving.n_connections += 1

    def release(self, serving: Serving) -> None:
        """A connection lets go of this, its bots stopped."""
        serving.n_connections -= 1
        self._forget_unused(serving)

    def check_room(self, count: int) -> None:
        """Raise TooManyBots unless so many more bots may be started."""
        n_bots = self.n_bots
        if count > self._max_bots:
            raise TooManyBots(f"{count} bots never fit: there are {self._max_bots} slots")
        if n_bots + count > self._max_bots:
            raise TooManyBots(
                f"{count} bots do not fit: {n_bots} of {self._max_bots} slots are taken", retry_after_s=_RETRY_AFTER_S
            )

    def _check_place(self) -> None:
        if len(self._loaded) >= self.max_loaded:
            raise NotReady(
                f"connections hold all {self.max_loaded} bundles that may be in memory", retry_after_s=_RETRY_AFTER_S
            )

    def _forget_unused(self, serving: Serving) -> None:
        if serving.n_connections == 0 and self._active.get(serving.name) is not serving:
            self._loaded.remove(serving)
            self._limit_bodies()

    def _limit_bodies(self) -> None:
        """The longest message and hello that any of them can make sense of: whose one is, is known once it is read."""
        self.max_body_bytes = {form: max(serving.max_body_bytes[form] for serving in self._loaded) for form in Format}
        self.max_hello_bytes = {form: max(serving.max_hello_bytes[form] for serving in self._loaded) for form in Format}
