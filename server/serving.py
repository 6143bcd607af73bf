"""One bundle in service: its bots, the limits that follow from it, and what a connection is told of it.

This module knows nothing about other bundles, transports or who is connected.
"""

from __future__ import annotations

from msgspec import structs

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.manifest import Manifest
from protocol.codec import Format, body_limit
from protocol.features import CostModel, FeatureTable
from protocol.messages import Welcome
from server.pace import Pace

__all__ = ["Serving"]


class Serving:
    """A verified bundle with room for `max_bots` bots. `n_connections` hold it: it lives until the last lets go.

    `version` is its number in the store, None where there is none. `bots` and `n_connections` belong to the worker;
    `pace` to whoever answers; the rest never changes.
    """

    def __init__(self, bundle: Bundle, *, max_bots: int, version: int | None = None) -> None:
        self.bots = Bots(bundle, max_bots=max_bots)
        self.version = version
        self.n_connections = 0
        self.pace = Pace()
        self.max_body_bytes = {form: body_limit(self.table, max_bots, form) for form in Format}
        self.max_hello_bytes = {form: body_limit(self.table, 0, form) for form in Format}

    @property
    def name(self) -> str:
        """The bundle's name."""
        return self.manifest.name

    @property
    def sha256(self) -> str:
        """Which content this is: the hash of its manifest."""
        return self.bots.bundle.sha256

    @property
    def manifest(self) -> Manifest:
        """What the bundle says about itself."""
        return self.bots.bundle.manifest

    @property
    def table(self) -> FeatureTable:
        """The features of its bots."""
        return self.bots.bundle.manifest.features

    def welcome(self, connection_id: str, cost_model: CostModel, cost_quantile: float, form: Format) -> Welcome:
        """What a connection whose engine has these costs is told, in reply to a hello in `form`."""
        manifest = self.manifest
        return Welcome(
            connection=connection_id,
            bundle=manifest.name,
            features=manifest.features,
            action=manifest.action,
            cost_model=cost_model,
            budget_us=cost_model.full_us if manifest.is_unlimited else manifest.budget_us,
            context_length=manifest.context_length,
            max_bots=self.bots.max_bots,
            max_body_bytes=self.max_body_bytes[form],
            target_cost_us=None if manifest.target_cost is None else manifest.target_cost * cost_model.full_us,
            cost_quantile=cost_quantile,
            bundle_version=self.version,
            bundle_sha256=self.sha256,
            replay_frames=manifest.replay_turns,
            target_return=manifest.target_return,
        )

    def keeps_promises_of(self, other: Serving) -> bool:
        """Whether all that a connection to `other` was told holds for this one too, but for which content it is."""
        costs = CostModel.declared(other.table)
        said, told = (
            structs.replace(serving.welcome("", costs, 0.0, Format.MSGPACK), bundle_version=None, bundle_sha256=None)
            for serving in (self, other)
        )
        return said == told
