"""Opening a Minari dataset: its spaces, its features and its action layout, and its episodes as numbers.

What a dataset's features are stands in its own metadata (as our game writes it), or in a feature map. This module knows
nothing about torch or training.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import minari
import msgspec
import numpy as np
from numpy.typing import NDArray

from protocol.features import ActionComponent, ActionSpec, FeatureTable
from training.feature_map import FeatureMap, parts_of

__all__ = ["Dataset", "Recorded", "TracesError", "observation_sizes", "open_dataset"]


class TracesError(ValueError):
    """A dataset that cannot be trained on: what is wrong and where."""


class Recorded(NamedTuple):
    """One episode of T timesteps."""

    free_TF: NDArray[np.floating]
    costly_TD: NDArray[np.floating]
    actions_TA: NDArray[np.floating]
    rewards_T: NDArray[np.floating]


@dataclass(frozen=True)
class Dataset:
    """A dataset whose episodes have this feature table and action layout."""

    path: Path
    features: FeatureTable
    action: ActionSpec
    choices: int | None  # of a discrete action; None: the action is numbers
    _minari: minari.MinariDataset
    _feature_map: FeatureMap | None

    def __len__(self) -> int:
        """How many episodes there are."""
        return int(self._minari.total_episodes)

    def episode(self, number: int) -> Recorded:
        """Read an episode. Noise of a feature map is the same whenever it is read. Raises TracesError."""
        read = self._minari[number]
        rewards = np.asarray(read.rewards)
        n = len(rewards)
        try:
            parts = parts_of(read.observations, n)
            if self._feature_map is None:
                free, costly = parts["free"], parts["costly"]
            else:
                free, costly = self._feature_map.split(parts, np.random.default_rng([number, n]))
        except (IndexError, KeyError, ValueError) as error:
            raise TracesError(f"{self.path}: episode {number}: {error}") from error
        return Recorded(free, costly, _columns(np.asarray(read.actions)), rewards)


def open_dataset(path: Path, feature_map: FeatureMap | None = None) -> Dataset:
    """A Minari dataset's folder, or its id under MINARI_DATASETS_PATH (`minari download ID` puts it there).

    Raises TracesError when it is no such dataset, holds HDF5 links out of itself, or tells no features and no map is
    given, or a map that does not fit it.
    """
    folder, metadata = _metadata(path)
    try:
        acted = _object(metadata["action_space"])
        sizes = _sizes(_object(metadata["observation_space"]))
        action = _action(metadata, acted)
        features = _features(metadata, sizes) if feature_map is None else feature_map.table(sizes)
        choices = int(acted["n"]) if acted["type"] == "Discrete" else None
        opened = minari.MinariDataset(folder / "data")
    except (KeyError, TypeError, ValueError) as error:
        raise TracesError(f"{folder}: metadata: {_reason(error)}") from error
    return Dataset(folder, features, action, choices, opened, feature_map)


def observation_sizes(path: Path) -> dict[str, int]:
    """How many numbers each part of a dataset's observations has. Raises TracesError."""
    folder, metadata = _metadata(path)
    try:
        return _sizes(_object(metadata["observation_space"]))
    except (KeyError, TypeError, ValueError) as error:
        raise TracesError(f"{folder}: metadata: {_reason(error)}") from error


def _metadata(path: Path) -> tuple[Path, dict[str, Any]]:
    """The dataset's folder and metadata, from files that hold nothing but data."""
    folder = _folder(path)
    _refuse_links(folder / "data")
    try:
        metadata = _object((folder / "data" / "metadata.json").read_text(encoding="utf-8"))
        # Without both spaces minari would make the environment that the metadata name, and run code of their choice.
        for name in ("observation_space", "action_space"):
            _object(metadata[name])
    except (KeyError, TypeError, ValueError) as error:
        raise TracesError(f"{folder}: metadata: {_reason(error)}") from error
    return folder, metadata


def _reason(error: Exception) -> str:
    return f"there is no {error}" if isinstance(error, KeyError) else str(error)


def _folder(path: Path) -> Path:
    root = Path(os.environ.get("MINARI_DATASETS_PATH", Path.home() / ".minari" / "datasets"))
    for folder in (path, root / path):
        if (folder / "data" / "metadata.json").is_file():
            return folder
    raise TracesError(
        f"{path} is not a Minari dataset: neither it nor {root / path} has a data/metadata.json "
        f"(`minari download {path}` fetches what Minari's server has)"
    )


def _features(metadata: dict[str, Any], sizes: Mapping[str, int]) -> FeatureTable:
    """What the dataset says of its own features."""
    if "features" not in metadata:
        raise ValueError("tells no features: give a feature map (docs/tutorials/your-own-environment.md)")
    if not {"free", "costly"} <= sizes.keys():
        raise ValueError(f"observations hold {sorted(sizes)}, expected 'free' and 'costly', or a feature map")
    return msgspec.json.decode(_text(metadata["features"]), type=FeatureTable)


def _sizes(space: dict[str, Any]) -> dict[str, int]:
    """How many numbers each part of an observation has. Parts of a Dict that have none, such as texts and other Dicts,
    are left out: a feature map cannot name them."""
    if space["type"] == "Dict":
        sizes = {key: _numbers(part) for key, part in space["subspaces"].items()}
        return {key: size for key, size in sizes.items() if size is not None}
    size = _numbers(space)
    if size is None:
        raise ValueError(f"the observation is a {space['type']}, expected numbers or a Dict of them")
    return {"": size}


def _numbers(space: dict[str, Any]) -> int | None:
    """How many numbers a value of this space is; None: it is something else."""
    if space["type"] == "Box":
        return int(np.prod(space["shape"], dtype=np.int64))
    if space["type"] == "MultiBinary":
        return int(np.prod(space["n"], dtype=np.int64))
    if space["type"] == "MultiDiscrete":
        return np.array(space["nvec"]).size
    return 1 if space["type"] == "Discrete" else None


def _action(metadata: dict[str, Any], space: dict[str, Any]) -> ActionSpec:
    """The layout in the metadata, or one made from the action space: numbers `action_0` ..., or one `choice`."""
    if "action" in metadata:
        return msgspec.json.decode(_text(metadata["action"]), type=ActionSpec)
    if space["type"] == "Discrete":
        first = float(space.get("start", 0))
        return ActionSpec((ActionComponent("choice", first, first + space["n"] - 1, safe=first),))
    if space["type"] != "Box" or len(space["shape"]) != 1:
        raise ValueError(
            f"the action space is {space['type']} {space.get('shape', '')}, expected Discrete or a flat Box"
        )
    bounds = zip(space["low"], space["high"], strict=True)
    return ActionSpec(
        tuple(
            ActionComponent(f"action_{i}", low, high, safe=min(max(0.0, low), high))
            for i, (low, high) in enumerate(bounds)
        )
    )


def _object(value: object) -> dict[str, Any]:
    parsed = json.loads(_text(value))
    if not isinstance(parsed, dict):
        raise ValueError(f"found {str(parsed)[:80]!r}, expected an object")
    return parsed


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _refuse_links(folder: Path) -> None:
    """An HDF5 file may point at other files; a dataset from outside must not (nor may its files be links, nor its
    groups form anything but a tree)."""
    for file in folder.glob("*.hdf5"):
        if file.is_symlink():
            raise TracesError(f"{file} is a symbolic link, expected a regular file")
        with h5py.File(file) as root:
            groups, seen = [root], {h5py.h5o.get_info(root.id).addr}
            while groups:
                group = groups.pop()
                for name in group:
                    link = group.get(name, getlink=True)
                    if not isinstance(link, h5py.HardLink):
                        raise TracesError(f"{file}: {group.name}/{name} is a {type(link).__name__}, expected data")
                    child = group[name]
                    if isinstance(child, h5py.Group):
                        address = h5py.h5o.get_info(child.id).addr
                        if address in seen:
                            raise TracesError(f"{file}: {group.name}/{name} is a group that has another place as well")
                        seen.add(address)
                        groups.append(child)
                    elif child.external or child.is_virtual:
                        raise TracesError(f"{file}: {child.name} keeps its data in another file, expected it inside")


def _columns(actions: NDArray[np.floating]) -> NDArray[np.floating]:
    """A discrete action is recorded as one number a timestep."""
    return actions[:, None] if actions.ndim == 1 else actions
