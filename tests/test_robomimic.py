import json

import h5py
import numpy as np
import pytest

from misstep import Column, Dataset, Outcome, Provenance, Trajectory
from misstep.formats import ReadOptions, load_dataset, read_episodes, save_dataset
from misstep.formats.hdf5 import texts


def make(steps=5, seed=0, names=("eef_pos_0", "eef_pos_1", "gripper"), **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "observations": rng.normal(size=(steps + 1, len(names))),
        "actions": rng.normal(size=(steps, 2)),
        "dt": 0.05,
        "observation_columns": tuple(Column(name, "m") for name in names),
        "action_columns": (Column("fx", "N"), Column("fy", "N")),
        "provenance": Provenance(
            "arm", {"mass": 0.5, "limit": float("inf")}, "weak", 2**70, "2024-05-31T12:00", ("n",)
        ),
        "outcome": Outcome.FAILURE,
        "costs": rng.normal(size=steps),
        "failure_step": 3,
    }
    return Trajectory(**(fields | changes))


def as_documented(path, demos=3, steps=7, next_obs=True, images=True):
    """Write a file as robomimic's documentation lays it out, with h5py alone."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = demos * steps
        data.attrs["env_args"] = json.dumps(
            {"env_name": "PickPlaceCan", "env_type": 1, "env_kwargs": {"control_freq": 20}}
        )
        for i in range(demos):
            demo = data.create_group(f"demo_{i}")
            demo.attrs["num_samples"] = steps
            demo.attrs["model_file"] = "<mujoco/>"
            pos, grip = rng.normal(size=(steps + 1, 3)), rng.normal(size=(steps + 1, 1))
            for group, rows in (("obs", slice(None, -1)), ("next_obs", slice(1, None))):
                if group == "next_obs" and not next_obs:
                    continue
                demo.create_dataset(f"{group}/eef_pos", data=pos[rows], compression="gzip")
                demo.create_dataset(f"{group}/gripper", data=grip[rows], chunks=(2, 1))
                if images:
                    demo[f"{group}/agentview_image"] = np.zeros((steps, 4, 4, 3), np.uint8)
            demo["actions"] = rng.uniform(-1, 1, (steps, 2))
            demo["rewards"] = np.eye(1, steps, steps - 1)[0] * (i == 1)
            demo["dones"] = np.eye(1, steps, steps - 1, dtype=int)[0]
            demo["states"] = rng.normal(size=(steps, 9))
        file["mask/success"] = np.array(["demo_1"], dtype="S")
        file["mask/failure"] = np.array(["demo_0"], dtype="S")
        file["mask/valid"] = ["demo_2", "demo_0"]  # texts of variable length


# Out and back


def test_round_trip(tmp_path):
    dataset = Dataset(
        [
            make(),
            make(steps=20_000, seed=1, costs=None, outcome=Outcome.UNKNOWN),
            make(steps=1, seed=2, failure_step=None, outcome=Outcome.SUCCESS),
        ]
    )
    path = tmp_path / "d.hdf5"
    save_dataset(dataset, path, format="robomimic")
    assert load_dataset(path) == dataset  # recognised by its content


def test_odd_names_come_back(tmp_path):
    names = ("/joint_states.position[0]", ".", "a_0", "a")
    path = tmp_path / "d.h5"
    save_dataset(Dataset([make(names=names)]), path, format="robomimic")
    assert [c.name for c in load_dataset(path).observation_columns] == list(names)


def test_what_is_written_is_as_documented(tmp_path):
    path = tmp_path / "d.h5"
    made = [make(), make(steps=9, seed=1, outcome=Outcome.SUCCESS, failure_step=None)]
    save_dataset(Dataset(made), path, format="robomimic")
    with h5py.File(path) as file:
        assert file["data"].attrs["total"] == 14
        env_args = json.loads(file["data"].attrs["env_args"])
        assert set(env_args) == {"env_name", "env_type", "env_kwargs"}
        assert env_args["env_kwargs"]["control_freq"] == 20
        for i, trajectory in enumerate(made):
            demo = file[f"data/demo_{i}"]
            T = trajectory.n_steps
            assert demo.attrs["num_samples"] == T
            assert set(demo["obs"]) == set(demo["next_obs"]) == {"eef_pos", "gripper"}
            np.testing.assert_array_equal(demo["obs/eef_pos"], trajectory.observations[:-1, :2])
            np.testing.assert_array_equal(demo["next_obs/eef_pos"], trajectory.observations[1:, :2])
            np.testing.assert_array_equal(demo["obs/gripper"], trajectory.observations[:-1, 2:])
            np.testing.assert_array_equal(demo["actions"], trajectory.actions)
            np.testing.assert_array_equal(demo["rewards"], -trajectory.costs)
            np.testing.assert_array_equal(demo["dones"], np.arange(T) == T - 1)
            assert demo["states"].shape[0] == T
        assert list(file["mask/failure"]) == [b"demo_0"]
        assert list(file["mask/success"]) == [b"demo_1"]


# What others wrote


def test_a_file_as_documented(tmp_path):
    path = tmp_path / "can.hdf5"
    as_documented(path)
    dataset = load_dataset(path)
    assert [c.name for c in dataset.observation_columns] == [
        "eef_pos_0",
        "eef_pos_1",
        "eef_pos_2",
        "gripper",
    ]
    assert [c.name for c in dataset.action_columns] == ["action_0", "action_1"]
    assert dataset.dt == 1 / 20
    assert [t.outcome for t in dataset] == [Outcome.FAILURE, Outcome.SUCCESS, Outcome.UNKNOWN]
    assert dataset[0].provenance.system == "PickPlaceCan"
    assert any("agentview_image" in note for note in dataset[0].provenance.notes)
    with h5py.File(path) as file:
        demo = file["data/demo_1"]
        table = np.hstack([demo["obs/eef_pos"], demo["obs/gripper"]])
        last = np.hstack([demo["next_obs/eef_pos"][-1], demo["next_obs/gripper"][-1]])
        np.testing.assert_array_equal(dataset[1].observations, np.vstack([table, last]))
        np.testing.assert_array_equal(dataset[1].actions, demo["actions"])
        np.testing.assert_array_equal(dataset[1].costs, -demo["rewards"][()])


def test_without_next_observations_the_last_action_goes(tmp_path):
    path = tmp_path / "can.hdf5"
    as_documented(path, next_obs=False)
    trajectory = load_dataset(path)[0]
    with h5py.File(path) as file:
        np.testing.assert_array_equal(trajectory.actions, file["data/demo_0/actions"][:-1])
        np.testing.assert_array_equal(
            trajectory.observations[:, :3], file["data/demo_0/obs/eef_pos"]
        )
    assert any("last action" in note for note in trajectory.provenance.notes)


@pytest.mark.parametrize(("key", "demos"), [("success", [1]), ("valid", [0, 2])])
def test_filter_keys(tmp_path, key, demos):
    path = tmp_path / "can.hdf5"
    as_documented(path)
    everything = load_dataset(path)
    found = [e.trajectory() for e in read_episodes(path, ReadOptions(only=key))]
    assert found == [everything[i] for i in demos]


def test_refused(tmp_path, refused):
    path = tmp_path / "can.hdf5"

    def read(options=None):
        return [e.trajectory() for e in read_episodes(path, options)]

    as_documented(path)
    with refused("no filter key 'bad'; there are: failure, success, valid"):
        read(ReadOptions(only="bad"))
    with h5py.File(path, "a") as file:
        file["data/demo_2"].attrs["num_samples"] = 8
    with refused("demo_2: num_samples is 8 but actions has 7 rows"):
        read()
    as_documented(path)
    with h5py.File(path, "a") as file:
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Can", "env_kwargs": {}})
    with refused("--rate"):
        read()
    assert read(ReadOptions(rate=10))[0].dt == 0.1
    as_documented(path)
    with h5py.File(path, "a") as file:
        del file["data/demo_0/actions"]
        file["data/demo_0/actions"] = h5py.ExternalLink("elsewhere.h5", "/a")
    with refused("actions is a link to elsewhere"):
        read()


def test_a_small_file_does_not_become_a_large_one(tmp_path, refused):
    path = tmp_path / "bomb.hdf5"
    as_documented(path, demos=1)
    with h5py.File(path, "a") as file:
        demo = file["data/demo_0"]
        del demo["actions"]
        demo.create_dataset("actions", shape=(2**40, 2), dtype="f8", chunks=(1000, 2))
    assert path.stat().st_size < 100_000
    with refused("actions claims to be longer than what is stored of it"):
        load_dataset(path)


def test_damaged_texts_crash_nothing(tmp_path, refused, monkeypatch):
    # With the wrong size of the text, the HDF5 library (2.0.0) goes round in circles for ever.
    monkeypatch.setattr(texts, "_SECONDS", 4)
    path = tmp_path / "can.hdf5"
    as_documented(path, images=False)
    whole = bytearray(path.read_bytes())
    heap = whole.index(b"GCOL")
    whole[heap + 24] ^= 151
    path.write_bytes(whole)
    with refused("env_args is damaged"):
        load_dataset(path)


def test_an_attribute_of_several_texts_is_refused_in_one_line(tmp_path, refused):
    path = tmp_path / "a.h5"
    as_documented(path)
    with h5py.File(path, "r+") as file:
        file["data"].attrs["env_args"] = np.array([b"{}", b"{}"])
    with refused("demo_0: "):
        load_dataset(path)
