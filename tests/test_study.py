"""Studies: their specification, their arithmetic, and whole ones, killed, resumed and on Ray."""

import csv
import importlib.util
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import misstep
from misstep.cli import main
from misstep.learners import LEARNERS
from misstep.study import load_study, run_study
from misstep.study.cells import CellResult, cell_file, run_cell
from misstep.study.figures import learning_curve
from misstep.study.page import rate_colour
from misstep.study.run import _film, held_study
from misstep.study.table import TIMING, Measured, Quantile, censored_quantile, summarise
from misstep.workers import Tally, silent

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None,
    reason="Ray is not installed: pip install 'misstep[ray]'",
)

GOOD = """
[study]
name = "small"
seeds = 2
max_trials = 3
tests = 2

[[case]]
name = "balance"
system = "cartpole"
set = { duration = 2 }
state = ["theta", "theta_dot"]
demonstrators = ["weak", { name = "noisy", with = { noise = 8 } }]
learners = ["donut", "fall"]

[[case]]
name = "robust"
system = "cartpole"
set = { duration = 2 }
test_set = { start_spread = 0.1 }
variants = [{ pole_mass = 0.2 }, { delay = 0.02 }]
demonstrators = ["weak"]
demonstrations = 3
learners = ["fall"]
seeds = 1
"""

# What another package could bring along: a learner that goes wrong.
MISHAP = '''
import os, signal
from dataclasses import dataclass
from misstep.errors import MisstepError
from misstep.learners.mean import Mean
from misstep.parameters import parameter

@dataclass(frozen=True)
class Mishap(Mean):
    """Goes wrong in its second trial."""

    fate: str = parameter("killed", "", "what happens")

    def policy(self, task, evidence, rng):
        if evidence.trials:
            if self.fate == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            raise MisstepError("mishap has had a mishap")
        return super().policy(task, evidence, rng)
'''

FATAL = """
[study]
name = "fatal"
seeds = 1
max_trials = 2
tests = 0
videos = false

[[case]]
name = "balance"
system = "cartpole"
set = { duration = 2 }
state = ["theta", "theta_dot"]
demonstrators = ["weak"]
learners = [
    { name = "mishap", with = { fate = "killed" } },
    { name = "mishap", with = { fate = "error" } },
    "fall",
]
"""

PROGRAM = "import sys; from misstep.cli import main; sys.exit(main())"


def write(folder, text, name="study.toml"):
    path = folder / name
    path.write_text(text)
    return path


def command(*words):
    return [sys.executable, "-c", PROGRAM, "study", *map(str, words)]


def run(*words, **environment):
    return subprocess.run(
        command(*words), capture_output=True, text=True, env={**os.environ, **environment}
    )


def rows(path, without=TIMING):
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if k not in without} for row in csv.DictReader(file)]


def tables(out):
    """Return all that must not depend on the engine, the number of workers or an interruption."""
    return rows(out / "cells.csv"), rows(out / "summary.csv")


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return write(tmp_path_factory.mktemp("spec"), GOOD)


@pytest.fixture(scope="module")
def whole(spec, tmp_path_factory):
    """One whole study, small."""
    out = tmp_path_factory.mktemp("study") / "out"
    assert main(["study", str(spec), "--out", str(out), "--workers", "2"]) == 0
    return out


@pytest.fixture(scope="module")
def mishap(tmp_path_factory):
    """Return a folder that holds another package, installed, with the learner `mishap`."""
    folder = tmp_path_factory.mktemp("installed")
    (folder / "mishap.py").write_text(MISHAP)
    info = folder / "mishap-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mishap\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[misstep.learners]\nmishap = mishap:Mishap\n")
    return folder


# The specification


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[study]", "[study", "not valid TOML.*line 2"),
        ('name = "small"', "", r"\[study\]: name is missing; the keys are: name, seeds"),
        ("seeds = 2", "seed_count = 2", "unknown key 'seed_count'; the keys are: name, seeds"),
        ("seeds = 2", 'seeds = "two"', "seeds is 'two' but must be a whole number"),
        ("seeds = 2", "seeds = true", "seeds is True but must be a whole number"),
        ("seeds = 2", "seeds = 0", "seeds is 0 but must be at least 1"),
        ("tests = 2", "tests = -1", "tests is -1 but must be at least 0"),
        ("[[case]]", "[[cases]]", "unknown key 'cases'; the keys are: study, case"),
        ('system = "cartpole"', "", "case 'balance': system is missing"),
        ('"cartpole"', '"cart"', "case 'balance': no system named 'cart'; there are: .*cartpole"),
        ("duration = 2", "length = 2", "no parameter 'length'; it has: .*half_length"),
        ("duration = 2", "duration = -2", "case 'balance': cartpole: duration is -2 s"),
        ("start_spread = 0.1", "spread = 1", "case 'robust': test_set: .*no parameter 'spread'"),
        ('"theta", ', '"angle", ', "state angle,theta_dot: choose .* x, x_dot, theta"),
        ('"theta", ', "1, ", "state holds 1, but each must be a text"),
        ('["weak"]', '["weka"]', "no demonstrator named 'weka'; there are: .*weak"),
        ('["weak"]', '["timid"]', "demonstrator timid does not fit cartpole"),
        ('["weak"]', "[]", "case 'robust': demonstrators is empty"),
        ('["weak"]', "[3]", "demonstrators holds 3: each is a name or"),
        ("with = {", "width = {", "demonstrators: unknown key 'width'; the keys are: name, with"),
        ("noise = 8", "volume = 8", "demonstrator noisy has no parameter 'volume'; it has: gain"),
        ('"donut"', '"doughnut"', "no learner named 'doughnut'; there are: .*donut"),
        ('"donut"', '"fall"', "learners: 'fall' comes twice"),
        ('name = "robust"', 'name = "balance pole_mass=0.2"', "use letters, digits"),
        ("{ delay = 0.02 }", "{ pole_mass = 0.2 }", "case: 'robust pole_mass=0.2' comes twice"),
        ("{ delay = 0.02 }", "{ mass = 0.2 }", "case 'robust': cartpole has no parameter 'mass'"),
        ("{ delay = 0.02 }", "0.02", "variants holds 0.02, but each must be a table"),
    ],
)
def test_a_mistake_is_told_in_one_line(tmp_path, refused, old, new, match):
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with refused(f"{re.escape(str(path))}.*{match}"):
        load_study(path)


def test_a_study_is_all_combinations(spec):
    study = load_study(spec)
    assert [case.name for case in study.cases] == [
        "balance",
        "robust pole_mass=0.2",
        "robust delay=0.02",
    ]
    keys = [cell.key for cell in study.cells]
    assert len(set(keys)) == len(keys) == 2 * 2 * 2 + 2
    assert ("balance", "noisy(noise=8)", "fall", 1) in keys
    heavy = study.cases[1]
    assert heavy.parameters == {"duration": 2, "pole_mass": 0.2}
    assert (heavy.seeds, heavy.max_trials, heavy.tests, heavy.demonstrations) == (1, 3, 2, 3)
    assert heavy.state == ("x", "x_dot", "theta", "theta_dot")


def test_quick_makes_fewer_repetitions_and_the_same_ones(spec):
    study = load_study(spec)
    cases = [replace(study.cases[0], seeds=n) for n in (1, 2, 20, 100, 200)]
    quick = replace(study, cases=tuple(cases)).quick()
    assert [case.seeds for case in quick.cases] == [1, 1, 1, 2, 4]
    assert not quick.videos
    assert {cell.tests for cell in quick.cells} == {2}
    assert {cell.key for cell in quick.cells} < {
        cell.key for cell in replace(study, cases=tuple(cases)).cells
    }


def test_the_studies_that_come_along_can_be_read():
    folder = Path(__file__).parents[1] / "studies"
    paths = sorted(folder.glob("*.toml"))
    assert "headline.toml" in [path.name for path in paths]
    for path in paths:
        assert len(load_study(path).cells) > 0


# One cell


def test_a_cell_is_what_the_library_does(spec):
    cell = next(cell for cell in load_study(spec).cells if cell.learner.name == "donut")
    result = run_cell(cell)
    demonstrating, learning, testing = (
        int(np.random.SeedSequence(0, spawn_key=(0, purpose)).generate_state(1)[0])
        for purpose in range(3)
    )
    system = misstep.make_system("cartpole", duration=2)
    shown = misstep.demonstrate(system, "weak", 4, demonstrating)
    made = misstep.learn(
        system, shown, "donut", state=("theta", "theta_dot"), max_trials=3, seed=learning
    )
    assert result.status == "done"
    assert result.trials_to_success == made.trials_to_success
    assert result.outcomes == tuple(trial.outcome for trial in made.trials)
    np.testing.assert_allclose(result.costs, [trial.mean_cost for trial in made.trials])
    assert result.seconds_of_interaction == sum(trial.duration for trial in made.trials)
    tested = misstep.evaluate(system, made.policy, episodes=2, seed=testing)
    assert (result.survived, result.tests) == (tested.successes, 2)


def test_learners_are_compared_on_the_same_demonstrations(spec):
    study = load_study(spec)
    seen = []

    @LEARNERS.register("test-study-witness")
    class Witness(LEARNERS["mean"]):
        def policy(self, task, evidence, rng):
            seen.append([t.observations.tobytes() for t in evidence.demonstrations])
            return super().policy(task, evidence, rng)

    cell = replace(
        study.cells[0], learner=replace(study.cells[0].learner, name="test-study-witness")
    )
    single = replace(cell, case=replace(cell.case, max_trials=1))
    for other in (single, single, replace(single, repetition=1), replace(single, seed=1)):
        assert run_cell(other).status == "done"
    assert seen[0] == seen[1]
    assert len({tuple(demonstrations) for demonstrations in seen}) == 3


class WorksOnce:
    """A policy that fails in its second attempt, as one may under a `test_set`."""

    def __init__(self, policy):
        self.policy, self.begun = policy, 0

    def reset(self):
        self.begun += 1
        if self.begun > 1:
            raise misstep.MisstepError("it works once")
        self.policy.reset()

    def __call__(self, observation):
        return self.policy(observation)


def test_a_run_that_ends_in_an_error_has_not_succeeded(spec, monkeypatch):
    class Once(LEARNERS["fall"]):
        def policy(self, task, evidence, rng):
            return WorksOnce(super().policy(task, evidence, rng))

    monkeypatch.setitem(LEARNERS._own, "test-study-once", Once)
    cell = next(cell for cell in load_study(spec).cells if cell.learner.name == "fall")
    cell = replace(cell, learner=replace(cell.learner, name="test-study-once"))
    result = run_cell(cell)
    assert (result.status, result.error) == ("error", "it works once")
    assert result.outcomes[-1] == "success"
    assert result.trials_to_success is None
    assert summarise([Measured(cell, result)])[0].success == (0, 1)


@pytest.mark.parametrize(
    "change",
    [
        lambda values: values.pop("cell"),
        lambda values: values.update(outcomes=None),
        lambda values: values.update(timing=[1.0, 2.0]),
        lambda values: values["timing"].pop("wall_seconds"),
    ],
)
def test_a_damaged_result_is_told_in_one_line(whole, spec, tmp_path, refused, change):
    values = json.loads(cell_file(whole, load_study(spec).cells[0]).read_text())
    change(values)
    path = write(tmp_path, json.dumps(values), "000.json")
    with refused("000.json is no result of a study: delete it"):
        CellResult.load(path)


# The arithmetic of the tables

times = st.lists(st.tuples(st.integers(1, 20), st.booleans()), min_size=1, max_size=30)


@given(times, st.floats(0.01, 1))
def test_a_quantile_is_reached_or_bounds_whatever_would_have_come(runs, q):
    values, succeeded = zip(*runs, strict=True)
    quantile = censored_quantile(values, succeeded, q)
    share = sum(s and v <= quantile.value for v, s in runs) / len(runs)
    if quantile.reached:
        assert share >= q - 1e-6
        earlier = sum(s and v < quantile.value for v, s in runs) / len(runs)
        assert earlier < q or quantile.value == min(v for v, s in runs if s)
    else:
        assert sum(succeeded) / len(runs) < q
        for later in (1, 100):  # had the others gone on for so much longer
            known = [v if s else v + later for v, s in runs]
            assert np.quantile(known, q, method="inverted_cdf") >= quantile.value


@given(st.lists(st.integers(1, 50), min_size=1), st.sampled_from([0.5, 0.9]))
def test_a_quantile_of_successes_is_the_ordinary_one(values, q):
    expected = np.quantile(values, q, method="inverted_cdf")
    assert censored_quantile(values, [True] * len(values), q) == Quantile(expected, True)


def test_a_censored_median_is_shown_as_a_bound():
    assert str(censored_quantile([3, 20, 20], [True, False, False], 0.5)) == ">20"
    assert str(censored_quantile([3, 20, 20], [True, True, False], 0.5)) == "20"


@given(st.lists(st.one_of(st.none(), st.integers(1, 20)), min_size=1))
def test_a_learning_curve_counts_successes(needed):
    curve = learning_curve(needed, 20)
    increments = np.diff(curve) * len(needed)
    np.testing.assert_allclose(increments, [needed.count(n) for n in range(1, 21)], atol=1e-9)
    assert curve[0] == 0
    assert math.isclose(curve[-1] * len(needed), len(needed) - needed.count(None))


def test_colours_go_from_red_to_green():
    red, amber, green = (
        tuple(map(int, re.findall(r"\d+", rate_colour(rate)))) for rate in (0, 0.5, 1)
    )
    assert red[0] > red[1]
    assert green[1] > green[0]
    assert red[1] < amber[1]


# Whole studies


def test_the_tables_say_what_the_cells_say(whole, spec):
    study = load_study(spec)
    results = [CellResult.load(cell_file(whole, cell)) for cell in study.cells]
    shown = rows(whole / "cells.csv")
    assert len(shown) == len(results) == 10
    for row, cell, result in zip(shown, study.cells, results, strict=True):
        assert (row["case"], row["learner"]) == (cell.case.name, cell.learner.label)
        assert row["trials_to_success"] == str(result.trials_to_success or "")
        assert float(row["seconds_of_interaction"]) == result.seconds_of_interaction
        assert int(row["survived"]) == result.survived <= result.tests == 2
    for row in json.loads((whole / "summary.json").read_text()):
        own = [
            result
            for cell, result in zip(study.cells, results, strict=True)
            if cell.key[:3] == (row["case"], row["demonstrator"], row["learner"])
        ]
        successes = sum(result.trials_to_success is not None for result in own)
        assert (row["success_count"], row["success_of"]) == (successes, len(own))
        low, high = misstep.Evaluation(len(own), successes, ()).interval_95
        assert (row["success_low"], row["success_high"]) == (low, high)
        assert row["first_trial_count"] == sum(result.trials_to_success == 1 for result in own)
        assert row["tests_count"] == sum(result.survived for result in own)


def test_the_short_table_puts_demonstrators_and_variants_together(whole):
    cells = rows(whole / "cells.csv")
    lines = [line.split("|")[1:-1] for line in (whole / "summary.md").read_text().splitlines()]
    task, found = "", {}
    for line in lines[2:]:
        task = line[0].strip() or task
        found[task, line[1].strip(" `")] = line[3:]
    assert set(found) == {("balance", "donut"), ("balance", "fall"), ("robust", "fall")}
    for (task, learner), (succeeded, first, *_) in found.items():
        own = [c for c in cells if c["case"].startswith(task) and c["learner"] == learner]
        successes = [c["trials_to_success"] for c in own if c["trials_to_success"]]
        assert succeeded.split("(")[0].strip() == f"{len(successes)} of {len(own)}"
        assert int(first) == successes.count("1")


def test_the_page_holds_everything_and_reaches_outside_for_nothing(whole, spec):
    page = (whole / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page)
    assert "http" not in page
    for cell in load_study(spec).cells:
        assert cell.learner.label in page
        assert cell.case.group in page
    videos = list((whole / "videos").glob("*.mp4"))
    assert 3 <= len(videos) == page.count("<video")
    assert page.count("data:image/png") == 4
    assert "every run went through" in page


def test_a_video_is_of_its_cell_also_when_a_lost_one_comes_back(whole, spec, tmp_path):
    falls = [c for c in load_study(spec).cells if c.learner.name == "fall"][:2]
    made = [Measured(cell, CellResult.load(cell_file(whole, cell))) for cell in falls]
    lost = [Measured(falls[0], CellResult("lost", "lost: killed")), made[1]]
    tally = Tally(silent, 0)
    [before] = _film(tmp_path, lost, 1, tally)
    [after] = _film(tmp_path, made, 1, tally)
    assert (before.video.cell, after.video.cell) == (falls[1], falls[0])
    assert before.video.path != after.video.path
    assert before.video.path.exists()
    assert after.video.path.exists()


def test_one_worker_killed_and_resumed_gives_the_same_tables(whole, tmp_path):
    text = GOOD.replace("tests = 2", "tests = 2\nvideos = false")
    out, spec = tmp_path / "out", write(tmp_path, text)
    process = subprocess.Popen(
        command(spec, "--out", out, "--workers", 1), stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 60
    while not list(out.glob("cells/*/*/*/*.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    finished = {path: path.stat().st_mtime_ns for path in out.glob("cells/*/*/*/*.json")}
    assert 0 < len(finished) < 10
    assert not (out / "cells.csv").exists()
    assert main(["resume", str(out)]) == 0
    assert tables(out) == tables(whole)
    assert {path: path.stat().st_mtime_ns for path in finished} == finished


def test_a_learner_that_takes_long_makes_the_first_of_the_seeds_and_tests(tmp_path):
    donut = '{ name = "donut", called = "hole", with = { reach = 3 }, seeds = 1, tests = 0 }'
    text = GOOD.replace('"donut"', donut)
    cells = [c for c in load_study(write(tmp_path, text)).cells if c.case.name == "balance"]
    made = [(c.learner.label, c.repetition, c.tests) for c in cells]
    assert made == 2 * [("hole", 0, 0), ("fall", 0, 2), ("fall", 1, 2)]
    assert {c.learner.full_name for c in cells} == {"donut(reach=3)", "fall"}


def test_a_folder_remembers_its_whole_study(whole, spec):
    assert held_study(whole) == load_study(spec)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda values: values.pop("study"), "study.json is damaged: it describes no study"),
        (lambda values: values["study"].pop("cases"), "damaged: .*'cases'"),
        (lambda values: values["study"]["cases"][0].pop("seeds"), "damaged: .*seeds"),
        (lambda values: values.update(version="0.0.0"), "a study of misstep 0.0.0, but this is"),
    ],
)
def test_a_damaged_or_older_study_is_not_resumed(whole, tmp_path, refused, change, match):
    values = json.loads((whole / "study.json").read_text())
    change(values)
    (tmp_path / "study.json").write_text(json.dumps(values))
    with refused(match):
        held_study(tmp_path)


def test_another_study_in_the_same_folder_is_refused(whole, spec, tmp_path, refused):
    before = (whole / "study.json").read_bytes()
    other = write(tmp_path, GOOD.replace("{ duration = 2 }", "{ duration = 3 }", 1))
    with refused(r"holds another study \(study.cases\[0\].parameters.duration is 2 there, not 3"):
        run_study(load_study(other), whole)
    assert (whole / "study.json").read_bytes() == before
    (tmp_path / "mine").mkdir()
    write(tmp_path / "mine", "mine", "mine.txt")
    with refused("not empty"):
        run_study(load_study(spec), tmp_path / "mine")
    with refused("no engine named 'threads'; there are: processes, ray"):
        run_study(load_study(spec), tmp_path / "new", engine="threads")
    with refused("workers is 0"):
        run_study(load_study(spec), tmp_path / "new", workers=0)
    with refused("address is for the engine ray"):
        run_study(load_study(spec), tmp_path / "new", address="auto")
    assert not (tmp_path / "new").exists()


def check_fatal(out, code, stdout):
    """Check a study in which one run was killed twice and one raised an error."""
    assert code == 1
    assert "1 of 3 runs ended in an error and 1 were lost" in stdout
    lost, failed, good = rows(out / "cells.csv")
    assert lost["status"] == "lost"
    assert "died 2 times" in lost["error"]
    assert (failed["status"], failed["error"]) == ("error", "mishap has had a mishap")
    assert (failed["trials"], failed["trials_to_success"]) == ("1", "")
    assert (good["status"], good["trials_to_success"]) == ("done", "1")
    page = (out / "report.html").read_text()
    assert "mishap has had a mishap" in page
    assert "died 2 times" in page
    by_learner = {row["learner"]: row for row in rows(out / "summary.csv")}
    assert by_learner["mishap(fate=killed)"]["success_of"] == "0"
    assert by_learner["mishap(fate=error)"]["success_of"] == "1"


def test_what_goes_wrong_in_one_run_leaves_the_rest_alone(tmp_path, mishap, monkeypatch, capsys):
    monkeypatch.setenv("PYTHONPATH", str(mishap))
    monkeypatch.syspath_prepend(mishap)
    out = tmp_path / "out"
    words = ["study", str(write(tmp_path, FATAL)), "--out", str(out), "--workers", "2"]
    check_fatal(out, main(words), capsys.readouterr().out)
    kept = {path: path.stat().st_mtime_ns for path in out.glob("cells/*/*/*/*.json")}
    check_fatal(out, main(words), capsys.readouterr().out)
    changed = [path.parent.name for path in kept if path.stat().st_mtime_ns != kept[path]]
    assert changed == ["mishap(fate=killed)"], "the lost run is tried again, and no other"


# Ray


def test_without_ray_one_line_says_what_to_install(spec, tmp_path):
    out = tmp_path / "out"
    program = f"import sys; sys.modules['ray'] = None; {PROGRAM}"
    words = ["study", str(spec), "--out", str(out), "--engine", "ray"]
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "misstep: error: the engine ray needs Ray: pip install 'misstep[ray]'\n"
    assert not out.exists()


@needs_ray
def test_ray_gives_the_same_tables(whole, spec, tmp_path):
    done = run(spec, "--out", tmp_path / "out", "--engine", "ray", "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert tables(tmp_path / "out") == tables(whole)


@needs_ray
def test_what_goes_wrong_in_one_run_on_ray_leaves_the_rest_alone(tmp_path, mishap):
    path, out = write(tmp_path, FATAL), tmp_path / "out"
    words = ("--out", out, "--engine", "ray", "--workers", 1)
    done = run(path, *words, PYTHONPATH=str(mishap))
    assert "Traceback" not in done.stderr
    check_fatal(out, done.returncode, done.stdout)


@needs_ray
def test_a_cluster_that_is_not_there_is_told_in_one_line(spec, tmp_path):
    out = tmp_path / "out"
    words = ("--out", out, "--engine", "ray", "--address", "auto")
    done = run(spec, *words, RAY_TMPDIR=str(tmp_path))  # where Ray notes which clusters run
    assert done.returncode == 2
    assert done.stderr.startswith("misstep: error: cannot join a Ray cluster at auto (")
    assert done.stderr.count("\n") == 1
    assert not out.exists()


def wait_until(is_so, seconds):
    deadline = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < deadline
        time.sleep(0.1)


@needs_ray
@pytest.mark.parametrize("address", ["127.0.0.1:6399", "auto", ""])
def test_a_cluster_that_the_surroundings_name_is_not_joined_unasked(spec, whole, tmp_path, address):
    words = ("--out", tmp_path / "out", "--engine", "ray", "--workers", 1)
    done = run(spec, *words, RAY_ADDRESS=address)
    assert done.returncode == 0, done.stderr
    assert tables(tmp_path / "out") == tables(whole)


@needs_ray
def test_beside_a_cluster_two_studies_at_once_run_on_their_own_or_join_it(spec, whole, tmp_path):
    # Ray's sockets lie there, and the path of a socket has to be short.
    notes = tempfile.mkdtemp(prefix="ray")
    surroundings = {**os.environ, "RAY_TMPDIR": notes, "RAY_USAGE_STATS_ENABLED": "0"}
    ray = Path(sys.executable).with_name("ray")
    start = [ray, "start", "--head", "--node-ip-address=127.0.0.1", "--port=0", "--num-cpus=2"]
    # In a session of its own, to be ended alone: `ray stop` would end every cluster of the machine.
    head = subprocess.Popen(
        [*start, "--include-dashboard=false", "--block"],
        env=surroundings,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        wait_until(Path(notes, "ray", "ray_current_cluster").exists, 60)
        study = [sys.executable, "-m", "misstep", "study", spec, "--engine=ray", "--workers=1"]
        started = [
            subprocess.Popen(
                [*study, "--out", tmp_path / name, *words],
                env=surroundings,
                stderr=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                text=True,
            )
            for name, words in (("alone", []), ("joined", ["--address", "auto"]))
        ]
        for process in started:
            assert process.wait(240) == 0, process.stderr.read()
            process.stderr.close()
    finally:
        os.killpg(head.pid, signal.SIGTERM)
        head.wait(60)
        shutil.rmtree(notes, ignore_errors=True)
    for name in ("alone", "joined"):
        assert tables(tmp_path / name) == tables(whole)
