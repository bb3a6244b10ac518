import json
import os
import shutil
import subprocess
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from peak_memory import needs_status, run_with_peak

from misstep import formats
from misstep.errors import MisstepError
from misstep.formats import FORMATS, append_trajectory, format, load_dataset, save_dataset
from misstep.formats.format import Block, Ending, Episode, Header
from misstep.formats.hdf5.arrays import RowReader
from misstep.trajectory import Column, Dataset, Outcome, Provenance, Trajectory

COLUMNS = (Column("x", "m"), Column("theta", "rad"))
FORCE = (Column("force", "N"),)
PACKING = {"compression": "gzip", "shuffle": True}


def make(n_steps=4, seed=0, **changes):
    rng = np.random.default_rng(seed)
    fields = {
        "observations": rng.normal(size=(n_steps + 1, 2)),
        "actions": rng.normal(size=(n_steps, 1)),
        "dt": 0.02,
        "observation_columns": COLUMNS,
        "action_columns": FORCE,
        "provenance": Provenance("cartpole", {"mass": 0.5, "limit": float("inf")}, "noisy", 7, ""),
        "costs": rng.random(n_steps),
    }
    return Trajectory(**{**fields, **changes})


def type_of_parameters(dataset):
    return [{k: type(v) for k, v in t.provenance.parameters.items()} for t in dataset]


# Round trips

texts = st.text(st.characters(exclude_categories=("C", "Z")), max_size=8)
numbers = st.floats(allow_nan=False, allow_infinity=False)
values = st.one_of(
    st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), texts
)
provenances = st.builds(
    Provenance,
    texts,
    st.dictionaries(texts, values, max_size=4),
    texts,
    st.none() | st.integers(0, 2**128 - 1),
    st.just("") | st.datetimes().map(lambda t: t.isoformat()),
    st.lists(texts, max_size=3).map(tuple),
)


def columns(count):
    names = st.lists(texts.filter(bool), min_size=count, max_size=count, unique=True)
    return st.builds(lambda names, unit: tuple(Column(name, unit) for name in names), names, texts)


@st.composite
def datasets(draw):
    n, m = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    dt = draw(st.floats(1e-300, 1e300))
    observation_columns, action_columns = draw(columns(n)), draw(columns(m))
    trajectories = []
    for _ in range(draw(st.integers(1, 3))):
        steps = draw(st.sampled_from([1, 2, 3, 7, 600]))
        fill = {"elements": numbers, "fill": numbers}
        trajectories.append(
            Trajectory(
                draw(hnp.arrays(float, (steps + 1, n), **fill)),
                draw(hnp.arrays(float, (steps, m), **fill)),
                dt,
                observation_columns,
                action_columns,
                draw(provenances),
                draw(st.sampled_from(Outcome)),
                draw(st.none() | hnp.arrays(float, steps, **fill)),
                draw(st.none() | st.integers(0, steps)),
            )
        )
    return Dataset(trajectories)


@settings(max_examples=40, deadline=None)
@given(datasets())
def test_round_trip_is_exact(tmp_path_factory, dataset):
    folder = tmp_path_factory.mktemp("round")
    save_dataset(dataset, folder / "whole.h5")
    for trajectory in dataset:
        append_trajectory(folder / "grown.hdf5", trajectory)
    for path in (folder / "whole.h5", folder / "grown.hdf5"):
        loaded = load_dataset(path)
        assert loaded == dataset
        assert type_of_parameters(loaded) == type_of_parameters(dataset)
    assert sorted(os.listdir(folder)) == ["grown.hdf5", "whole.h5"]


def test_equal_datasets_give_equal_files(tmp_path):
    trajectories = [make(n, seed=n) for n in (1, 30, 900, 5, 6, 7, 8, 9, 10, 11)]
    save_dataset(Dataset(trajectories), tmp_path / "a.h5")
    time.sleep(1.1)  # HDF5 keeps times in whole seconds
    save_dataset(Dataset(trajectories), tmp_path / "b.h5")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_many_episodes_come_back_in_their_order(tmp_path):
    dataset = Dataset(make(1, seed=i) for i in range(120))  # episode_10 sorts before episode_2
    save_dataset(dataset, tmp_path / "many.h5")
    assert load_dataset(tmp_path / "many.h5") == dataset


def blocks_of(trajectory, sizes):
    """Cut a trajectory into blocks whose observations, actions and costs end at other rows."""
    arrays = [trajectory.observations, trajectory.actions, trajectory.costs]
    at = [0, 0, 0]
    while any(start < len(array) for start, array in zip(at, arrays, strict=True)):
        parts = []
        for i, array in enumerate(arrays):
            size = next(sizes)
            parts.append(array[at[i] : at[i] + size])
            at[i] += size
        yield Block(*parts)


def as_episode(trajectory, rng, most=9000):
    header = Header(trajectory.dt, COLUMNS, FORCE, trajectory.provenance)
    sizes = iter(lambda: int(rng.integers(0, most)), None)
    ending = Ending(trajectory.outcome, trajectory.failure_step, ("a note",))
    return Episode(header, blocks_of(trajectory, sizes), lambda: ending)


@pytest.mark.parametrize("steps", [3, 999, 32_767, 32_768, 65_536, 65_537, 200_000])
def test_blocks_of_any_size_make_the_same_episode(tmp_path, steps):
    rng = np.random.default_rng(steps)
    trajectory = make(steps, outcome="failure", failure_step=steps)
    streamed, whole = tmp_path / "streamed.h5", tmp_path / "whole.h5"
    formats.write_episodes(streamed, [as_episode(trajectory, rng)])
    noted = replace(trajectory, provenance=replace(trajectory.provenance, notes=("a note",)))
    save_dataset(Dataset([noted]), whole)
    assert load_dataset(streamed) == load_dataset(whole) == Dataset([noted])
    with h5py.File(streamed) as file:  # as any other program reads it
        episode = file["episode_0"]
        np.testing.assert_array_equal(episode["observations"][:], trajectory.observations)
        np.testing.assert_array_equal(episode["rewards"][:], -trajectory.costs)
        assert np.flatnonzero(episode["terminations"][:]).tolist() == [steps - 1]
        rows = min(2**15, steps + 1)
        assert episode["observations"].chunks == (None if steps < 500 else (rows, 2))


def test_numbers_that_cannot_be_deflated_come_back(tmp_path):
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 2**63, size=(100_001, 2), dtype=np.uint64).view(float)
    bits[~np.isfinite(bits)] = 0.0
    dataset = Dataset([make(100_000, observations=bits), make(9_999, observations=bits[:10_000])])
    assert load_dataset(saved(tmp_path, dataset)) == dataset


def test_a_file_of_the_first_version_reads_the_same(tmp_path):
    # Before there were chunks of rows, an array of more than 1,000 elements was one chunk.
    trajectory = make(100_000)
    path = saved(tmp_path, Dataset([trajectory]))
    with h5py.File(path, "r+") as file:
        for name in ARRAYS:
            values = file["episode_0"][name][()]
            del file["episode_0"][name]
            file["episode_0"].create_dataset(
                name, data=values, chunks=values.shape, compression="gzip", shuffle=True
            )
    assert load_dataset(path) == Dataset([trajectory])


def test_what_hdf5_cannot_hold_is_refused_before_it_is_written(tmp_path):
    even, path = as_episode(make(), np.random.default_rng(0)), tmp_path / "a.h5"
    header = even.header
    for changed, reason in (
        (replace(header, dt=None), "uneven times"),
        (replace(header, action_columns=()), "no actions"),
    ):
        with pytest.raises(MisstepError, match=reason):
            formats.write_episodes(path, [replace(even, header=changed)])
    with pytest.raises(MisstepError, match="no episode"):
        formats.write_episodes(path, [])
    assert os.listdir(tmp_path) == []


# The layout, read by h5py as any other program would


@pytest.mark.parametrize(
    ("outcome", "failure_step", "terminated"),
    [
        ("failure", 1000, True),
        ("failure", 999, False),
        ("failure", None, False),
        ("success", None, False),
        ("unknown", 1000, False),
    ],
)
def test_layout_is_minaris(tmp_path, outcome, failure_step, terminated):
    second = make(1000, seed=1, outcome=outcome, failure_step=failure_step)
    save_dataset(Dataset([make(3, costs=None), second]), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert set(file) == {"episode_0", "episode_1"}
        assert (file.attrs["total_episodes"], file.attrs["total_steps"]) == (2, 1003)
        assert not file["episode_0/rewards"][:].any()
        episode = file["episode_1"]
        assert (episode.attrs["id"], episode.attrs["total_steps"]) == (1, 1000)
        assert int(episode.attrs["seed"]) == 7
        assert isinstance(episode["infos"], h5py.Group)
        np.testing.assert_array_equal(episode["observations"][:], second.observations)
        np.testing.assert_array_equal(episode["actions"][:], second.actions)
        np.testing.assert_array_equal(episode["rewards"][:], -second.costs)
        ends = {name: episode[name][:] for name in ("terminations", "truncations")}
    for name, ended in (("terminations", terminated), ("truncations", not terminated)):
        assert ends[name].dtype == bool
        assert ends[name].tolist() == [False] * 999 + [ended]


def test_only_large_arrays_are_compressed(tmp_path):
    save_dataset(Dataset([make(1000, observations=np.zeros((1001, 2)))]), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        episode = file["episode_0"]
        assert episode["observations"].compression == "gzip"
        assert episode["observations"].id.get_storage_size() < 1000
        assert episode["actions"].chunks is None


@pytest.mark.parametrize("mask", [0, 1, 2, 3])
def test_filters_that_hdf5_left_out_are_left_out_in_reading(tmp_path, mask):
    dataset = Dataset([make(1000)])
    path = saved(tmp_path, dataset)
    plain = dataset[0].observations
    stored = plain.tobytes() if mask & 1 else plain.view("u1").reshape(-1, 8).T.tobytes()
    with h5py.File(path, "r+") as file:
        chunk = stored if mask & 2 else zlib.compress(stored)
        file["episode_0/observations"].id.write_direct_chunk((0, 0), chunk, mask)
    assert load_dataset(path) == dataset


# Refusals


def saved(tmp_path, dataset=None):
    path = tmp_path / "data.h5"
    save_dataset(dataset or Dataset([make(), make(5, seed=1)]), path)
    return path


def refused(path, reason):
    with pytest.raises(MisstepError, match=reason) as caught:
        load_dataset(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_suffix_lists_the_known_ones(tmp_path):
    for call in (
        lambda: load_dataset(tmp_path / "a.xls"),
        lambda: save_dataset(Dataset([make()]), tmp_path / "a.xls"),
        lambda: append_trajectory(tmp_path / "a.xls", make()),
    ):
        with pytest.raises(MisstepError, match=r"a\.xls: .*'\.xls'; there are: .*\.h5, \.hdf5"):
            call()
    with pytest.raises(MisstepError, match=r"no format named 'xls'; there are: .*csv.*hdf5"):
        load_dataset(tmp_path / "a.h5", "xls")
    assert FORMATS["hdf5"].suffixes == (".h5", ".hdf5")
    assert os.listdir(tmp_path) == []


def test_what_is_no_hdf5_file_is_refused(tmp_path):
    path = tmp_path / "a.h5"
    refused(path, "no such file")
    path.write_text("")
    refused(path, "is empty")
    path.write_text("x,theta\n1,2\n")
    refused(path, "not an HDF5 file")
    path.write_bytes(b"\x89HDF\r\n\x1a\n")
    refused(path, "damaged")
    path.unlink()
    path.mkdir()
    refused(path, "folder")
    with pytest.raises(MisstepError, match="folder"):
        save_dataset(Dataset([make()]), path)


def test_files_of_others_and_of_the_future_are_refused(tmp_path):
    path = saved(tmp_path)
    with h5py.File(path, "r+") as file:
        file.attrs["misstep_format"] = 2
    refused(path, "format version is 2 .* install a newer misstep")
    with h5py.File(path, "r+") as file:
        file.attrs["misstep_format"] = 0
    refused(path, "format version is 0")
    with h5py.File(path, "r+") as file:
        del file.attrs["misstep_format"]
    refused(path, "not of misstep's")


ARRAYS = ("observations", "actions", "rewards", "terminations", "truncations")


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_that_do_not_fit_are_refused(tmp_path, name):
    original = saved(tmp_path)
    path = tmp_path / "changed.h5"

    def with_array(**changes):
        shutil.copy(original, path)
        with h5py.File(path, "r+") as file:
            del file["episode_1"][name]
            if changes:
                file["episode_1"].create_dataset(name, **changes)

    with h5py.File(original) as file:
        good = file["episode_1"][name][()]
    with_array()
    refused(path, f"episode_1: {name} is missing")
    with_array(data=good[:-1])
    refused(path, f"episode_1: {name} has shape")
    with_array(data=good.ravel()[0])
    refused(path, rf"episode_1: {name} has shape \(\)")
    with_array(dtype=good.dtype)
    refused(path, f"episode_1: {name} has shape None")
    with_array(data=good.astype(np.float32))
    refused(path, f"episode_1: {name} has dtype float32")
    with_array(shape=good.shape, dtype=h5py.ref_dtype)
    refused(path, f"episode_1: {name} has dtype object")
    with_array(shape=good.shape, dtype=h5py.string_dtype())
    refused(path, f"episode_1: {name} has dtype object")
    with_array(shape=(2**50, *good.shape[1:]), dtype=good.dtype, chunks=(1, *good.shape[1:]))
    refused(path, f"episode_1: {name} has shape")
    with_array(shape=good.shape, dtype=good.dtype, chunks=good.shape, compression="gzip")
    refused(path, f"episode_1: {name} is stored in another way")
    with_array(data=good, chunks=(1, *good.shape[1:]), compression="gzip", shuffle=True)
    refused(path, f"episode_1: {name} is stored in another way")
    with_array(data=good, chunks=good.shape, compression="lzf", shuffle=True)
    refused(path, f"episode_1: {name} is stored in another way")
    with_array(data=good)
    assert load_dataset(path) == load_dataset(original)


@pytest.mark.parametrize("name", ["episode_1", "episode_1/actions"])
def test_links_to_elsewhere_are_refused(tmp_path, name):
    original, path = saved(tmp_path), tmp_path / "changed.h5"
    for link in (
        h5py.ExternalLink(str(original), "/" + name),
        h5py.SoftLink("/" + name.replace("1", "0")),
        h5py.SoftLink("/nowhere"),
    ):
        shutil.copy(original, path)
        with h5py.File(path, "r+") as file:
            del file[name]
            file[name] = link
        refused(path, "is a link to elsewhere")


def test_groups_in_place_of_arrays_are_refused(tmp_path):
    path = saved(tmp_path)
    with h5py.File(path, "r+") as file:
        del file["episode_1/actions"]
        file.create_group("episode_1/actions")
    refused(path, "episode_1: actions is not a dataset")
    with h5py.File(path, "r+") as file:
        del file["episode_0"]
        file["episode_0"] = 3.0
    refused(path, "h5: episode_0 is not a group")


def test_arrays_outside_the_file_are_refused(tmp_path):
    original, path = saved(tmp_path), tmp_path / "changed.h5"
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(1000))
    layout = h5py.VirtualLayout((4, 1), "f8")
    layout[:] = h5py.VirtualSource(str(original), "episode_0/actions", (4, 1))
    for make_array in (
        lambda g: g.create_virtual_dataset("actions", layout),
        lambda g: g.create_dataset("actions", (4, 1), "f8", external=[(str(secret), 0, 32)]),
    ):
        shutil.copy(original, path)
        with h5py.File(path, "r+") as file:
            del file["episode_0/actions"]
            make_array(file["episode_0"])
        refused(path, "lies in another file")


def test_values_that_are_not_finite_are_named(tmp_path):
    path = saved(tmp_path)
    with h5py.File(path, "r+") as file:
        file["episode_1/observations"][3, 1] = np.nan
    refused(path, "episode_1: observations row 3, column 'theta' is nan")


@pytest.mark.parametrize(
    ("owner", "name", "value", "reason"),
    [
        ("/", "dt", -1.0, "dt is -1.0"),
        ("/", "dt", "0.02", "attribute dt is not a single"),
        ("/", "dt", [0.1, 0.2], "attribute dt is not a single"),
        ("/", "observation_columns", np.bytes_(b"[[1, 2]]"), "the name of a column is 1"),
        ("/", "observation_columns", np.bytes_(b'["xy"]'), "pairs"),
        ("/", "observation_columns", np.bytes_(b"[" * 60000), "observation_columns is damaged"),
        ("/", "action_columns", np.bytes_(b'[["f"'), "attribute action_columns is damaged"),
        ("/", "total_episodes", 3, "total_episodes is 3 but there are 2"),
        ("/", "total_episodes", 2**63 - 1, "total_episodes is"),
        ("/", "total_steps", 10, "total_steps counts 1 steps more"),
        ("/", "total_steps", 8, "episode_1: total_steps is 5"),
        ("/", "total_steps", 2**62, "total_steps counts .* steps more"),
        ("episode_1", "total_steps", 4, r"terminations has shape \(5,\): it has to be \(4,\)"),
        ("episode_1", "total_steps", 0, "total_steps is 0"),
        ("episode_1", "outcome", np.bytes_(b"won"), "outcome is 'won'; there are"),
        ("episode_1", "outcome", np.bytes_(b"\xff"), "attribute outcome is damaged"),
        ("episode_1", "outcome", "failure", "outcome is not a single number or text of fixed"),
        ("episode_1", "failure_step", 6, "failure_step is 6"),
        ("episode_1", "failure_step", True, "failure_step is True"),
        ("episode_1", "seed", -1, "seed is -1"),
        ("episode_1", "seed", np.bytes_(b"x"), "attribute seed is damaged"),
        ("episode_1", "seed", np.bytes_(b"9" * 6000), "attribute seed is damaged"),
        ("episode_1", "costs_recorded", 1, "attribute costs_recorded is 1"),
        ("episode_1", "time", np.bytes_(b"noon"), "ISO 8601"),
        ("episode_1", "parameters", np.bytes_(b"[1]"), "parameters is"),
        ("episode_1", "parameters", np.bytes_(b'{"a": NaN}'), "parameter 'a' is nan"),
    ],
)
def test_attributes_that_do_not_fit_are_refused(tmp_path, owner, name, value, reason):
    path = saved(tmp_path)
    with h5py.File(path, "r+") as file:
        file[owner].attrs[name] = value
    refused(path, reason)


@pytest.mark.parametrize("owner", ["/", "episode_0"])
def test_missing_attributes_are_named(tmp_path, owner):
    original, path = saved(tmp_path), tmp_path / "changed.h5"
    with h5py.File(original) as file:
        names = set(file[owner].attrs) - {"misstep_format", "id", "seed"}
    assert len(names) >= 5
    for name in names:
        shutil.copy(original, path)
        with h5py.File(path, "r+") as file:
            del file[owner].attrs[name]
        refused(path, f"attribute {name} is missing")


@needs_status
def test_a_bomb_is_refused_before_it_takes_memory(tmp_path):
    path = saved(tmp_path, Dataset([make(20_000)]))
    packer = zlib.compressobj(9)
    bomb = b"".join(packer.compress(bytes(2**20)) for _ in range(300)) + packer.flush()
    with h5py.File(path, "r+") as file:
        observations = file["episode_0/observations"]
        assert len(bomb) < observations.nbytes < 1e6  # so that only inflating it tells
        observations.id.write_direct_chunk((0, 0), bomb)
    code = (
        "from misstep.formats import load_dataset\n"
        "before = peak()\n"
        "try:\n    load_dataset(sys.argv[1])\nexcept ValueError as error:\n    print(error)\n"
        "print(peak() - before)"
    )
    reason, grown = run_with_peak(code, path)
    assert "longer or shorter" in reason
    assert int(grown) < 50_000  # KiB; 300 MiB would have been made


def test_what_is_too_large_for_memory_is_read_block_by_block(tmp_path, monkeypatch):
    path = saved(tmp_path, Dataset([make(5000), make(5000, seed=1)]))
    for bound, where in ((100_000, "episode_0: it takes"), (200_000, "h5: it takes")):
        monkeypatch.setattr(format, "LARGEST_IN_MEMORY", bound)
        monkeypatch.setattr(formats, "LARGEST_IN_MEMORY", bound)
        refused(path, f"{where} up more than {bound} bytes in memory")
    rows = [sum(len(b.observations) for b in e.blocks) for e in formats.read_episodes(path)]
    assert rows == [5001, 5001]


def test_a_piece_that_claims_gigabytes_is_refused(tmp_path):
    shape = (2**28, 2)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", shape, "<f8", chunks=(*shape[:1], 1), compression="gzip")
        file.create_dataset("y", shape, "<f8", chunks=(2**27, 2), compression="gzip", shuffle=True)
        file.create_dataset("z", (2**27 + 1, 2), "<f8", chunks=(2**27 + 1, 2), **PACKING)
        for name, reason in (("x", "another way"), ("y", "another way"), ("z", "in one piece")):
            with pytest.raises(MisstepError, match=reason):
                RowReader(file, name, file[name].shape, np.dtype("<f8"))


def test_a_file_that_is_open_elsewhere_can_be_read_and_replaced(tmp_path):
    path = saved(tmp_path)
    for mode in ("r", "r+"):
        with h5py.File(path, mode):
            append_trajectory(path, make())
            assert load_dataset(path)[-1] == make()
            save_dataset(Dataset([make(2)]), path)
            assert load_dataset(path) == Dataset([make(2)])


def test_too_long_an_attribute_is_not_written(tmp_path):
    provenance = Provenance("s", {"a": "x" * 70_000}, "d", None, "")
    with pytest.raises(MisstepError, match="attribute parameters would take up"):
        save_dataset(Dataset([make(provenance=provenance)]), tmp_path / "a.h5")
    assert os.listdir(tmp_path) == []


def test_append_wants_the_same_kind(tmp_path):
    path = saved(tmp_path)
    before = path.read_bytes()
    for changes, line in (
        ({"dt": 0.01}, "episode_2 has dt 0.01"),
        ({"action_columns": (Column("u", "N"),)}, "has action_columns u"),
    ):
        with pytest.raises(MisstepError, match=line):
            append_trajectory(path, make(**changes))
    assert path.read_bytes() == before


# Damage


def test_truncated_files_are_refused(tmp_path):
    whole = saved(tmp_path, Dataset([make(5), make(700, costs=None)])).read_bytes()
    path = tmp_path / "cut.h5"
    for size in range(0, len(whole), 97):
        path.write_bytes(whole[:size])
        refused(path, "empty|not an HDF5|damaged")
        before = path.read_bytes()
        with pytest.raises(MisstepError):
            append_trajectory(path, make())
        assert path.read_bytes() == before


APPEND_FOREVER = """
import sys
import numpy as np
from misstep.formats import append_trajectory
from misstep.trajectory import Column, Provenance, Trajectory

i = int(sys.argv[2])
while True:
    trajectory = Trajectory(
        np.full((400, 3), float(i)), np.full((399, 1), float(i)), 0.02,
        tuple(Column(name, "m") for name in "abc"), (Column("u", "N"),),
        Provenance("s", {}, "d", i, ""),
    )
    append_trajectory(sys.argv[1], trajectory)
    print(i, flush=True)
    i += 1
"""


def test_a_process_killed_while_it_appends_leaves_a_prefix(tmp_path):
    path = tmp_path / "growing.h5"
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(6):
        with subprocess.Popen(
            [sys.executable, "-c", APPEND_FOREVER, str(path), str(held)], stdout=subprocess.PIPE
        ) as process:
            first = process.stdout.readline()
            time.sleep(rng.uniform(0, 0.1))
            process.kill()
            told = [int(line) for line in (first + process.stdout.read()).split(b"\n") if line]
        dataset = load_dataset(path)
        held = len(dataset)
        assert [t.provenance.seed for t in dataset] == list(range(held))
        assert [t.observations[-1, -1] for t in dataset] == list(range(held))
        assert held - 1 in (told[-1], told[-1] + 1)  # what was told is kept
    assert [p.name for p in Path(tmp_path).glob("*.h5")] == ["growing.h5"]


FILL_THE_DISK = """
import resource, sys
from misstep.formats import append_trajectory, load_dataset, save_dataset

path = sys.argv[1]
dataset = load_dataset(path)
room = int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))  # as a full disk, for one process
for call in (lambda: save_dataset(dataset, path), lambda: append_trajectory(path, dataset[0])):
    try:
        call()
    except ValueError as error:
        print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits on the size of files")
@pytest.mark.parametrize("room", [0, 100, 5_000, 40_000])
def test_a_full_disk_leaves_the_old_file(tmp_path, room):
    dataset = Dataset([make(5000)])
    path = saved(tmp_path, dataset)
    done = subprocess.run(
        [sys.executable, "-c", FILL_THE_DISK, str(path), str(room)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert [line.count("File too large") for line in done.stdout.splitlines()] == [1, 1]
    assert load_dataset(path) == dataset
    assert os.listdir(tmp_path) == [path.name]


def test_parameters_are_json(tmp_path):
    with h5py.File(saved(tmp_path)) as file:
        text = file["episode_0"].attrs["parameters"]
    assert json.loads(text) == {"mass": 0.5, "limit": float("inf")}
