import csv
import io
import os
import subprocess
import sys
from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from peak_memory import needs_status, run_with_peak

from misstep import Column, Dataset, MisstepError, Outcome, Provenance, Trajectory
from misstep.formats import (
    ReadOptions,
    append_trajectory,
    format_of,
    format_to_read,
    load_dataset,
    read_episodes,
    save_dataset,
    write_episodes,
)
from misstep.formats.format import Block, Ending, Episode, Header, joined
from misstep.inspection import inspect_file

SUFFIXES = ("csv", "tsv", "parquet")
COLUMNS = (Column("x", "m"), Column("theta", "rad"))


def make(n_steps=4, seed=0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "observations": rng.normal(size=(n_steps + 1, 2)),
        "actions": rng.normal(size=(n_steps, 1)),
        "dt": 0.02,
        "observation_columns": COLUMNS,
        "action_columns": (Column("force", "N"),),
        "provenance": Provenance("cartpole", {"limit": float("inf")}, "noisy", 2**70, "", ("n",)),
        "costs": rng.random(n_steps),
    }
    return Trajectory(**{**fields, **changes})


def read(path, **options):
    """Return header, joined block and ending of every episode of a file."""
    found = []
    for episode in read_episodes(path, ReadOptions(**options)):
        block = joined(episode)
        found.append((episode.header, block, episode.ending()))
    return found


@pytest.fixture
def table(tmp_path):
    def write(text, name="a.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


# Round trips

texts = st.text(st.characters(exclude_categories=("C", "Z"), exclude_characters="[]"), max_size=8)
names = texts.filter(bool) | st.sampled_from(
    ["time", "t", "episode", "cost", "misstep", "action:x"]
)
numbers = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def trajectories(draw, observation_columns, action_columns):
    steps = draw(st.sampled_from([1, 2, 3, 50]))

    def array(*shape):
        values = st.lists(numbers, min_size=int(np.prod(shape)), max_size=int(np.prod(shape)))
        return np.reshape(draw(values), shape)

    return Trajectory(
        array(steps + 1, len(observation_columns)),
        array(steps, len(action_columns)),
        draw(st.just(0.02)),
        observation_columns,
        action_columns,
        Provenance(draw(texts), {"p": draw(numbers | texts)}, draw(texts), None, ""),
        draw(st.sampled_from(Outcome)),
        array(steps) if draw(st.booleans()) else None,
        draw(st.none() | st.integers(0, steps)),
    )


@st.composite
def datasets(draw):
    def columns(count):
        unique = draw(st.lists(names, min_size=count, max_size=count, unique=True))
        return tuple(Column(name, draw(texts)) for name in unique)

    observed, done = columns(draw(st.integers(1, 3))), columns(draw(st.integers(1, 2)))
    return Dataset(draw(st.lists(trajectories(observed, done), min_size=1, max_size=3)))


@settings(max_examples=40)
@given(datasets())
def test_round_trip_is_exact(tmp_path_factory, dataset):
    folder = tmp_path_factory.mktemp("round")
    for suffix in SUFFIXES:
        path = folder / f"a.{suffix}"
        save_dataset(dataset, path)
        assert load_dataset(path) == dataset
        assert [p.name for p in folder.iterdir()] == [path.name]
        path.unlink()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_many_rows_come_back_whatever_the_blocks(tmp_path, suffix):
    dataset = Dataset([make(40_000, costs=None), make(3, seed=1), make(30_000, seed=2)])
    path = tmp_path / f"a.{suffix}"
    save_dataset(dataset, path)
    assert load_dataset(path) == dataset

    def cut(trajectory, size):
        blocks = [
            Block(
                trajectory.observations[i : i + size],
                trajectory.actions[i : i + size],
                None if trajectory.costs is None else trajectory.costs[i : i + size],
            )
            for i in range(0, trajectory.n_steps + 1, size)
        ]
        header = Episode.of(trajectory).header
        return Episode(header, iter(blocks), lambda: Ending(Outcome.UNKNOWN))

    write_episodes(tmp_path / f"b.{suffix}", (cut(t, 777) for t in dataset))
    assert load_dataset(tmp_path / f"b.{suffix}") == dataset


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_appending_adds_one_at_the_end(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    for count in (1, 2, 3):
        append_trajectory(path, make(seed=count))
        assert load_dataset(path) == Dataset([make(seed=i + 1) for i in range(count)])
    before = path.read_bytes()
    with pytest.raises(MisstepError, match="has action_columns u"):
        append_trajectory(path, make(action_columns=(Column("u", "N"),)))
    assert path.read_bytes() == before


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_actions_may_come_before_the_observations(tmp_path, suffix):
    whole = make(4)
    blocks = [
        Block(whole.observations[:0], whole.actions, whole.costs),
        Block(whole.observations, whole.actions[:0], whole.costs[:0]),
    ]
    header, ending = Episode.of(whole).header, Episode.of(whole).ending
    path = tmp_path / f"a.{suffix}"
    write_episodes(path, [Episode(header, iter(blocks), ending)])
    assert load_dataset(path) == Dataset([whole])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_ending_is_asked_for_after_the_last_block(tmp_path, suffix):
    seen = 0

    def blocks():
        nonlocal seen
        for start in range(0, 20, 5):
            seen = start + 5
            yield Block(np.arange(start, seen)[:, None] * 1.0, np.empty((0, 0)))

    def ending():
        return Ending(Outcome.FAILURE, seen - 1)

    header = Header(0.1, COLUMNS[:1], (), Provenance("", {}, "person", None, ""))
    path = tmp_path / f"a.{suffix}"
    write_episodes(path, [Episode(header, blocks(), cache(ending))])
    ((_, block, ended),) = read(path)
    assert len(block.observations) == 20
    assert (ended.outcome, ended.failure_step) == (Outcome.FAILURE, 19)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_recordings_without_actions_or_clock_come_back(tmp_path, suffix):
    header = Header(None, COLUMNS, (), Provenance("", {}, "person", None, ""))
    rng = np.random.default_rng(0)
    values, times = rng.normal(size=(20, 2)), np.cumsum(rng.random(20))
    blocks = [
        Block(values[i : i + 7], np.empty((0, 0)), None, times[i : i + 7]) for i in (0, 7, 14)
    ]
    ending = Ending(Outcome.FAILURE, 3, ("seen",))
    path = tmp_path / f"a.{suffix}"
    write_episodes(path, [Episode(header, iter(blocks), lambda: ending)])
    ((found, block, ended),) = read(path)
    assert found == header
    assert ended == ending
    np.testing.assert_array_equal(block.observations, values)
    np.testing.assert_array_equal(block.times, times)
    with pytest.raises(MisstepError, match="no actions were recorded"):
        load_dataset(path)


def test_a_table_is_what_other_programs_expect(tmp_path):
    dataset = Dataset([make(2), make(1, seed=1, costs=None)])
    for suffix in ("csv", "parquet"):
        save_dataset(dataset, tmp_path / f"a.{suffix}")
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:5] == ["episode", "time [s]", "x [m]", "theta [rad]", "action:force [N]"]
    assert [row["episode"] for row in rows] == ["0", "0", "0", "1", "1"]
    assert [float(row["x [m]"]) for row in rows[:3]] == dataset[0].column("x").tolist()
    assert [row["action:force [N]"] == "" for row in rows] == [False, False, True, False, True]
    columns = pq.read_table(tmp_path / "a.parquet").to_pydict()
    assert columns["episode"] == [0, 0, 0, 1, 1]
    assert columns["x [m]"][:3] == dataset[0].column("x").tolist()
    assert columns["cost"] == [*dataset[0].costs.tolist(), None, None, None]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_names_that_could_not_be_told_from_their_units_are_refused(tmp_path, suffix):
    bad = (Column("x", "m]"), Column("theta", "rad"))
    with pytest.raises(MisstepError, match="column 'x' in 'm]' could not be told apart"):
        save_dataset(Dataset([make(observation_columns=bad)]), tmp_path / f"a.{suffix}")
    assert os.listdir(tmp_path) == []


# Tables of others


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("1,2,9\n3,4,9\n5,6,9\n", {}),
        ("1,2,9\r\n3,4,9\r\n5,6,9", {}),
        ("\ufeffx,y,u\n1,2,9\n3,4,9\n5,6,9\n\n\n", {}),
        ("# by hand\n\n1 2 9\n3 4 9\n5 6 9\n", {}),
        ("1\t2\t9\n3\t4\t9\n5\t6\t9\n", {}),
        ('"x","y","u"\n"1","2","9"\n3,"4",9\n5,6,\n', {}),
        ("x;y;u\n1,0;2;9\n3;4,0;9\n5;6;9\n", {}),
        ("1;2;9\n+3;4e0;9\n5;6.;9\n", {}),
        ("1,2,9\n3,4,9\n5,6,9\n", {"named": False}),
        ("7,8,9\n1,2,9\n3,4,9\n5,6,9\n", {"named": True}),
    ],
)
def test_tables_of_many_makes_are_read(table, text, options):
    ((header, block, ending),) = read(table(text), rate=50.0, actions=("2",), **options)
    assert header.dt == 0.02
    assert [column.name for column in header.action_columns] == ["2"]
    assert block.observations.tolist() == [[1, 2], [3, 4], [5, 6]]
    assert block.actions.tolist() == [[9], [9]]
    assert ending.outcome is Outcome.UNKNOWN


def test_columns_are_found_by_name_and_position_and_the_others_are_noted(table):
    path = table(
        "stamp [ms],theta [deg],gyro,action:force [N],x\n0,1,2,3,4\n20,5,6,7,8\n40,9,1,,3\n"
    )
    ((header, block, _),) = read(path, observations=("x", "1"), time="stamp")
    assert header.observation_columns == (Column("x", ""), Column("1", "deg"))
    assert header.action_columns == (Column("force", "N"),)
    assert header.provenance.notes == ("columns left out: gyro",)
    assert block.observations.tolist() == [[4, 1], [8, 5], [3, 9]]
    assert block.actions.tolist() == [[3], [7]]
    np.testing.assert_allclose(block.times, [0, 0.02, 0.04])
    ((header, block, _),) = read(path, observations=("x",), time="0", time_unit="s")
    assert block.times.tolist() == [0, 20, 40]


def test_a_file_without_names_takes_them_in_order(table):
    path = table("0.0,1,2,3\n0.1,4,5,6\n")
    ((header, block, _),) = read(path, observations=("x", "theta"), actions=("u",), time="0")
    assert [column.name for column in header.observation_columns] == ["x", "theta"]
    assert block.observations.tolist() == [[1, 2], [4, 5]]
    assert block.actions.tolist() == [[3]]


@pytest.mark.parametrize("keys", ["1 1 1 2 2", "a a a b b", "1 1 1 a a", "5 5 5 -1 -1"])
def test_a_column_tells_episodes_apart(table, tmp_path, keys):
    path = table("run,x\n" + "".join(f"{k},{i}\n" for i, k in enumerate(keys.split())))
    typed = [float(k) if k.lstrip("-").isdigit() else k for k in keys.split()]
    if len({type(k) for k in typed}) == 1:
        pq.write_table(pa.table({"run": typed, "x": range(5)}), tmp_path / "a.parquet")
    for file in tmp_path.iterdir():
        found = read(file, rate=1.0, episode="run")
        assert [block.observations.ravel().tolist() for _, block, _ in found] == [[0, 1, 2], [3, 4]]
    assert path in tmp_path.iterdir()


def test_parquet_of_others_is_read(tmp_path):
    times = pa.array([0, 20_000, 40_000], pa.timestamp("us"))
    columns = {"t": times, "x": pa.array([1, 2, 3], pa.int32()), "on": [True, False, True]}
    pq.write_table(
        pa.table({**columns, "y": pa.array([1, 2, 3], pa.float32())}), tmp_path / "a.parquet"
    )
    ((header, block, _),) = read(tmp_path / "a.parquet")
    assert [column.name for column in header.observation_columns] == ["x", "on", "y"]
    np.testing.assert_allclose(block.times, [0, 0.02, 0.04])
    assert block.observations.tolist() == [[1, 1, 1], [2, 0, 2], [3, 1, 3]]
    pq.write_table(pa.table({"x": ["a", "b"]}), tmp_path / "b.parquet")
    with pytest.raises(MisstepError, match="column 'x' holds string: numbers are needed"):
        read(tmp_path / "b.parquet", rate=1.0)


# Refusals


@pytest.mark.parametrize(
    ("text", "options", "reason"),
    [
        ("", {}, "the file is empty"),
        ("\n\n# nothing\n", {}, "the file is empty"),
        ("x,y\n", {}, "there are no rows"),
        ("x,y\n1,2\n3\n", {}, "line 3 has 1 cells but the first has 2"),
        ("x,y\n1,2\n3,4,5\n", {}, "line 3 has 3 cells"),
        ("x,y\n1,2\n3,\n5,6\n", {}, "line 3, observation column 'y' is nan"),
        ("x,y\n1,2\n3,inf\n", {}, "line 3, observation column 'y' is inf"),
        ("x,y\n1,2\n3,nan\n", {}, "line 3, observation column 'y' is nan"),
        ("x,y\n1,2\n3,four\n", {}, "line 3, column 1 .*'four' is no number"),
        ("x,y\n1,2\n3,1_0\n", {}, "line 3, column 1 .*'1_0' is no number"),
        ("x,y\n1,2\n\n3,4\n", {}, "line 3 has 0 cells"),
        ("x,x\n1,2\n3,4\n", {}, "both named 'x'"),
        ("x,y\n1,2\n3,4\n", {"rate": None}, "give --rate in Hz, or name the column of times"),
        ("t,y\n1,2\n1,4\n", {"rate": None}, "line 3: time 1.0 s comes after 1.0 s"),
        (
            "t,y\n1,2\ninf,4\n",
            {"rate": None},
            "line 3: the time is inf s: every time has to be finite",
        ),
        ("t,y\n-inf,2\n1,4\n", {"rate": None}, "line 2: the time is -inf s"),
        (
            "s,y\n1,2\n2,4\n",
            {"rate": None, "time": "s", "time_unit": "h"},
            "there are: s, ms, us, ns",
        ),
        ("x,y\n1,2\n3,4\n", {"observations": ("z",)}, "no column 'z'; there are: x, y"),
        (
            "1,2\n3,4\n",
            {"observations": ("a", "b", "c")},
            "3 columns are wanted but the file has 2",
        ),
        ("1,2\n3,4\n", {"observations": ("0", "z")}, "say which by position, 0 to 1"),
        ("e,y\n1,2\n1,4\n2,1\n2,2\n1,3\n", {"episode": "e"}, "line 6: the episode goes on after"),
        ("e,y\n1,2\n,4\n", {"episode": "e"}, "line 3: the column of episodes is empty"),
        ("x,y\n1,2\n", {}, "it has 1 rows: an episode needs at least 2"),
        (b"x,y\n1,2\n\xff\xfe,3\n", {}, "line 3 is no text in UTF-8"),
        ('x,y\n1,2\n"3,4\n', {}, "line 3: "),
        ("x,misstep\n1,{}\n2,\n", {}, "line 2: misstep's annotation is damaged"),
        (
            'x,misstep\n1,"{""misstep"": 2}"\n2,\n',
            {},
            "line 2: misstep's annotation is of a newer misstep",
        ),
        (b"1," + b"1" * 3_000_000, {}, "more than 1048576 bytes"),
        (b"\x00" * 100, {}, "a.csv"),
        ("x," * 10_001 + "x\n", {}, "10002 columns: at most 10000"),
    ],
)
def test_bad_tables_are_refused_in_one_line(table, refused, text, options, reason):
    path = table(text)
    with refused(reason) as _:
        read(path, **{"rate": 50.0, **options})
    if options.get("rate", 50.0) is not None:
        with refused(r"a\.csv"):
            load_dataset(path)


def test_rows_taken_out_by_hand_are_noticed_where_a_step_is_numbered(tmp_path, refused):
    path = tmp_path / "a.csv"
    save_dataset(Dataset([make(20, outcome=Outcome.FAILURE, failure_step=20)]), path)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:5] + lines[8:]))
    with refused(r"a\.csv: episode_0: failure_step is 20, but there are 18 observations"):
        write_episodes(tmp_path / "b.h5", read_episodes(path))
    assert not (tmp_path / "b.h5").exists()
    with refused("failure_step is 20"):
        inspect_file(path)


def test_damage_in_the_middle_of_an_episode_is_told_in_one_line(tmp_path, refused):
    path = tmp_path / "a.parquet"
    save_dataset(Dataset([make(200_000)]), path)
    with pq.ParquetFile(path) as file:
        assert file.metadata.num_row_groups > 1
        at = file.metadata.row_group(file.metadata.num_row_groups - 1).column(2).data_page_offset
    with open(path, "r+b") as file:
        file.seek(at)
        file.write(b"\xff" * 400)
    with refused(r"a\.parquet: episode_0: it is damaged"):
        load_dataset(path)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_has_to_be_positive(refused, rate):
    with refused("the rate is .*: it has to be positive"):
        ReadOptions(rate=rate)


def test_a_rate_makes_up_for_times_that_are_no_numbers(table):
    path = table("timestamp,x,F\n12:00:00,1,2\n12:00:01,3,4\n12:00:02,5,6\n")
    ((header, block, _),) = read(path, rate=1.0, observations=("x",), actions=("F",))
    assert block.observations.tolist() == [[1], [3], [5]]
    assert header.dt == 1.0
    assert header.provenance.notes == ("columns left out: timestamp",)


def test_an_action_may_be_missing_in_the_last_row_only(table, refused):
    ((_, block, ending),) = read(table("x,action:u\n1,2\n3,\n"), rate=1.0)
    assert block.actions.tolist() == [[2]]
    assert ending.notes == ()
    ((_, _, ending),) = read(table("x,action:u\n1,2\n3,4\n"), rate=1.0)
    assert ending.notes == ("actions: that of the last row left out, it leads to no observation",)
    with refused("line 3, action column 'u' is nan"):
        read(table("x,action:u\n1,2\n3,\n5,6\n"), rate=1.0)


def test_gaps_can_be_asked_for(table):
    ((_, block, _),) = read(table("x,y\n1,\n3,4\n"), rate=1.0, keep_nan=True)
    np.testing.assert_array_equal(block.observations, [[1, np.nan], [3, 4]])


def test_a_line_is_named_however_far_down_it_is(table, refused):
    text = "x,y\n" + "1.25,2.5\n" * 300_000 + "1.25,oops\n" + "1.25,2.5\n" * 1000
    with refused("line 300002, column 1"):
        read(table(text), rate=1.0)


@needs_status
@pytest.mark.parametrize(
    ("suffix", "few", "many"),
    [("csv", 30_000, 150_000), ("parquet", 150_000, 600_000), ("h5", 150_000, 600_000)],
)
def test_memory_does_not_grow_with_the_file(tmp_path, suffix, few, many):
    code = (
        "from misstep.formats import *\n"
        "for path in sys.argv[1:]:\n"
        "    blocks = (b for e in read_episodes(path) for b in e.blocks)\n"
        "    print(sum(len(b.observations) for b in blocks), peak())\n"
    )
    for n_steps in (few, many):
        save_dataset(Dataset([make(n_steps, costs=None)]), tmp_path / f"{n_steps}.{suffix}")
    lines = run_with_peak(code, *(tmp_path / f"{n}.{suffix}" for n in (few, many)))
    (small, before), (large, after) = (map(int, line.split()) for line in lines)
    assert (small, large) == (few + 1, many + 1)
    # KiB. The additional numbers alone, without the text around them, would be this many.
    assert after - before < (many - few) * 5 * 8 / 1024


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits on the size of files")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_full_disk_leaves_the_old_file(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    save_dataset(Dataset([make(3)]), path)
    code = (
        "import resource, sys\nsys.path.insert(0, sys.argv[2])\n"
        "from test_tables import *\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "try:\n    save_dataset(Dataset([make(5000)]), sys.argv[1])\n"
        "except MisstepError as error:\n    print(error)\n"
    )
    folder = os.path.dirname(__file__)
    done = subprocess.run(
        [sys.executable, "-c", code, str(path), folder], capture_output=True, text=True
    )
    assert "File too large" in done.stdout
    assert load_dataset(path) == Dataset([make(3)])
    assert os.listdir(tmp_path) == [path.name]


# Which format


def test_a_format_is_chosen_by_name_or_suffix(table, refused):
    assert format_of("a.TSV") is format_of("b.csv")
    assert format_of("a", "parquet") is format_of("b.parquet")
    path = table("x\n1\n2\n", "log.txt")
    with refused("no format goes by the suffix '.txt'"):
        format_to_read(path)
    ((_, block, _),) = (
        (e.header, joined(e), e.ending()) for e in read_episodes(path, ReadOptions(rate=1.0), "csv")
    )
    assert block.observations.tolist() == [[1], [2]]
    with refused("the folder is of no known format"):
        list(read_episodes(path.parent))
    with refused("no such file"):
        list(read_episodes(path.parent / "b.csv"))


# Damage; the rest of it is up to tests/test_hostile.py


@given(st.text(st.sampled_from("0123456789.,;-+eE \t\n\r\"'#naif_x[]:{}é\x00"), max_size=80))
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(text.encode())
    try:
        found = read(path, rate=1.0)
    except MisstepError:
        return
    for _, block, _ in found:
        assert np.isfinite(block.observations).all()
        # What was read is what Python's own parser reads.
        cells = [c.strip() for row in csv.reader(io.StringIO(text)) for c in row]
        plain = {float(c) for c in cells if _is_float(c)}
        if ";" not in text and "\t" not in text and "," in text and "\r" not in text:
            assert set(block.observations.ravel().tolist()) <= plain


def _is_float(cell):
    try:
        float(cell)
    except ValueError:
        return False
    return True
