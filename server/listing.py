"""What operators are told and may ask: every bundle of the store and in memory, by name and version.

This module knows nothing about HTTP.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

from protocol.errors import BadBundle, NoBundle
from server.servings import Servings
from server.store import Store

__all__ = ["Activate", "Listed", "Rollback", "Version", "in_memory", "listing"]


class Activate(Struct, forbid_unknown_fields=True):
    """Make this version active. `sha256`, where given, is what its manifest must have."""

    version: Annotated[int, Meta(ge=1, le=999_999_999)]
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")] | None = None


class Rollback(Struct, forbid_unknown_fields=True):
    """Make active what was active before."""


class Version(Struct):
    """One version. `sha256` is of its manifest, on disk where it is not in memory; null where that cannot be read.

    `active`: new connections get it. `held`: connections that have it keep it. `stored`: on disk; it is verified when
    it is activated, and only then it is known who signed it, and its precision. `version` is null where the server has
    one folder and no store.
    """

    version: int | None
    state: Literal["active", "held", "stored"]
    sha256: str | None
    signed_by: str | None = None
    precision: str | None = None
    connections: int = 0
    bots: int = 0


class Listed(Struct):
    """One name. `previous` is what a rollback activates."""

    name: str
    active: int | None
    previous: int | None
    versions: list[Version]


_Loaded = dict[str, dict[int | None, Version]]


def in_memory(servings: Servings) -> _Loaded:
    """By name and version; for the worker."""
    loaded: _Loaded = {}
    for serving in servings:
        bundle = serving.bots.bundle
        loaded.setdefault(serving.name, {})[serving.version] = Version(
            serving.version,
            "active" if servings.active(serving.name) is serving else "held",
            serving.sha256,
            bundle.signed_by,
            bundle.manifest.precision,
            serving.n_connections,
            serving.bots.n_bots,
        )
    return loaded


def listing(loaded: _Loaded, store: Store | None) -> list[Listed]:
    """All of it, by name; reads the disk. Raises BadBundle, OSError where the store cannot be read."""
    names = sorted({*loaded, *(() if store is None else store.names())})
    return [_listed(name, loaded.get(name, {}), store) for name in names]


def _listed(name: str, loaded: dict[int | None, Version], store: Store | None) -> Listed:
    versions, previous = dict(loaded), None
    if store is not None:
        record = store.record(name)
        previous = None if record is None or record.previous is None else record.previous.version
        for number in store.versions(name):
            if number not in versions:
                versions[number] = Version(number, "stored", _sha256(store, name, number))
    active = next((version.version for version in loaded.values() if version.state == "active"), None)
    return Listed(name, active, previous, sorted(versions.values(), key=lambda version: version.version or 0))


def _sha256(store: Store, name: str, version: int) -> str | None:
    try:
        return store.sha256(name, version)
    except (BadBundle, NoBundle):
        return None
