"""What test_workers starts with torchrun: every configuration of a folder, then batches that cannot be shared out."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from training import workers
from training.config import TrainConfig
from training.train import train


def refused() -> list[str]:
    """Why."""
    told = []
    for windows, together in ((15, 1), (16, 16)):
        try:
            workers.share(windows, together)
        except ValueError as error:
            told.append(str(error))
    return told


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    with workers.joined("cpu"):
        for file in sorted(folder.glob("*.json")):
            train(TrainConfig.read(file))
        (folder / f"refused_{workers.rank()}.txt").write_text("\n".join(refused()))


if __name__ == "__main__":
    main()
