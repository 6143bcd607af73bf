import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import minari
import msgspec
import numpy as np
import pytest
from rich.console import Console

from game.collect import Collect, collect, dataset_id, main, play_episode
from game.env import ACTION_SPEC, NavigationEnv, feature_table
from game.players import Player
from game.recording import summarise, write_shard
from game.skills import EXPERT, NEARSIGHTED
from protocol.features import ActionSpec, FeatureTable


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    config = Collect(map="easy", episodes=3, workers=1, seed=5, out=tmp_path_factory.mktemp("navigation"))
    folder, summary = collect(config, Console(file=io.StringIO()))
    return config, folder, summary


def test_minari_loads_what_was_recorded(recorded, monkeypatch):
    config, _, summary = recorded
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(config.out))
    dataset = minari.load_dataset("navigation/easy-expert-v0")
    assert dataset_id(config) == "navigation/easy-expert-v0"
    assert dataset.total_episodes == 3
    assert dataset.total_steps == sum(summary.lengths)
    table = feature_table()
    for episode, total, length in zip(dataset.iterate_episodes(), summary.returns, summary.lengths, strict=True):
        assert episode.observations["free"].shape == (length + 1, table.n_free)
        assert episode.observations["costly"].shape == (length + 1, table.n_costly)
        assert episode.actions.shape == (length, ACTION_SPEC.size)
        assert episode.rewards.sum() == pytest.approx(total)
        assert episode.terminations.tolist() == [False] * (length - 1) + [True]
        assert not episode.truncations.any()
    metadata = dataset.storage.metadata
    assert msgspec.json.decode(metadata["features"], type=FeatureTable) == table
    assert msgspec.json.decode(metadata["action"], type=ActionSpec) == ACTION_SPEC
    assert json.loads(metadata["collect"])["seed"] == "5"
    seeds = [episode["seed"] for episode in dataset.storage.get_episode_metadata(range(3))]
    assert seeds == [5_000_000, 5_000_001, 5_000_002]
    env = dataset.recover_environment()
    assert env.unwrapped.terrain.name == "easy"
    env.close()


def test_a_player_sees_as_far_as_it_is_told():
    assert Collect(player="nearsighted").skill == NEARSIGHTED
    told = Collect(player="expert", sight_m=NEARSIGHTED.sight_m)
    assert told.skill == replace(EXPERT, sight_m=NEARSIGHTED.sight_m)
    env = NavigationEnv("hard")
    far, near, again = (_recorded_actions(env, Collect(sight_m=sight_m)) for sight_m in (None, 2.0, 2.0))
    env.close()
    assert not np.array_equal(near, far)
    np.testing.assert_array_equal(near, again)
    for sight_m in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="sight_m"):
            Collect(sight_m=sight_m)


def test_a_recorded_episode_starts_as_its_seed_does(recorded, easy):
    _, folder, _ = recorded
    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        group = file["episode_1"]
        observation, _ = easy.reset(seed=int(group.attrs["seed"]))
        np.testing.assert_array_equal(group["observations/free"][0], observation["free"])
        np.testing.assert_array_equal(group["observations/costly"][0], observation["costly"])


def test_the_data_depend_on_the_seed_and_nothing_else(recorded, tmp_path):
    _, folder, _ = recorded
    again, _ = collect(Collect(map="easy", episodes=3, workers=2, seed=5, out=tmp_path), Console(file=io.StringIO()))
    with h5py.File(folder / "data" / "main_data.hdf5") as a, h5py.File(again / "data" / "main_data.hdf5") as b:
        for name in ("actions", "rewards", "observations/free", "observations/costly"):
            np.testing.assert_array_equal(a[f"episode_2/{name}"][()], b[f"episode_2/{name}"][()])


def test_nothing_is_left_behind_but_the_dataset(recorded):
    _, folder, _ = recorded
    assert [path.name for path in folder.iterdir()] == ["data"]


def test_finished_shards_are_not_played_again(tmp_path, monkeypatch):
    import game.collect

    monkeypatch.chdir(tmp_path)
    config = Collect(map="easy", episodes=2, workers=1, out=Path("here"))  # relative, as on the command line
    with monkeypatch.context() as patch:
        patch.setattr(game.collect, "merge_shards", _interrupted)
        with pytest.raises(_InterruptedError):
            collect(config, Console(file=io.StringIO()))
    (shard,) = tmp_path.rglob("shard_*.hdf5")
    before = summarise(shard)
    monkeypatch.setattr(game.collect, "_play_shard", _interrupted)
    _, summary = collect(config, Console(file=io.StringIO()))
    assert summary == before


class _InterruptedError(Exception):
    pass


def _interrupted(*_args, **_kwargs):
    raise _InterruptedError


def test_a_shard_appears_only_when_it_is_complete(tmp_path):
    def broken():
        raise RuntimeError("no episode")
        yield

    with pytest.raises(RuntimeError, match="no episode"):
        write_shard(tmp_path / "shard.hdf5", broken())
    assert not (tmp_path / "shard.hdf5").exists()


def test_what_was_intended_is_recorded_not_what_a_kick_made_of_it(easy, monkeypatch):
    player = Player(EXPERT, easy.terrain)
    intended, executed = [], []
    act, step = player.act, easy.step
    monkeypatch.setattr(player, "act", lambda character: intended.append(act(character)) or intended[-1])
    monkeypatch.setattr(easy, "step", lambda action: executed.append(action) or step(action))
    episode = play_episode(easy, player, seed=0, kick_chance=0.2)
    np.testing.assert_array_equal(episode.actions, np.stack(intended))
    kicked = (np.stack(executed) != episode.actions).any(axis=1)
    assert 0.05 < kicked.mean() < 0.9


def _recorded_actions(env, config):
    return play_episode(env, Player(config.skill, env.terrain), 7, config.kick_chance).actions


@pytest.mark.parametrize("settings", [{"episodes": 0}, {"workers": 0}, {"sight_m": 0.0}])
def test_refuses_settings_that_cannot_be(settings: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Collect(**settings)


def test_a_map_that_is_none_is_said_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["collect", "--map", "nosuch", "--episodes", "1", "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit, match=r"error: .*nosuch"):
        main()
