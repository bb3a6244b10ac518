import gc
import json
import warnings
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from misstep import Column, Dataset, Outcome, Provenance, Trajectory
from misstep.formats import (
    FORMATS,
    Episode,
    load_dataset,
    read_episodes,
    save_dataset,
    write_episodes,
)
from misstep.formats.lerobot.footer import column_parts

VERSIONS = {"v3.0": "lerobot", "v2.1": "lerobot-v2.1"}
NAMES = ["shoulder.pos", "elbow.pos"]


def make(steps=5, seed=0, **changes):
    rng = np.random.default_rng(seed)

    def single(*shape):  # what LeRobot can hold
        return rng.normal(size=shape).astype(np.float32).astype(np.float64)

    fields = {
        "observations": single(steps + 1, 2),
        "actions": single(steps, 1),
        "dt": 0.02,
        "observation_columns": (Column("x", "m"), Column("theta", "rad")),
        "action_columns": (Column("force", "N"),),
        "provenance": Provenance(
            "cartpole", {"limit": float("inf")}, "weak", 2**70, "2024-05-31T12:00", ("a note",)
        ),
        "outcome": Outcome.FAILURE,
        "costs": single(steps),
        "failure_step": 3,
    }
    return Trajectory(**(fields | changes))


def three():
    return Dataset(
        [
            make(),
            make(steps=20_000, seed=1, costs=None, outcome=Outcome.UNKNOWN),
            make(steps=1, seed=2, failure_step=None, outcome=Outcome.SUCCESS),
        ]
    )


def as_published(folder, version, successes=(False, True), rows=6, **changes):
    """Lay out a data set as LeRobot's documentation does, with pyarrow and json alone."""
    rng = np.random.default_rng(0)
    vector = pa.list_(pa.float32(), 2)
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": NAMES}},
        "observation.images.top": {"dtype": "video", "shape": [3, 8, 8], "names": ["c", "h", "w"]},
        "action": {"dtype": "float32", "shape": [2], "names": NAMES},
        "next.reward": {"dtype": "float32", "shape": [1], "names": None},
        "next.success": {"dtype": "bool", "shape": [1], "names": None},
    } | {
        key: {"dtype": dtype, "shape": [1], "names": None}
        for key, dtype in (
            ("timestamp", "float32"),
            ("frame_index", "int64"),
            ("episode_index", "int64"),
            ("index", "int64"),
            ("task_index", "int64"),
        )
    }
    tables = []
    for index, success in enumerate(successes):
        last = np.arange(rows) == rows - 1
        state, action = rng.normal(size=(2, rows, 2)).astype(np.float32)
        columns = {
            "observation.state": pa.array(list(state), vector),
            "action": pa.array(list(action), vector),
            "next.reward": pa.array(rng.normal(size=rows).astype(np.float32)),
            "next.success": pa.array(last & success),
            "timestamp": pa.array((np.arange(rows) / 30).astype(np.float32)),
            "frame_index": pa.array(np.arange(rows)),
            "episode_index": pa.array(np.full(rows, index)),
            "index": pa.array(index * rows + np.arange(rows)),
            "task_index": pa.array(np.zeros(rows, int)),
        }
        tables.append(pa.table(columns))
    meta = folder / "meta"
    meta.mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    info = {
        "codebase_version": version,
        "robot_type": "so100",
        "total_episodes": len(tables),
        "total_frames": rows * len(tables),
        "fps": 30,
        "features": features,
    }
    (meta / "info.json").write_text(json.dumps(info | changes))
    if version == "v2.1":
        for index, table in enumerate(tables):
            pq.write_table(table, folder / f"data/chunk-000/episode_{index:06d}.parquet")
        (meta / "tasks.jsonl").write_text('{"task_index": 0, "task": "Pick the cube"}\n')
    else:
        pq.write_table(pa.concat_tables(tables), folder / "data/chunk-000/file-000.parquet")
        tasks = pa.table({"task_index": [0], "__index_level_0__": ["Pick the cube"]})
        pq.write_table(tasks, meta / "tasks.parquet")
    return tables


# Out and back


@pytest.mark.parametrize("format", VERSIONS.values())
def test_round_trip(tmp_path, format):
    path = tmp_path / "d.lerobot"
    dataset = three()
    save_dataset(dataset, path, format=format)
    assert load_dataset(path) == dataset
    save_dataset(dataset[:1], path, format=format)  # in place of what was there
    assert load_dataset(path) == dataset[:1]
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_what_is_lost_is_said(tmp_path):
    trajectory = make(observations=np.full((6, 2), 1 / 3))
    path = tmp_path / "d.lerobot"
    save_dataset(Dataset([trajectory]), path)
    assert load_dataset(path)[0].observations[0, 0] == np.float32(1 / 3)
    (line,) = FORMATS["lerobot"].losses(next(read_episodes(path)).header)
    assert "float32" in line


@pytest.mark.parametrize(("version", "format"), VERSIONS.items())
def test_what_is_written_is_as_published(tmp_path, version, format):
    dataset = three()
    path = tmp_path / "d.lerobot"
    save_dataset(dataset, path, format=format)
    info = json.loads((path / "meta/info.json").read_text())
    assert info["codebase_version"] == version
    assert info["fps"] == 50
    assert info["total_episodes"] == 3
    assert info["total_frames"] == 20_009
    assert info["splits"] == {"train": "0:3"}
    assert info["features"]["observation.state"] == {
        "dtype": "float32",
        "shape": [2],
        "names": ["x", "theta"],
    }
    files = sorted(path.glob("data/chunk-000/*.parquet"))
    names = [f"episode_00000{i}" for i in range(3)] if version == "v2.1" else ["file-000"]
    assert [file.stem for file in files] == names
    table = pa.concat_tables(pq.read_table(file) for file in files)
    assert table.schema.field("observation.state").type == pa.list_(pa.float32(), 2)
    assert table.schema.field("action").type == pa.float32()  # as LeRobot keeps shape [1]
    assert set(table.schema.names) == set(info["features"])
    assert table["index"].to_pylist() == list(range(20_009))
    start = 0
    for index, trajectory in enumerate(dataset):
        rows = table.slice(start, trajectory.n_steps + 1)
        start += len(rows)
        assert set(rows["episode_index"].to_pylist()) == {index}
        assert rows["frame_index"].to_pylist() == list(range(len(rows)))
        times = rows["timestamp"].to_numpy()
        np.testing.assert_allclose(times, np.arange(len(rows)) * 0.02, rtol=1e-6)
        state = np.stack(rows["observation.state"].to_numpy())
        np.testing.assert_array_equal(state, trajectory.observations)
        action = rows["action"].to_numpy()
        np.testing.assert_array_equal(action[:-1], trajectory.actions[:, 0])
        assert action[-1] == action[-2]
        done, success = rows["next.done"].to_numpy(), rows["next.success"].to_numpy()
        np.testing.assert_array_equal(done, np.arange(len(rows)) == len(rows) - 1)
        assert success.any() == (trajectory.outcome is Outcome.SUCCESS)
    check_statistics(path, version, table)


def check_statistics(path, version, table):
    """Compare what is said of the numbers with what numpy says."""

    def same(said, rows):
        rows = rows.reshape(len(rows), -1).astype(np.float64)
        for name, expected in (
            ("min", rows.min(0)),
            ("max", rows.max(0)),
            ("mean", rows.mean(0)),
            ("std", rows.std(0)),
            ("count", [len(rows)]),
        ):
            np.testing.assert_allclose(said[name], expected, rtol=1e-6, atol=1e-6)

    state = np.stack(table["observation.state"].to_numpy())
    if version == "v3.0":
        stats = json.loads((path / "meta/stats.json").read_text())
        assert set(stats) == set(table.schema.names)
        same(stats["observation.state"], state)
        same(stats["timestamp"], table["timestamp"].to_numpy())
        episodes = pq.read_table(path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
        lengths = [row["length"] for row in episodes]
        assert [row["dataset_from_index"] for row in episodes] == [0, *np.cumsum(lengths)[:-1]]
        assert [row["dataset_to_index"] for row in episodes] == list(np.cumsum(lengths))
        assert episodes[0]["tasks"] == ["cartpole"]
        key = "stats/observation.state/"
        said = {name: episodes[1][key + name] for name in ("min", "max", "mean", "std", "count")}
        same(said, state[6 : 6 + lengths[1]])
        tasks = pq.read_table(path / "meta/tasks.parquet")
        assert tasks.to_pylist() == [{"task_index": 0, "task": "cartpole"}]
        assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    else:
        lines = (path / "meta/episodes_stats.jsonl").read_text().splitlines()
        said = [json.loads(line) for line in lines]
        assert [each["episode_index"] for each in said] == [0, 1, 2]
        same(said[0]["stats"]["observation.state"], state[:6])
        lines = (path / "meta/episodes.jsonl").read_text().splitlines()
        first = {"episode_index": 0, "tasks": ["cartpole"], "length": 6}
        assert json.loads(lines[0]) == first


# What others wrote


@pytest.mark.parametrize("version", VERSIONS)
def test_a_folder_as_published(tmp_path, version):
    tables = as_published(tmp_path / "d", version)
    dataset = load_dataset(tmp_path / "d")
    assert [c.name for c in dataset.observation_columns] == NAMES
    assert [c.name for c in dataset.action_columns] == NAMES
    assert dataset.dt == 1 / 30
    assert [t.outcome for t in dataset] == [Outcome.FAILURE, Outcome.SUCCESS]
    for trajectory, table in zip(dataset, tables, strict=True):
        state, action = (np.stack(table[key].to_numpy()) for key in ("observation.state", "action"))
        np.testing.assert_array_equal(trajectory.observations, state)
        np.testing.assert_array_equal(trajectory.actions, action[:-1])
        np.testing.assert_array_equal(trajectory.costs, -table["next.reward"].to_numpy()[:-1])
        assert trajectory.provenance.system == "so100"
        assert trajectory.provenance.parameters == {"task": "Pick the cube"}
        assert any("last action" in note for note in trajectory.provenance.notes)
        assert any("images.top" in note for note in trajectory.provenance.notes)


def test_episodes_go_on_from_file_to_file(tmp_path):
    dataset = Dataset([make(steps=100, seed=i) for i in range(4)])
    path = tmp_path / "d.lerobot"
    save_dataset(dataset, path)
    whole = path / "data/chunk-000/file-000.parquet"
    table = pq.read_table(whole)
    for number, (start, stop) in enumerate([(0, 30), (30, 250), (250, len(table))]):
        pq.write_table(
            table.slice(start, stop - start), whole.with_name(f"file-{number + 9:03d}.parquet")
        )
    whole.unlink()
    assert load_dataset(path) == dataset


# What is refused


def test_refused(tmp_path, refused):
    path = tmp_path / "d"
    as_published(path, "v3.0", codebase_version="v1.6")
    with refused("codebase_version v1.6: 2.x and 3.x are read"):
        list(read_episodes(path, format="lerobot"))
    as_published(tmp_path / "e", "v3.0", total_episodes=3)
    with refused("info.json counts 3 episodes, but 2 are there"):
        load_dataset(tmp_path / "e")
    as_published(tmp_path / "f", "v2.1", fps=0)
    with refused("fps 0"):
        load_dataset(tmp_path / "f")
    with refused("--to-rate 30"):
        save_dataset(Dataset([replace(make(), dt=0.0333)]), tmp_path / "g.lerobot")
    assert not (tmp_path / "g.lerobot").exists()


def test_missing_rows_are_refused(tmp_path, refused):
    path = tmp_path / "d.lerobot"
    save_dataset(Dataset([make()]), path)
    file = path / "data/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    pq.write_table(pa.concat_tables([table.slice(0, 2), table.slice(3)]), file)
    with refused("frame_index is 3 where 2 comes next"):
        load_dataset(path)


def test_times_that_do_not_fit_are_noted(tmp_path):
    path = tmp_path / "d"
    as_published(path, "v3.0", fps=25)
    assert any("up to 0.0333 s off" in note for note in load_dataset(path)[0].provenance.notes)


def written(path, **options):
    """Write lists, numbers, texts and truth values as Parquet; return the file's bytes."""
    rng = np.random.default_rng(0)
    n = 500
    table = pa.table(
        {
            "observation.state": pa.array([list(rng.normal(size=14)) for _ in range(n)]),
            "action": pa.FixedSizeListArray.from_arrays(pa.array(rng.normal(size=3 * n)), 3),
            "next.reward": rng.normal(size=n),
            "task": ["text" * (i % 7) for i in range(n)],
            "next.done": rng.random(n) > 0.5,
        }
    )
    pq.write_table(table, path, **options)
    return path.read_bytes()


OPTIONS = [{}, {"row_group_size": 37}, {"version": "1.0"}, {"write_page_index": True}]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_a_footer_says_what_pyarrow_says(tmp_path, options):
    written(tmp_path / "f.parquet", **options)
    metadata = pq.ParquetFile(tmp_path / "f.parquet").metadata
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    assert [tuple(part) for part in column_parts(tmp_path / "f.parquet")] == [
        (column.path_in_schema, group.num_rows, column.num_values)
        for group in groups
        for column in map(group.column, range(group.num_columns))
    ]


def test_a_damaged_footer_is_refused_or_read(tmp_path):
    # pyarrow aborts the process on some of these, if it is asked for a column's metadata.
    path, rng = tmp_path / "f.parquet", np.random.default_rng(1)
    whole = written(path)
    length = int.from_bytes(whole[-8:-4], "little")
    refused = 0
    for _ in range(2000):
        data = bytearray(whole)
        for place in rng.integers(len(data) - 8 - length, len(data), rng.integers(1, 6)):
            data[place] = rng.integers(256)
        path.write_bytes(data)
        try:
            assert all(isinstance(part.values, int) for part in column_parts(path))
        except ValueError:
            refused += 1
    assert 200 < refused < 1900


@pytest.mark.parametrize("format", VERSIONS.values())
def test_nothing_stays_open_where_writing_is_refused(tmp_path, refused, format):
    dataset = [make(), make(action_columns=(Column("u", "N"),))]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with refused("episode_1 has action_columns u"):
            write_episodes(tmp_path / "a.lerobot", map(Episode.of, dataset), format)
        gc.collect()
    assert [str(warning.message) for warning in told] == []
