"""One run over several processes, by torch's own means: `torchrun --nproc-per-node 2 -m training.train --config FILE`.

Every worker draws the whole batch by the same chance and takes its share of the windows; DistributedDataParallel
averages their gradients. A process that torchrun did not start is the only worker: it has no process group, and nothing
here communicates. This module knows nothing about policies or traces. Shape letters: B windows, T timesteps.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import rich
import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

__all__ = ["count", "gather", "joined", "rank", "share", "spread", "weigh"]


@contextmanager
def joined(device: str) -> Iterator[None]:
    """Be one of torchrun's workers, or the only one. `device` as torch names it: `cuda` gives each a GPU of its own."""
    if not distributed.is_torchelastic_launched():
        yield
        return
    if device == "cuda":
        torch.cuda.set_device(distributed.get_node_local_rank())
    distributed.init_process_group()
    try:
        if rank():
            rich.reconfigure(quiet=True)
        yield
    finally:
        # Modules that were spread lie in reference cycles and hold the group: what of it is left when the interpreter
        # ends takes the process down, for its threads were never joined.
        gc.collect()
        distributed.destroy_process_group()


def count() -> int:
    """How many workers there are."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Which of them this is; the first one writes."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def share(windows: int, together: int) -> slice:
    """This worker's part of so many windows, of which `together` in a row stay together. Raises ValueError."""
    if windows % (count() * together):
        whole = f" times {together} windows that share a budget" if together > 1 else ""
        raise ValueError(f"batch {windows} is not a multiple of {count()} workers{whole}")
    own = windows // count()
    return slice(rank() * own, (rank() + 1) * own)


def spread(module: nn.Module, unused: bool = False) -> nn.Module:
    """The module; gradients of its parameters are averaged over the workers. `unused`: some of them have none."""
    if count() == 1:
        return module
    return DistributedDataParallel(module, forward_sync_buffers=False, find_unused_parameters=unused)


def gather(x_B: Tensor) -> Tensor:
    """The rows of all workers, in their order."""
    if count() == 1:
        return x_B
    parts = [torch.empty_like(x_B) for _ in range(count())]
    distributed.all_gather(parts, x_B.contiguous())
    return torch.cat(parts)


def weigh(own_BT: Tensor, whole_BT: Tensor) -> Tensor:
    """What a mean over this worker's mask must be multiplied by, for the mean over workers to be that over the whole
    batch's mask. 1 where there is one worker."""
    return own_BT.sum() * count() / whole_BT.sum().clamp(min=1.0)
