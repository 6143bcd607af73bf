"""What test_workers starts with torchrun: every configuration of a folder, then what must be refused."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from training import workers
from training.config import TrainConfig
from training.train import train


def refused(finished: TrainConfig) -> list[str]:
    """Why: two batches, and a run whose folder only the first worker sees."""
    elsewhere = replace(finished, out=finished.out if workers.rank() == 0 else finished.out / "elsewhere")
    asked = [partial(workers.share, 15, 1), partial(workers.share, 16, 16), partial(train, elsewhere)]
    told = []
    for ask in asked:
        try:
            ask()
        except ValueError as error:
            told.append(str(error))
    return told


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    with workers.joined("cpu"):
        for file in sorted(folder.glob("*.json")):
            config = TrainConfig.read(file)
            train(config)
        (folder / f"refused_{workers.rank()}.txt").write_text("\n".join(refused(config)))


if __name__ == "__main__":
    main()
