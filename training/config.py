"""What one training run is: a frozen dataclass that makes the command line and is written beside the result."""

from __future__ import annotations

import codecs
import re
from dataclasses import asdict, dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Literal

import msgspec

from protocol.messages import MAX_RETURN
from training.replace_file import replace_file

__all__ = ["DATASET_NAME", "TrainConfig"]


DATASET_NAME = re.compile(r"(?P<map>[a-z0-9]+)-(?P<quality>[a-z0-9-]+)-v\d+")  # such as hard-expert-v0
_COUNTS = ("window", "width", "n_layers", "n_heads", "encoder_width", "batch", "updates", "warmup", "sweeps")
_MOST = 1e3  # of what is multiplied into every update
_COUNTS += ("frame_bots", "log_every", "checkpoint_every")


@dataclass(frozen=True)
class TrainConfig:
    """One run of Algorithm 1. Lengths in timesteps, costs as shares of the full cost. Raises ValueError."""

    dataset: Path  # Minari dataset folder, such as data/navigation/navigation/hard-expert-v0; or one of training.shards
    out: Path  # folder of the run: config, checkpoint, metrics and curves
    name: str  # name of the bundle made from this run
    more_datasets: tuple[Path, ...] = ()  # read with it, an episode of each in turn
    feature_map: Path | None = None  # what the observations' numbers are (None: the dataset itself tells)
    environment: str = ""  # gymnasium id that evaluation plays, such as game.env:Navigation-hard-v0
    reference_returns: tuple[float, float] | None = None  # returns that are 0 and 100 when normalised (D4RL's scores)
    seed: int = 0
    episodes: int | None = None  # read only the first so many episodes of each dataset (None: all)
    held_out: float = 0.04  # share of the episodes, the last ones, that only measure the loss
    pool_mb: float = 1024.0  # most memory for traces where they are streamed, from a folder of training.shards

    keyframes: Path | None = None  # a run that acquires nothing: frames that it gets wrong count more

    method: Literal["bdt", "rcbc", "bc", "iql"] = "bdt"
    acquisition: Literal["learned", "random", "all", "none"] = "learned"  # learn the queries, draw them, or force them
    budget: float = 0.1  # C: most that a query may cost, as a share of the full cost (Eq. 1)
    budgets: tuple[float, ...] = ()  # C is an input, drawn for each window from the strata between these edges
    control: Literal["algorithm-1", "dual"] = "algorithm-1"  # how γ moves (training/control.py)
    penalty_step: float = 0.001  # ε: what γ rises by after a batch above C (Alg. 1); dual: a step of asinh, say 0.01
    penalty_floor: float = -0.1  # least γ of the dual control: below 0 it pays for asking where budget is left over
    allocation: Literal["none", "bot", "frame"] = "none"  # what is sampled must fit C: each bot, or a frame's together
    frame_bots: int = 20  # windows that share C where `allocation` is frame; batch is a multiple of it
    acquisition_bias: float = 0.0  # initial logit of every query probability
    sampler: Literal["incremental", "parallel"] = "incremental"  # same queries; incremental is faster on a CPU
    sweeps: int = 2  # backward sweeps of the query's adjoint (training/acquisition.py)
    frame_budget: float = 0.2  # hard cap of one bot's query at run time, unless the engine sets another (bursts pass C)
    target_return: float | None = None  # return asked for at run time (None: 90th percentile of the traces)

    bins: tuple[int, ...] = (11, 3, 2)  # bins of each action component; none: each is Gaussian, and its mean is played
    sampled: tuple[str, ...] = ()  # action components sampled from their bins instead of taking the most probable

    context_length: int = 20  # K
    window: int = 60  # timesteps in a training window
    burn_in: int = 0  # first timesteps of a window that teach nothing: its memory has yet to fill (not where it begins)
    beginnings: float = 0.0  # share of the windows that start where their episode does: rare states, met in each one
    width: int = 64  # W
    n_layers: int = 2  # L; hidden layers of width W where there is no memory
    n_heads: int = 4  # H
    n_kv_heads: int | None = None  # G: heads of keys and values, each shared by H/G heads (None: H, none is shared)
    encoder_width: int = 128  # hidden width of the token encoder and acquisition head
    fourier: int = 4  # octaves of each free number,
    octaves: dict[str, int] = field(default_factory=dict)  # but for the free features named here

    batch: int = 40  # windows in an update
    updates: int = 3000
    learning_rate: float = 2e-3
    warmup: int = 100  # updates of linear warm-up, then a cosine to zero
    weight_decay: float = 0.1
    gradient_clip: float = 1.0

    device: str = "cpu"  # as torch names it
    matmul_precision: Literal["highest", "high", "medium"] = "highest"  # of float32 products, as torch names it
    log_every: int = 50  # updates between lines of metrics
    checkpoint_every: int = 500  # updates between checkpoints

    def __post_init__(self) -> None:
        for name in ("budget", "frame_budget", "held_out", "beginnings"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a share in [0, 1]")
        for name in ("learning_rate", "gradient_clip"):
            if not 0.0 < getattr(self, name) <= _MOST:
                raise ValueError(f"{name} is {getattr(self, name)}, expected above 0 and at most {_MOST:g}")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"seed is {self.seed}, expected 0 or more")
        for name in ("penalty_step", "weight_decay"):
            if not 0.0 <= getattr(self, name) <= _MOST:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 to {_MOST:g}")
        if not abs(self.acquisition_bias) <= _MOST:
            raise ValueError(f"acquisition_bias is {self.acquisition_bias}, expected at most {_MOST:g} either way")
        for told in (self.target_return, *(self.reference_returns or ())):
            if told is not None and not abs(told) <= MAX_RETURN:
                raise ValueError(f"a return is {told}, expected at most {MAX_RETURN:g} either way")
        for name in _COUNTS:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 1 or more")
        if not self.pool_mb > 0.0:
            raise ValueError(f"pool_mb is {self.pool_mb}, expected above 0")
        if self.reference_returns is not None and not self.reference_returns[0] < self.reference_returns[1]:
            raise ValueError(f"reference_returns is {self.reference_returns}, expected the lower one first")
        if self.held_out == 1.0:
            raise ValueError("held_out is 1.0, expected a share that leaves episodes to train on")
        if min(self.bins, default=2) < 2:
            raise ValueError(f"bins is {self.bins}, expected 2 or more for each action component, or none at all")
        if self.sampled and not self.bins:
            raise ValueError(f"sampled is {self.sampled}, expected none: only bins can be sampled")
        if not 0 <= self.burn_in < self.window or (self.burn_in and self.method != "bdt"):
            raise ValueError(f"burn_in is {self.burn_in}, expected 0 or more, below window, and 0 without a memory")
        if self.width % self.n_heads:
            raise ValueError(f"width {self.width} is not a multiple of n_heads {self.n_heads}")
        if self.n_kv_heads is not None and (self.n_kv_heads < 1 or self.n_heads % self.n_kv_heads):
            raise ValueError(f"n_kv_heads is {self.n_kv_heads}, expected 1 or more that divide n_heads {self.n_heads}")
        if min((self.fourier, *self.octaves.values())) < 0:
            raise ValueError(f"fourier is {self.fourier} and octaves {self.octaves}, expected 0 or more")
        edges = self.budgets
        if edges and (len(edges) < 2 or any(a >= b for a, b in pairwise(edges))):
            raise ValueError(f"budgets is {edges}, expected two or more rising edges")
        if edges and not 0.0 < edges[0] <= edges[-1] <= 1.0:
            raise ValueError(f"budgets is {edges}, expected shares above 0 and at most 1")
        if edges and not edges[0] <= self.budget <= edges[-1]:
            raise ValueError(f"budget is {self.budget}, expected within what is trained, {edges[0]} to {edges[-1]}")
        if not -1e3 <= self.penalty_floor <= 0.0:
            raise ValueError(f"penalty_floor is {self.penalty_floor}, expected -1000 to 0")
        if self.allocation == "frame" and self.batch % self.frame_bots:
            raise ValueError(f"batch {self.batch} is not a multiple of frame_bots {self.frame_bots}")
        if self.context_length < 2:
            raise ValueError(f"context_length is {self.context_length}, expected 2 or more")

    @property
    def dataset_name(self) -> str:
        """`hopper-expert-v0`; with `hopper-medium-v0` it is `hopper-medium-expert-v0`, as D4RL calls them, and with
        more of the same quality, from another folder, it stays what it is."""
        names = [path.name for path in (self.dataset, *self.more_datasets)]
        matches = [DATASET_NAME.fullmatch(name) for name in names]
        if len(names) == 1 or not all(matches) or len({match["map"] for match in matches if match}) > 1:
            return "+".join(names)
        qualities = sorted({match["quality"] for match in matches if match}, reverse=True)
        return "-".join([names[0].partition("-")[0], *qualities, names[0].rpartition("-")[2]])

    @property
    def feature_set(self) -> str:
        """`nl` where the feature map of a dataset `halfcheetah-...` is `halfcheetah-nl.json`, none for its own name."""
        stem, map_ = "" if self.feature_map is None else self.feature_map.stem, self.dataset.name.partition("-")[0]
        return "" if stem == map_ else stem.removeprefix(f"{map_}-")

    @classmethod
    def read(cls, path: Path) -> TrainConfig:
        """Read a configuration written by `write` or by hand. Raises ValueError, for unknown settings too."""
        try:
            data = msgspec.json.decode(path.read_bytes().removeprefix(codecs.BOM_UTF8), type=dict[str, object])
            if unknown := set(data) - {field.name for field in fields(cls)}:
                raise ValueError(f"unknown settings {sorted(unknown)}")
            return msgspec.convert(data, cls, dec_hook=lambda kind, value: kind(value))
        except (ValueError, msgspec.DecodeError) as error:
            raise ValueError(f"{path}: {error}") from error

    def write(self, path: Path) -> None:
        """Write every setting as JSON."""
        replace_file(path, msgspec.json.format(msgspec.json.encode(asdict(self), enc_hook=str), indent=2) + b"\n")
