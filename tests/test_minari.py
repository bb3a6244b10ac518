import json
import sys
import warnings

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer

from misstep import Column, Dataset, MisstepError, Outcome, Provenance, Trajectory
from misstep.formats import (
    ReadOptions,
    append_trajectory,
    load_dataset,
    read_episodes,
    save_dataset,
)
from misstep.formats.minari import located

STORAGES = {"hdf5": "minari", "arrow": "minari-arrow"}


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    folder = tmp_path / "datasets"
    folder.mkdir()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    return folder


def make(steps=5, seed=0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "observations": rng.normal(size=(steps + 1, 2)),
        "actions": rng.normal(size=(steps, 1)),
        "dt": 0.02,
        "observation_columns": (Column("x", "m"), Column("theta", "rad")),
        "action_columns": (Column("force", "N"),),
        "provenance": Provenance(
            "cartpole", {"limit": float("inf")}, "weak", 2**70, "2024-05-31T12:00", ("a note",)
        ),
        "outcome": Outcome.FAILURE,
        "costs": rng.normal(size=steps),
        "failure_step": 3,
    }
    return Trajectory(**(fields | changes))


def three():
    return Dataset(
        [
            make(),
            make(steps=700, seed=1, costs=None, outcome=Outcome.UNKNOWN),
            make(steps=1, seed=2, failure_step=None, outcome=Outcome.SUCCESS),
        ]
    )


def made_by_minari(name, storage, observation_space, action_space, buffers, **changes):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that authors, links and environments are missing
        return minari.create_dataset_from_buffers(
            name,
            buffers,
            observation_space=observation_space,
            action_space=action_space,
            data_format=storage,
            **changes,
        )


# Out and back


@pytest.mark.parametrize("format", STORAGES.values())
def test_round_trip(tmp_path, format):
    path = tmp_path / "d.minari"
    dataset = three()
    save_dataset(dataset, path, format=format)
    assert load_dataset(path) == dataset
    assert load_dataset(path / "data") == dataset
    save_dataset(dataset[:1], path, format=format)  # in place of what was there
    assert load_dataset(path) == dataset[:1]
    assert "jax" not in sys.modules


@pytest.mark.parametrize(("storage", "format"), STORAGES.items())
def test_minari_reads_what_is_written(root, storage, format):
    dataset = three()
    name = "minari:cartpole/failed-v0"
    save_dataset(dataset, name, format=None if storage == "hdf5" else format)
    assert load_dataset(name) == load_dataset(root / "cartpole" / "failed-v0") == dataset
    assert list(minari.list_local_datasets()) == ["cartpole/failed-v0"]
    theirs = minari.load_dataset("cartpole/failed-v0")
    assert storage == theirs.storage.FORMAT
    assert theirs.total_episodes == 3
    assert theirs.total_steps == 706
    assert theirs.observation_space == gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    for ours, episode in zip(dataset, theirs, strict=True):
        T = ours.n_steps
        np.testing.assert_array_equal(episode.observations, ours.observations)
        np.testing.assert_array_equal(episode.actions, ours.actions)
        costs = np.zeros(T) if ours.costs is None else ours.costs
        np.testing.assert_array_equal(episode.rewards, -costs)
        ended = episode.terminations | episode.truncations
        np.testing.assert_array_equal(ended, np.arange(T) == T - 1)
        assert episode.infos["success"].any() == (ours.outcome is Outcome.SUCCESS)
        failed = np.flatnonzero(episode.infos["failure"])
        assert (failed[0] if len(failed) else None) == ours.failure_step


# What others wrote


@pytest.mark.parametrize("storage", STORAGES)
def test_nested_spaces(storage):
    rng = np.random.default_rng(0)
    observation_space = gym.spaces.Dict(
        {
            "goal": gym.spaces.Box(-1, 1, (1,), np.float32),
            "image": gym.spaces.Box(0, 255, (40, 40, 3), np.uint8),
            "state": gym.spaces.Dict({"q": gym.spaces.Box(-9, 9, (2, 2), np.float64)}),
        }
    )
    buffers = []
    for success in (False, True):
        observations = {
            "goal": rng.uniform(-1, 1, (5, 1)).astype(np.float32),
            "image": np.zeros((5, 40, 40, 3), np.uint8),
            "state": {"q": rng.normal(size=(5, 2, 2))},
        }
        buffers.append(
            EpisodeBuffer(
                seed=3,
                observations=observations,
                actions=rng.integers(0, 3, 4),
                rewards=[0.0, 1.0, 2.0, 3.0],
                terminations=[False, False, False, True],
                truncations=[False] * 4,
                infos={"success": [False] * 4 + [success], "angle": [0.0] * 5},
            )
        )
    made_by_minari("nested-v0", storage, observation_space, gym.spaces.Discrete(3), buffers)
    path = located("minari:nested-v0")
    episodes = [e.trajectory() for e in read_episodes(path, ReadOptions(rate=10))]
    assert [t.outcome for t in episodes] == [Outcome.FAILURE, Outcome.SUCCESS]
    for trajectory, buffer in zip(episodes, buffers, strict=True):
        names = [c.name for c in trajectory.observation_columns]
        assert names == ["goal", "state_q_0", "state_q_1", "state_q_2", "state_q_3"]
        goal, q = buffer.observations["goal"], buffer.observations["state"]["q"]
        np.testing.assert_array_equal(trajectory.observations, np.hstack([goal, q.reshape(5, 4)]))
        np.testing.assert_array_equal(trajectory.actions[:, 0], buffer.actions)
        np.testing.assert_array_equal(trajectory.costs, [0.0, -1.0, -2.0, -3.0])
        assert trajectory.dt == 0.1
        assert trajectory.provenance.system == "nested-v0"
        assert trajectory.provenance.seed == 3
        assert any("image" in note for note in trajectory.provenance.notes)
        assert any("angle" in note for note in trajectory.provenance.notes)
    with pytest.raises(MisstepError, match="--rate"):
        load_dataset(path)


def test_a_data_set_without_spaces_runs_nothing(root, refused):
    # Its environment would be imported and made, and could be anything.
    box = gym.spaces.Box(-1, 1, (1,), np.float64)
    buffer = EpisodeBuffer(
        observations=np.zeros((2, 1)),
        actions=np.zeros((1, 1)),
        rewards=[0.0],
        terminations=[True],
        truncations=[False],
    )
    made_by_minari("bare-v0", "hdf5", box, box, [buffer], env="CartPole-v1")
    place = root / "bare-v0" / "data" / "metadata.json"
    metadata = json.loads(place.read_text())
    del metadata["observation_space"]
    spec = json.loads(metadata["env_spec"]) | {"entry_point": "antigravity:fly"}
    metadata["env_spec"] = json.dumps(spec)
    place.write_text(json.dumps(metadata))
    with refused("does not say the observation space"):
        list(read_episodes(root / "bare-v0", ReadOptions(rate=10)))
    assert "antigravity" not in sys.modules


# What is refused


def test_arrow_holds_no_long_episodes(tmp_path, refused):
    # The library reads only the first 32,768 rows of such an episode back, and says nothing.
    path = tmp_path / "d.minari"
    longest = Dataset([make(steps=2**15 - 1)])
    save_dataset(longest, path, format="minari-arrow")
    assert load_dataset(path) == longest
    with refused("more than 32768"):
        save_dataset(Dataset([make(steps=2**15)]), path, format="minari-arrow")
    assert load_dataset(path) == longest
    save_dataset(Dataset([make(steps=2**15)]), path, format="minari")
    assert load_dataset(path)[0].n_steps == 2**15


def test_nothing_else_is_replaced(tmp_path, refused):
    folder = tmp_path / "home.minari"
    folder.mkdir()
    (folder / "letter.txt").write_text("dear")
    with refused("something else is there"):
        save_dataset(three(), folder)
    assert [p.name for p in folder.iterdir()] == ["letter.txt"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["datasets", "home.minari"]


def test_names(root, refused):
    assert located("minari:a/b-v1") == root / "a" / "b-v1"
    assert located("a/b.h5") == "a/b.h5"
    for name in ("minari:", "minari:../x", "minari:/etc"):
        with refused("name a data set"):
            located(name)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"data_format": "pickle"}, "data_format 'pickle'"),
        ({"total_episodes": 0}, "total_episodes 0"),
        ({"minari_version": "9.9"}, "does not support"),
        ({"action_space": '{"type": "Box", "shape": [9999999999], "low": 0}'}, "too large"),
        ({"action_space": '{"type": "Wormhole"}'}, "metadata.json cannot be read"),
    ],
)
def test_metadata_that_is_refused(tmp_path, refused, change, line):
    path = tmp_path / "d.minari"
    save_dataset(three(), path)
    place = path / "data" / "metadata.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | change))
    with refused(line):
        load_dataset(path)


@pytest.mark.parametrize(
    "count", [6, np.array([5, 5]), np.array((1, 2.0), dtype=[("a", "i4"), ("b", "f8")]), "five"]
)
def test_a_count_of_steps_that_is_another_is_refused(tmp_path, refused, count):
    path = tmp_path / "d.minari"
    save_dataset(Dataset([make()]), path)
    with h5py.File(path / "data" / "main_data.hdf5", "r+") as file:
        del file["episode_0"].attrs["total_steps"]
        file["episode_0"].attrs["total_steps"] = count
    with refused("total_steps is"):
        load_dataset(path)


def test_appending_by_name_adds_to_what_is_there():
    for seed in (1, 2, 3):
        append_trajectory("minari:cartpole/grown-v0", make(seed=seed))
    assert load_dataset("minari:cartpole/grown-v0") == Dataset([make(seed=s) for s in (1, 2, 3)])
