"""Hostile input: drawn by `scripts/fuzz.py`, kept in `tests/corpus`, or built here on purpose."""

import ast
import io
import json
import math
import os
import pickle
import subprocess
import sys
import zlib
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import misstep
from misstep import MisstepError, Outcome, load_run, make_system
from misstep.errors import _LONGEST
from misstep.formats import FORMATS, ReadOptions, load_dataset, read_episodes, save_dataset
from misstep.learners import LEARNERS
from misstep.live.downloads import upload_suffix
from misstep.live.protocol import parse
from misstep.study.spec import load_study
from misstep.trajectory import Column, Dataset, Provenance, Trajectory

SOURCE = Path(misstep.__file__).parent
SCRIPTS = Path(__file__).parents[1] / "scripts"
CORPUS = Path(__file__).parent / "corpus"


def make(steps=3):
    rng = np.random.default_rng(0)
    return Trajectory(
        observations=rng.normal(size=(steps + 1, 2)),
        actions=rng.normal(size=(steps, 1)),
        dt=0.02,
        observation_columns=(Column("x", "m"), Column("x_dot", "m/s")),
        action_columns=(Column("force", "N"),),
        provenance=Provenance("cartpole", {}, "weak", 7, ""),
        outcome=Outcome.FAILURE,
        costs=np.ones(steps),
        failure_step=2,
    )


def is_read(path, format):
    """Return whether a file is read; if not, it is refused in one printable line."""
    try:
        read(path, format=format)
    except MisstepError as error:
        message = str(error)
    else:
        return True
    assert message
    assert message.isprintable()
    return False


def read(path, options=None, format=None):
    for episode in read_episodes(path, options, format=format):
        for _ in episode.blocks:
            pass
        episode.ending()


# What a machine draws


def fuzzed(tmp_path, targets, cases):
    """Try cases of some targets in a process of its own; return their counts."""
    state = tmp_path / "counts.json"
    chosen = [word for target in targets for word in ("--target", target)]
    size = ["--cases", str(cases), "--slice", str(cases), "--state", str(state)]
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / "fuzz.py"), *chosen, *size], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(state.read_text())["targets"]


FUZZED = {
    "tables": (["csv", "csv-headerless", "parquet", "lerobot-v2.1", "lerobot-v3"], 200),
    "hdf5": (["hdf5", "robomimic", "minari-hdf5", "minari-arrow"], 100),
    "bags": (["rosbag", "rosbag2-sqlite3", "rosbag2-mcap"], 40),
    "settings": (["mapping", "formula", "parameters", "study"], 100),
    "messages": (["robot-codec", "robot-frames", "robot-session", "live-messages"], 100),
    "estimators": (["mixture", "donut-mixture", "donut"], 100),
}


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="the harness forks and reads /proc"
)
@pytest.mark.parametrize("what", FUZZED)
def test_hostile_input_is_taken_or_refused_in_one_line(tmp_path, what):
    targets, cases = FUZZED[what]
    counts = fuzzed(tmp_path, targets, cases)
    assert set(counts) == set(targets)
    for name, count in counts.items():
        assert (count["tried"], count["found"]) == (cases, []), name
        # Some of it goes deep, and some of it does harm.
        assert min(count["taken"], count["refused"]) > 0, name
        assert count["taken"] + count["refused"] == cases, name


def test_counts_of_another_seed_are_not_gone_on_with(tmp_path):
    state = tmp_path / "counts.json"
    state.write_text('{"seed": 1, "targets": {}}')
    words = ["--target", "formula", "--cases", "1", "--state", str(state)]
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / "fuzz.py"), *words], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "counts cases of seed 1, not of 0" in done.stderr


BROKEN = """
import sys, time
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from fuzzing import workers
from fuzzing.campaign import Campaign
from fuzzing.cases import Target

workers.LONGEST_CPU = 4.0

def opened(folder):
    def attempt(case):
        index = int(case.rng.bit_generator.seed_seq.entropy[2])
        if index == 1:
            raise KeyError("x")
        if index == 2:
            import os
            os.abort()
        while index == 3:
            pass
        if index == 4:
            return bool(bytearray(2**30 + 2**28))
        if index == 5:
            raise ValueError("no MisstepError")
        return index % 2 == 0
    return attempt

said = []
campaign = Campaign([Target("broken", 9, opened)], 0, None, Path(sys.argv[2]))
campaign.run(2, 100.0, 4, said.append)
"""


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="the harness forks and reads /proc"
)
def test_the_harness_finds_what_it_looks_for(tmp_path):
    state = tmp_path / "counts.json"
    command = [sys.executable, "-c", BROKEN, str(SCRIPTS), str(state)]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    count = json.loads(state.read_text())["targets"]["broken"]
    found = {finding["case"]: finding["what"] for finding in count["found"]}
    assert set(found) == {1, 2, 3, 4, 5}
    for case, words in ((1, "KeyError"), (2, "SIGABRT"), (3, "of computing"), (5, "ValueError")):
        assert words in found[case]
    assert "bytes of memory" in found[4] or "MemoryError" in found[4]
    # Case 4 was taken, and took too much.
    assert (count["tried"], count["taken"] + count["refused"], count["findings"]) == (9, 5, 5)


# What was found once

REFUSED = {
    "lerobot/lists-longer-than-said": "20000000 numbers in 20 rows",
    "mcap/array-of-texts-without-end.mcap": "100000000 parts",
    "mcap/definition-in-parentheses.mcap": "parentheses",
    "minari-arrow/metadata-of-an-episode-is-a-number": "no JSON object",
    "parquet/control-characters-in-the-error.parquet": r"don't know what type: \\x0f",
    "parquet/one-long-text-in-all-rows.parquet": None,
    "rosbag/array-of-nothing.bag": "a/msg/E, which is empty",
    "rosbag2/alias-of-an-alias": "YAML with an alias",
    "rosbag2/data-base-that-counts-for-ever": "'messages' in its data base is computed",
    "rosbag2/number-of-messages-is-a-text": "the number of its messages",
}


def test_the_corpus_is_small_and_whole():
    entries = {str(entry.relative_to(CORPUS)) for entry in CORPUS.glob("*/*")}
    assert entries == set(REFUSED)
    sizes = [file.stat().st_size for file in CORPUS.rglob("*") if file.is_file()]
    assert max(sizes) < 20_000
    assert sum(sizes) < 300_000


@pytest.mark.parametrize("entry", REFUSED)
def test_what_was_found_once_is_refused_now(refused, entry):
    kind = entry.partition("/")[0]
    options = ReadOptions(rate=50.0)
    if kind in ("mcap", "rosbag", "rosbag2"):
        options = ReadOptions(observations=("/a.x",))
    if REFUSED[entry] is None:
        read(CORPUS / entry, ReadOptions(rate=50.0, episode="episode"))
        return
    with refused(REFUSED[entry]):
        read(CORPUS / entry, options, kind)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 10**400])
@pytest.mark.parametrize("name", ["pole_mass", "control_rate", "duration"])
def test_numbers_that_are_none_are_refused(refused, name, value):
    with refused(f"{name} is .* but must be"):
        make_system("cartpole", **{name: value})


def test_numbers_that_physics_cannot_take_are_refused(refused):
    with refused("flipup: MuJoCo cannot build it with these parameters: .*mjMINVAL"):
        make_system("flipup", block_mass=1e-300)
    with refused("a number is wanted|is not from"):
        parse('{"t": "poke", "side": 1' + "0" * 400 + "}")


@pytest.mark.parametrize("system", ["cartpole", "flipup"])
@pytest.mark.parametrize(
    ("name", "value"),
    [("physics_step", 1e-300), ("control_rate", 1e-300), ("control_rate", 1e300)],
)
def test_time_that_nobody_can_simulate_is_refused(refused, system, name, value):
    with refused(f"{name} is .* but must be at (least|most)"):
        make_system(system, **{name: value})


@pytest.mark.parametrize(
    "build",
    [
        lambda: make_system("cartpole", duration=1e308),
        lambda: make_system("cartpole", delay=1e12),
        lambda: make_system("basket", longest_wait=1e308),
        lambda: make_system("cartpole", success="x > 1", hold=1e308),
        lambda: make_system("gym:Pendulum-v1", dt=5e-324),
        lambda: misstep.demonstrate(make_system("cartpole"), by="weak", delay=1e12),
        lambda: misstep.demonstrate(make_system("cartpole"), by="bang-bang", reaction_max=1e12),
        lambda: LEARNERS["donut-incremental"](outlook=1e12),
        lambda: LEARNERS["fall"](horizon=1e308),
        lambda: LEARNERS["dynamics"](trial_seconds=1e308),
        lambda: LEARNERS["mean"](resolution=1e300),
        lambda: LEARNERS["dynamics-policy"](rollouts=1e12),
    ],
)
def test_times_and_counts_that_no_memory_holds_are_refused(refused, build):
    with refused("must be .*at (least|most)"):
        build()


def test_an_error_is_one_printable_line_whatever_it_quotes():
    text = str(MisstepError("no column 'a\x1b[2J\nb\x00\u202e\ud800é'; " + "x" * 10**6))
    assert text.isprintable()
    assert text.startswith(r"no column 'a\x1b[2J b\x00\u202e\ud800é'; xxx")
    assert len(text) < _LONGEST + 50  # five signs became longer


# Nothing is executed

FORBIDDEN_MODULES = {
    *("pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"),
    *("dbm", "jsonpickle", "yaml", "xmlrpc", "telnetlib", "ftplib"),
}
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__", "execfile", "system", "popen"}
ALLOWED_CALLS = {
    ("robot/ros1/services.py", "exec"): "genpy's own code, of a definition in this package",
    ("robot/ros1/services.py", "compile"): "the same",
}


def called(node):
    """Return the last part of the name that is called."""
    function = node.func
    return getattr(function, "id", None) or getattr(function, "attr", "")


def owner(node):
    return getattr(getattr(node.func, "value", None), "id", "")


@pytest.mark.parametrize("file", sorted(SOURCE.rglob("*.py")), ids=lambda f: f.stem)
def test_no_pickle_and_no_evaluation_in_the_source(file):
    place = file.relative_to(SOURCE).as_posix()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names]
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.partition(".")[0] for name in names} & FORBIDDEN_MODULES
        elif isinstance(node, ast.Call):
            name = called(node)
            if name in FORBIDDEN_CALLS and owner(node) not in ("re", "platform"):
                is_method = isinstance(node.func, ast.Attribute) and name == "compile"
                assert is_method or (place, name) in ALLOWED_CALLS, f"{place}: {ast.unparse(node)}"
            keywords = {keyword.arg: keyword.value for keyword in node.keywords}
            if owner(node) == "np" and name in ("load", "save", "savez", "savez_compressed"):
                allow = keywords.get("allow_pickle")
                assert isinstance(allow, ast.Constant), ast.unparse(node)
                assert allow.value is False, ast.unparse(node)
            shell = keywords.get("shell")
            assert shell is None or getattr(shell, "value", True) is False


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.fixture
def mark(tmp_path):
    """Return a place, where in the end nobody may have made a folder."""
    place = tmp_path / "executed"
    yield place
    assert not place.exists()


def test_the_payload_would_be_executed(tmp_path):
    pickle.loads(pickle.dumps(Payload(tmp_path / "executed")))  # noqa: S301 - that is the point
    assert (tmp_path / "executed").is_dir()


@pytest.mark.parametrize("name", FORMATS)
def test_no_reader_unpickles(tmp_path, mark, name):
    payload = pickle.dumps(Payload(mark))
    suffix = next(iter(FORMATS[name].suffixes), ".h5")
    path = tmp_path / f"a{suffix}"
    if FORMATS[name].write is None:
        path.write_bytes(payload)
        with pytest.raises(MisstepError):
            read(path, format=name)
        return
    save_dataset(Dataset([make()]), path, format=name)
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    for file in files:
        whole = file.read_bytes()
        for damaged in (payload, whole[:100] + payload + whole[100 + len(payload) :]):
            file.write_bytes(damaged)
            is_read(path, name)
        file.write_bytes(whole)
    assert is_read(path, name)


def test_objects_in_hdf5_and_arrow_are_not_unpickled(tmp_path, mark):
    payload = np.void(pickle.dumps(Payload(mark)))
    for name in ("hdf5", "robomimic"):
        path = tmp_path / f"{name}.h5"
        save_dataset(Dataset([make()]), path, format=name)
        with h5py.File(path, "r+") as file:
            groups = [file]
            file.visititems(lambda _, member, groups=groups: groups.append(member))
            for member in groups:
                for attribute in list(member.attrs):
                    member.attrs[attribute] = payload
        with pytest.raises(MisstepError):
            read(path, format=name)
    plain = {b"ARROW:extension:name": b"arrow.py_extension_type"}
    plain[b"ARROW:extension:metadata"] = pickle.dumps(Payload(mark))
    schema = pa.schema([pa.field("x", pa.float64(), metadata=plain)])
    pq.write_table(pa.table({"x": [1.0, 2.0]}, schema), tmp_path / "a.parquet")
    read(tmp_path / "a.parquet", ReadOptions(rate=1.0))


def test_policies_are_not_unpickled(tmp_path, mark, demonstrations, cartpole, refused):
    run = misstep.learn(
        cartpole, demonstrations, "mean", state=("theta",), max_trials=1, out=tmp_path / "run"
    )
    assert len(run.trials) == 1
    policy = tmp_path / "run/policies/trial_000.npz"
    arrays = dict(np.load(policy))
    for name in arrays:
        buffer = io.BytesIO()
        np.savez(buffer, **{**arrays, name: np.array([Payload(mark)], dtype=object)})
        policy.write_bytes(buffer.getvalue())
        with refused("Object arrays cannot be loaded"):
            load_run(tmp_path / "run")
    policy.write_bytes(pickle.dumps(Payload(mark)))
    with refused("cannot read"):
        load_run(tmp_path / "run")


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.mkdir [{mark}]",
        "rosbag2_bagfile_information: !!python/object/apply:os.mkdir [{mark}]",
        "rosbag2_bagfile_information: {{version: !!python/name:os.mkdir ''}}",
    ],
)
def test_yaml_makes_nothing(tmp_path, mark, text):
    bag = tmp_path / "a.ros2"
    bag.mkdir()
    (bag / "metadata.yaml").write_text(text.format(mark=mark))
    with pytest.raises(MisstepError):
        read(bag, format="rosbag2")


@pytest.mark.parametrize(
    "definition",
    [
        "float64 x\n__import__('os').mkdir('{mark}')\n",
        "float64 x = __import__('os').mkdir('{mark}')\n",
        "string X=\"'''\"; __import__('os').mkdir('{mark}')\n",
        'string X=""")\nimport os; os.mkdir("{mark}")\n("""\nfloat64 x\n',
        "float64[__import__('os').mkdir('{mark}')] x\n",
        "float64 x\n"
        + "=" * 80
        + "\nMSG: a/B'): 0}}; __import__('os').mkdir('{mark}'); {{('\nint8 y\n",
    ],
)
def test_definitions_of_messages_are_no_programs(tmp_path, mark, definition):
    # rosbags makes Python of them: what is none of ROS must not get that far, or do nothing.
    from rosbags.rosbag1 import Writer

    path = tmp_path / "a.bag"
    with Writer(path) as bag:
        said = {"msgdef": definition.format(mark=mark), "md5sum": "0" * 32}
        connection = bag.add_connection("/a", "a/msg/A", **said)
        for time in range(3):
            bag.write(connection, time, bytes(64))
    with pytest.raises(MisstepError):
        read(path, ReadOptions(observations=("/a.x",)))


# Nothing outside is touched


@pytest.mark.parametrize(
    "name", ["../../a.csv", "/etc/passwd.csv", "a/../../b.csv", "..\\a.csv", "\x00.csv", "C:a.CSV"]
)
def test_of_the_name_of_an_upload_only_the_suffix_is_taken(name):
    assert upload_suffix(name) == ".csv"


@pytest.mark.parametrize("name", ["../x", "/x", "a/b", "..", "", "a\x00b"])
def test_names_in_a_study_lead_nowhere(tmp_path, refused, name):
    case = (
        '[[case]]\nname = "a"\nsystem = "cartpole"\ndemonstrators = ["weak"]\nlearners = ["fall"]'
    )
    path = tmp_path / "s.toml"
    for text in (
        f"[study]\nname = {json.dumps(name)}\n{case}",
        f'[study]\nname = "s"\n{case.replace(json.dumps("a"), json.dumps(name))}',
    ):
        path.write_text(text)
        with refused("use letters, digits"):
            load_study(path)


def test_a_bag_names_no_file_outside(tmp_path):
    outside, bag = tmp_path / "outside.ros2", tmp_path / "a.ros2"
    save_dataset(Dataset([make()]), outside)
    save_dataset(Dataset([make()]), bag)
    (data,) = bag.glob("*.db3")
    (secret,) = outside.glob("*.db3")
    said = (bag / "metadata.yaml").read_text()
    data.unlink()
    for name in (f"../outside.ros2/{secret.name}", str(secret)):
        (bag / "metadata.yaml").write_text(said.replace(data.name, name))
        with pytest.raises(MisstepError):
            read(bag, format="rosbag2")


def test_a_lerobot_folder_names_no_file_outside(tmp_path):
    outside, folder = tmp_path / "outside.lerobot", tmp_path / "a.lerobot"
    save_dataset(Dataset([make()]), outside)
    save_dataset(Dataset([make()]), folder)
    info = folder / "meta/info.json"
    said = json.loads(info.read_text())
    for place in ("../outside.lerobot/data/chunk-000/file-000.parquet", str(outside)):
        info.write_text(json.dumps({**said, "data_path": place, "video_path": place}))
        assert load_dataset(folder) == load_dataset(outside)
    (folder / "data/chunk-000/file-000.parquet").unlink()
    with pytest.raises(MisstepError, match=r"no data/chunk-000/\*.parquet"):
        load_dataset(folder)


WRITTEN = [name for name in FORMATS if FORMATS[name].write is not None]


@pytest.mark.parametrize("name", WRITTEN)
def test_links_that_lead_nowhere_or_around_are_refused(tmp_path, refused, name):
    suffix = next(iter(FORMATS[name].suffixes), ".h5")
    path = tmp_path / f"a{suffix}"
    save_dataset(Dataset([make()]), path, format=name)
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    needed = 0
    for file in files:
        whole = file.read_bytes()
        for target in (file, tmp_path / "nowhere", Path("/dev/null")):
            file.unlink(missing_ok=True)
            file.symlink_to(target)
            needed += not is_read(path, name)
        file.unlink()
        file.write_bytes(whole)
    assert needed >= 3


# Little that claims to be much

PEAK = """
import resource, sys
from misstep import MisstepError
from misstep.formats import ReadOptions, format, load_dataset, read_episodes

format.LARGEST_IN_MEMORY = 2**26
resource.setrlimit(resource.RLIMIT_CPU, (100, 100))
load_dataset(sys.argv[2], format=sys.argv[3])  # all that is to be imported, is
start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    for episode in read_episodes(sys.argv[1], ReadOptions(rate=50.0), format=sys.argv[3]):
        format.joined(episode)
except MisstepError as error:
    print(error)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start)
"""


def bomb_is_refused(bomb, small, format, words):
    """Read a bomb in a process of its own, which has 64 MB for an episode; check its peak."""
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(bomb), str(small), format],
        capture_output=True,
        text=True,
        check=True,
    )
    line, peak = done.stdout.splitlines()
    assert words in line
    assert int(peak) < 2**18  # KiB: the 64 MB, those of two chunks, and a copy


def zeros(dataset, rows, width):
    """Store one deflated chunk of zeros in all places of an array."""
    packed = zlib.compress(bytes(rows * width * dataset.dtype.itemsize), 9)
    for start in range(0, dataset.shape[0], rows):
        dataset.id.write_direct_chunk((start, *(0 for _ in dataset.shape[1:])), packed)


def test_ten_gigabytes_of_zeros_in_hdf5(tmp_path):
    small, bomb = tmp_path / "small.h5", tmp_path / "bomb.h5"
    for path in (small, bomb):
        save_dataset(Dataset([make()]), path)
    T = 300_000_000
    with h5py.File(bomb, "r+") as file:
        file.attrs["total_steps"] = file["episode_0"].attrs["total_steps"] = T
        for name, width, kind in (
            *(("observations", 2, "f8"), ("actions", 1, "f8"), ("rewards", 0, "f8")),
            *(("terminations", 0, "?"), ("truncations", 0, "?")),
        ):
            del file["episode_0"][name]
            shape = (T + (name == "observations"), *([width] if width else []))
            rows = 2**16 // max(1, width)
            made = file["episode_0"].create_dataset(
                *(name, shape, kind),
                chunks=(rows, *shape[1:]),
                shuffle=True,
                compression="gzip",
                compression_opts=1,
            )
            zeros(made, rows, max(1, width))
    assert bomb.stat().st_size < 20_000_000
    bomb_is_refused(bomb, small, "hdf5", "it takes up more than 67108864 bytes in memory")


def test_ten_gigabytes_of_zeros_in_a_file_of_robomimics(tmp_path):
    small, bomb = tmp_path / "small.h5", tmp_path / "bomb.h5"
    save_dataset(Dataset([make()]), small, format="robomimic")
    rows, n = 2**20, 640
    with h5py.File(bomb, "w") as file:
        demo = file.create_group("data/demo_0")
        demo.attrs["num_samples"] = rows * n
        for name in ("actions", "obs/x"):
            packing = {"chunks": (rows, 1), "compression": "gzip"}
            zeros(demo.create_dataset(name, (rows * n, 1), "f8", **packing), rows, 1)
    bomb_is_refused(bomb, small, "robomimic", "it takes up more than 67108864 bytes in memory")


def test_one_chunk_of_ten_gigabytes_in_hdf5(tmp_path, refused):
    path = tmp_path / "bomb.h5"
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo.attrs["num_samples"] = 2**20
        packing = {"chunks": (2**20, 1024), "compression": "gzip"}
        made = demo.create_dataset("actions", (2**20, 1024), "f4", **packing)
        made.id.write_direct_chunk((0, 0), zlib.compress(bytes(2**20)))
        demo["obs/x"] = np.zeros((4, 1))
    with refused("would take up 4294967296 bytes in one piece|compressed array"):
        read(path, ReadOptions(rate=50.0), "robomimic")


def test_equal_rows_of_parquet_that_take_up_no_space(tmp_path):
    small, bomb = tmp_path / "small.parquet", tmp_path / "bomb.parquet"
    for path in (small, bomb):
        save_dataset(Dataset([make()]), path)
    columns = {"x": np.zeros(2**20), "y": np.zeros(2**20)}
    table = pa.table(columns)
    with pq.ParquetWriter(bomb, table.schema, compression="zstd") as writer:
        for _ in range(40):
            writer.write_table(table)
    assert bomb.stat().st_size < 500_000
    bomb_is_refused(bomb, small, "parquet", "it takes up more than 67108864 bytes in memory")


def test_a_policy_that_unpacks_to_more_than_it_may(tmp_path, demonstrations, cartpole, refused):
    misstep.learn(
        cartpole, demonstrations, "mean", state=("theta",), max_trials=1, out=tmp_path / "run"
    )
    policy = tmp_path / "run/policies/trial_000.npz"
    np.savez_compressed(policy, weights=np.zeros(2**24))
    assert policy.stat().st_size < 200_000
    with refused("unpacks to more than any policy holds"):
        load_run(tmp_path / "run")
