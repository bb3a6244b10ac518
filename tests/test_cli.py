import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import stats

import misstep
from misstep.cli import main
from misstep.cli.options import parse_parameters
from misstep.cli.ros import _joint_names

# Interrupts are set up as on a terminal, however the tests themselves were started.
PROGRAM = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from misstep.cli import main; sys.exit(main())"
)
LEARN = ("learn", "cartpole", "--state", "theta,theta_dot", "--learner", "donut")


def start(*words):
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words], stdout=pipe, stderr=pipe, text=True
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Four failed demonstrations on a heavier pole than the default."""
    path = tmp_path_factory.mktemp("recorded") / "D.h5"
    words = ("demonstrate", "cartpole", "--by", "weak", "-n", "4", "--set", "pole_mass=0.2")
    assert main([*words, "--out", str(path)]) == 0
    return path


@pytest.fixture
def here(tmp_path, monkeypatch, recorded):
    """An empty folder to work in, but for D.h5."""
    shutil.copy(recorded, tmp_path / "D.h5")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def finished(recorded):
    """Return the folder of a run that was never interrupted: six trials without success."""
    folder = recorded.parent / "finished"
    words = (*LEARN, "--from", str(recorded), "--out", str(folder), "--max-trials", "6")
    assert main(words) == 1
    return folder


def refused(capsys, *words):
    """Run a command that has to be refused, and return the one line that says why."""
    before = sorted(Path().rglob("*"))
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("misstep: error: ")
    assert captured.err.count("\n") == 1
    assert captured.err.endswith("\n")
    assert sorted(Path().rglob("*")) == before, "something was left behind"
    return captured.err


# What it starts with


def test_the_installed_command_is_this_one():
    [point] = entry_points(group="console_scripts", name="misstep")
    assert point.load() is main


def test_help_needs_nothing_heavy():
    program = (
        "import sys; from misstep.cli import main; code = main(['--help']); "
        "heavy = {'mujoco', 'gymnasium', 'numba', 'sklearn', 'scipy', 'matplotlib', 'h5py', 'rich'}"
        "; sys.exit(code or ', '.join(heavy & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "demonstrate" in done.stdout


def test_names_of_the_package_are_there_whatever_is_imported_first():
    program = (
        "import misstep.demonstrators, misstep; listed = set(dir(misstep)); "
        "assert set(misstep.__all__) <= listed; "
        "assert all(getattr(misstep, name) is not None for name in misstep.__all__); "
        "assert misstep.rollout.__module__ == 'misstep.rollout'; "
        "assert misstep.make_system('cartpole').system_id == 'cartpole'"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        misstep.nonsense  # noqa: B018


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"misstep {misstep.__version__}\n"


@pytest.mark.parametrize(
    "command", ["demonstrate", "learn", "resume", "evaluate", "reproduce", "study", "list"]
)
def test_help_has_an_example(capsys, command):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"Example:\n    misstep {command} " in text
    assert "--json" in text


# What it does


def test_demonstrate(here, capsys):
    words = ("demonstrate", "cartpole", "--by", "noisy", "-n", "3", "--seed", "5")
    options = ("--set", "pole_mass=0.3", "--with", "noise=8", "--out", "N.h5", "--json", "N.json")
    assert main([*words, *options]) == 0
    system = misstep.make_system("cartpole", pole_mass=0.3)
    expected = misstep.demonstrate(system, "noisy", 3, 5, noise=8.0)
    for attempt, same in zip(misstep.load_dataset("N.h5"), expected, strict=True):
        assert_same_but_for_time(attempt, same)
    result = json.loads(Path("N.json").read_text())
    assert result["episodes"] == 3
    assert result["outcomes"] == ["failure"] * 3
    np.testing.assert_allclose(result["costs"], [t.costs.mean() for t in expected])
    assert result["failure_times"] == [t.failure_step * t.dt for t in expected]
    assert result["version"] == misstep.__version__
    assert result["parameters"]["system"] == system.parameters
    assert result["parameters"]["demonstrator"]["noise"] == 8.0
    table = capsys.readouterr().out
    assert all(f"{t.duration:.2f}" in table for t in expected)


JUDGES = ("--success", "abs(theta) < 15deg", "--failure", "x > 30cm", "--cost", "abs(theta)")


def test_judges_go_with_the_demonstrations(here):
    words = ("demonstrate", "cartpole", "--by", "random", *JUDGES, "--set", "hold=1")
    assert main([*words, "--set", "duration=4", "--out", "J.h5"]) == 0
    told = {"success": "abs(theta) < 15deg", "failure": "x > 30cm", "cost": "abs(theta)"}
    for attempt in misstep.load_dataset("J.h5"):
        parameters = attempt.provenance.parameters
        assert {name: parameters[name] for name in told} == told
        assert parameters["hold"] == 1.0
        np.testing.assert_allclose(attempt.costs, np.abs(attempt.column("theta")[1:]))
        assert (attempt.column("x")[:-1] <= 0.3).all()
    words = ("learn", "cartpole", "--from", "J.h5", "--learner", "mean", "--max-trials", "1")
    assert main([*words, "--failure", "x > 1cm", "--keep-going", "--out", "RUN"]) == 0
    parameters = misstep.load_run("RUN").config.system_parameters
    assert (parameters["success"], parameters["failure"]) == (told["success"], "x > 1cm")
    assert main(["evaluate", "RUN", "--episodes", "2"]) == 0


def test_a_gymnasium_environment_by_its_id(here):
    words = ("demonstrate", "gym:InvertedPendulum-v5", "--by", "random", "--set", "duration=1")
    assert main([*words, "--out", "G.h5"]) == 0
    words = ("learn", "gym:InvertedPendulum-v5", "--from", "G.h5", "--learner", "mean")
    assert main([*words, "--max-trials", "1", "--keep-going"]) == 0
    run = misstep.load_run("runs/gym-InvertedPendulum-v5-mean-0")
    assert run.config.system_parameters["failure"] == "abs(theta) > 0.2rad"
    assert run.config.system_parameters["duration"] == 1.0


def test_demonstrate_replaces_a_file_only_when_forced(here, capsys):
    before = Path("D.h5").read_bytes()
    words = ("demonstrate", "cartpole", "-n", "1", "--out", "D.h5")
    assert "--force" in refused(capsys, *words)
    assert Path("D.h5").read_bytes() == before
    assert main([*words, "--force"]) == 0
    assert len(misstep.load_dataset("D.h5")) == 1


def test_learn_without_success(finished, capsys):
    assert main(["resume", str(finished)]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "no success in 6 trials"


def test_learn_until_success(here, capsys):
    # Nobody falls within a tenth of a second.
    words = (*LEARN, "--from", "D.h5", "--set", "duration=0.1", "--with", "reach=3", "--seed", "2")
    assert main([*words, "--json", "result.json"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "first success in trial 1 of 1 trial"
    run = misstep.load_run("runs/cartpole-donut-2")
    result = json.loads(Path("result.json").read_text())
    assert result["parameters"]["learner"]["reach"] == 3.0
    assert result["parameters"]["system"]["duration"] == 0.1
    assert result["parameters"]["system"]["pole_mass"] == 0.2, "recorded with the demonstrations"
    expected = {
        "learner": "donut",
        "rung": 1,
        "system": "cartpole",
        "state": ["theta", "theta_dot"],
        "seed": 2,
        "trials": 1,
        "trials_to_success": 1,
        "seconds_of_interaction": pytest.approx(0.1),
        "computing_seconds": pytest.approx(run.computing_seconds[0]),
        "costs": [pytest.approx(run.trials[0].costs.mean())],
    }
    assert {name: result[name] for name in expected} == expected


def test_keep_going_claims_only_that_all_trials_were_made(here, capsys):
    words = ("--from", "D.h5", "--out", "RUN", "--max-trials", "2", "--keep-going")
    assert main([*LEARN, *words, "--json", "result.json"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no success in 2 trials"
    result = json.loads(Path("result.json").read_text())
    assert (result["trials"], result["trials_to_success"]) == (2, None)


def test_evaluate(here, finished, capsys):
    words = ("evaluate", str(finished), "--episodes", "12", "--seed", "3", "--set", "duration=0.3")
    assert main([*words, "--json", "result.json"]) == 0
    result = json.loads(Path("result.json").read_text())
    run = misstep.load_run(finished)
    system = misstep.make_system("cartpole", **{**run.config.system_parameters, "duration": 0.3})
    expected = misstep.evaluate(system, run.policy, episodes=12, seed=3)
    assert (result["episodes"], result["successes"]) == (12, expected.successes)
    assert result["success_rate"] == expected.successes / 12
    wilson = stats.binomtest(expected.successes, 12).proportion_ci(method="wilson")
    np.testing.assert_allclose(result["interval_95"], wilson, atol=1e-12)
    assert f"{expected.successes} of 12 episodes succeeded" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("what", "named"),
    [
        ("systems", ["cartpole", "pole_mass", "0.1", "kg", "uniform thin rod"]),
        ("systems", ["cartpole-rail: Keep a pole", "cartpole-swingup: Swing", "gym:ID: A Gym"]),
        ("learners", ["donut-cost", "Rung 3", "reach", "prose"]),
        ("demonstrators", ["bang-bang", "reaction_max", "deg"]),
        ("formats", ["hdf5", ".h5"]),
    ],
)
def test_list(here, capsys, what, named):
    assert main(["list", what, "--json", "list.json"]) == 0
    text = capsys.readouterr().out
    for word in named:
        assert word in text
    listed = set(json.loads(Path("list.json").read_text())[what])
    assert listed - {"gym:ID"} == set(getattr(misstep, what.upper()))
    assert ("gym:ID" in listed) == (what == "systems")


# Bad input

NOWHERE = ("--out", "D.h5/sub/x.h5")  # below a file: even the administrator cannot write there


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), ["command", "--help"]),
        (("dance",), ["'dance'", "demonstrate, learn, resume", "inspect, mark, convert"]),
        (("learn", "--speed", "3"), ["--speed", "--learner, --state, --max-trials"]),
        (("learn",), ["SYSTEM", "misstep learn --help"]),
        (("learn", "cartpole", "--from"), ["--from", "argument"]),
        (("learn", "cartpole", "--from", "D.h5", "--seed", "x"), ["--seed", "integer"]),
        (("list", "things"), ["'things'", "systems, learners, demonstrators, formats"]),
        (("demonstrate", "unicycle", "--out", "N.h5"), ["'unicycle'", "cartpole"]),
        (
            ("demonstrate", "cartpole", "--failure", "abs(theta > 1", "--out", "N.h5"),
            ["cartpole, failure, character 14", "')' is missing"],
        ),
        (
            ("demonstrate", "cartpole", "--cost", "tilt", "--out", "N.h5"),
            ["no column 'tilt'", "x [m], x_dot [m/s], theta [rad]"],
        ),
        (
            ("demonstrate", "cartpole", "--cost", "x", "--set", "cost=x", "--out", "N.h5"),
            ["--set cost and --cost", "choose one"],
        ),
        (("demonstrate", "gym:Nope-v0", "--out", "N.h5"), ["gym:Nope-v0 cannot be made"]),
        (("demonstrate", "gym:Swimmer-v5", "--out", "N.h5"), ["give success or failure", "o0"]),
        ((*LEARN, "--from", "D.h5", "--success", "theta"), ["a condition is wanted"]),
        (("demonstrate", "cartpole", "--by", "magic", "--out", "N.h5"), ["'magic'", "weak"]),
        (("demonstrate", "cartpole", "-n", "0", "--out", "N.h5"), ["n is 0", "at least 1"]),
        (("demonstrate", "cartpole", "--seed", "-1", "--out", "N.h5"), ["seed is -1"]),
        (("demonstrate", "cartpole", "--out", "N.txt"), ["'.txt'", ".h5"]),
        (("demonstrate", "cartpole", *NOWHERE), ["D.h5/sub"]),
        (("demonstrate", "cartpole", "--out", "gone/N.h5"), ["folder gone"]),
        (("demonstrate", "cartpole", "--out", "N.h5", "--json", "gone/r"), ["--json", "gone"]),
        (("demonstrate", "cartpole", "--out", "N.h5", "--json", "."), ["--json", "folder"]),
        (
            ("demonstrate", "cartpole", "--with", "gain=inf", "--out", "N.h5"),
            ["gain is inf", "finite number in N/rad"],
        ),
        (
            ("demonstrate", "cartpole", "--with", "strength=1", "--out", "N.h5"),
            ["'strength'", "gain [N/rad], noise [N]"],
        ),
        ((*LEARN, "--from", "gone.h5"), ["gone.h5"]),
        (
            (*LEARN, "--from", "D.h5", "--learner", "oracle"),
            ["'oracle'", "donut, donut-cost", "mean"],
        ),
        ((*LEARN, "--from", "D.h5", "--state", "theta,tilt"), ["theta,tilt", "x, x_dot, theta"]),
        ((*LEARN, "--from", "D.h5", "--max-trials", "0"), ["max_trials is 0"]),
        ((*LEARN, "--from", "D.h5", "--set", "weight=3"), ["'weight'", "pole_mass [kg]"]),
        ((*LEARN, "--from", "D.h5", "--set", "pole_mass"), ["'pole_mass'", "name=value"]),
        ((*LEARN, "--from", "D.h5", "--set", "pole_mass=heavy"), ["'heavy'", "number in kg"]),
        ((*LEARN, "--from", "D.h5", "--set", "pole_mass=nan"), ["nan", "finite number"]),
        ((*LEARN, "--from", "D.h5", "--set", "pole_mass=-1"), ["-1 kg", "greater than 0 kg"]),
        ((*LEARN, "--from", "D.h5", "--set", "stop_at_fall=3"), ["3", "true or false"]),
        ((*LEARN, "--from", "D.h5", "--set", "control_rate=25"), ["0.02 s", "0.04 s"]),
        ((*LEARN, "--from", "D.h5", "--with", "climb=up"), ["'up'", "warm, density, global"]),
        ((*LEARN, "--from", "D.h5", "--with", "k=1", "--with", "k=3"), ["k", "twice"]),
        ((*LEARN, "--from", "D.h5", *NOWHERE), ["D.h5/sub"]),
        ((*LEARN, "--from", "D.h5", "--json", "D.h5/r.json"), ["--json", "folder D.h5"]),
        (("resume", "gone"), ["gone", "run.json"]),
        (("reproduce", "--out", "."), ["not empty"]),
        (("reproduce", "--out", "D.h5/sub"), ["D.h5/sub"]),
        (("reproduce", "--out", "P", "--seeds", "0"), ["seeds", "at least 1"]),
        (("reproduce", "--out", "P", "--workers", "0"), ["workers is 0"]),
        (("reproduce", "--out", "P", "--json", "gone/r"), ["--json", "folder gone"]),
        (
            ("ros2", "control", "--by", "magic", "--out", "N.h5", "--patience", "0"),
            ["no demonstrator named 'magic'"],
        ),
        (
            ("ros2", "control", "--by", "weak", "--out", "N.h5", "--with", "a=1"),
            ["demonstrator weak has no parameter 'a'"],
        ),
        (("ros2", "explore", "RUN", "--with", "reach"), ["--with 'reach'", "name=value"]),
        (("evaluate", "."), ["run.json"]),
        (("evaluate", "RUN", "--episodes", "many"), ["--episodes"]),
    ],
    ids=lambda value: " ".join(value) or "nothing" if isinstance(value, tuple) else "",
)
def test_bad_words(here, capsys, words, told):
    line = refused(capsys, *words)
    for fragment in told:
        assert fragment in line


@pytest.mark.parametrize(
    "words",
    [
        ("inspect", "D.h5", "--out", "./D.h5"),
        ("inspect", "D.h5", "--json", "D.h5"),
        ("mark", "D.h5", "--json", "D.h5"),
        ("convert", "D.h5", "N.csv", "--json", "D.h5"),
        ("convert", "D.h5", "N.csv", "--save-mapping", "D.h5"),
        (*LEARN, "--from", "D.h5", "--json", "D.h5"),
    ],
    ids=" ".join,
)
def test_no_result_takes_the_place_of_what_is_read(here, capsys, words):
    before = Path("D.h5").read_bytes()
    assert "D.h5 is what is read, and would be lost" in refused(capsys, *words)
    assert Path("D.h5").read_bytes() == before


def test_a_package_that_cannot_be_loaded_is_told_in_one_line(here, tmp_path, monkeypatch, capsys):
    told = tmp_path / "broken-1.0.dist-info"
    told.mkdir()
    (told / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (told / "entry_points.txt").write_text("[misstep.learners]\nbroken = no_such_place:Learner\n")
    monkeypatch.syspath_prepend(tmp_path)
    line = refused(capsys, "learn", "cartpole", "--from", "D.h5", "--learner", "broken")
    assert "the learner 'broken' is no_such_place:Learner of an installed package" in line
    assert "No module named 'no_such_place'" in line


@pytest.mark.parametrize("what", ["learners", "systems", "demonstrators", "formats"])
def test_one_broken_package_leaves_the_others_to_be_used(here, tmp_path, monkeypatch, capsys, what):
    module = tmp_path / "mishap_of_somebody.py"
    module.write_text("raise RuntimeError('this package is broken')\n")
    told = tmp_path / "broken-1.0.dist-info"
    told.mkdir()
    (told / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (told / "entry_points.txt").write_text(f"[misstep.{what}]\nbroken = mishap_of_somebody:THING\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["list", what, "--json", "listed.json"]) == 0
    out = capsys.readouterr().out
    assert "this package is broken" in out
    listed = json.loads(Path("listed.json").read_text())
    assert set(listed["broken"]) == {"broken"}
    assert "broken" not in listed[what]
    assert len(listed[what]) > 3
    # Reading, writing, driving and learning go on.
    assert main(["convert", "D.h5", "copy.csv"]) == 0
    assert main(["demonstrate", "cartpole", "-n", "1", "--out", "other.h5"]) == 0


def empty(path):
    path.write_bytes(b"")


def truncated(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def text_inside(path):
    path.write_text("x,theta\n0,1\n")


def without_episodes(path):
    with h5py.File(path, "w"):
        pass


def not_a_number(path):
    with h5py.File(path, "r+") as file:
        file["episode_2/observations"][3, 2] = np.nan


def wrong_shape(path):
    with h5py.File(path, "r+") as file:
        actions = file["episode_1/actions"][:-1]
        del file["episode_1/actions"]
        file["episode_1"].create_dataset("actions", data=actions)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (empty, []),
        (truncated, []),
        (text_inside, []),
        (without_episodes, []),
        (not_a_number, ["row 3", "'theta'", "nan", "finite"]),
        (wrong_shape, ["episode_1: actions has shape"]),
    ],
)
def test_bad_files(here, capsys, spoil, told):
    spoil(here / "D.h5")
    line = refused(capsys, *LEARN, "--from", "D.h5")
    for fragment in ("cannot read D.h5", *told):
        assert fragment in line


@pytest.mark.parametrize("learner", ["mean", "donut", "donut-cost"])
def test_a_constant_column(here, capsys, learner):
    demonstrations = [
        replace(t, observations=t.observations * [0, 1, 1, 1]) for t in misstep.load_dataset("D.h5")
    ]
    misstep.save_dataset(misstep.Dataset(demonstrations), "still.h5")
    words = ("learn", "cartpole", "--from", "still.h5", "--learner", learner, "--out", "RUN")
    line = refused(capsys, *words)
    assert "column x is constant (0)" in line
    assert "leave it out of the state" in line
    words = (*words, "--state", "theta", "--max-trials", "1", "--keep-going")
    assert main(words) == 0


def test_demonstrations_that_disagree_on_the_system(here, capsys):
    words = ("demonstrate", "cartpole", "--set", "pole_mass=0.1", "--out", "light.h5")
    assert main(words) == 0
    capsys.readouterr()
    both = [*misstep.load_dataset("D.h5"), *misstep.load_dataset("light.h5")]
    misstep.save_dataset(misstep.Dataset(both), "both.h5")
    assert "pole_mass" in refused(capsys, *LEARN, "--from", "both.h5")
    words = ("--from", "both.h5", "--max-trials", "1", "--keep-going", "--set", "pole_mass=0.15")
    assert main([*LEARN, *words, "--out", "RUN"]) == 0
    assert misstep.load_run("RUN").config.system_parameters["pole_mass"] == 0.15


def test_learn_leaves_an_existing_run_alone(here, finished, capsys):
    shutil.copytree(finished, "RUN")
    assert "resume" in refused(capsys, *LEARN, "--from", "D.h5", "--out", "RUN")


def test_evaluate_before_the_first_trial(here, finished, capsys):
    shutil.copytree(finished, "RUN")
    shutil.rmtree("RUN/trials")
    assert "no trial yet" in refused(capsys, "evaluate", "RUN")


def test_resume_finds_a_reproduction(here, capsys):
    Path("P").mkdir()
    Path("P/reproduce.json").write_text("{}")
    assert "not a reproduction's configuration" in refused(capsys, "resume", "P")


def test_a_bug_keeps_its_traceback(monkeypatch):
    def broken():
        raise ZeroDivisionError

    monkeypatch.setitem(main.__globals__["catalogue"]._CATALOGUES, "systems", broken)
    with pytest.raises(ZeroDivisionError):
        main(["list", "systems"])


def test_parse_parameters():
    texts = ["a=1", "b=-2.5e3", "c=true", "d=False", "e=a=b", " f = some text ", "g=1_0", "h=.5"]
    assert parse_parameters("--set", texts) == {
        "a": 1,
        "b": -2500.0,
        "c": True,
        "d": False,
        "e": "a=b",
        "f": "some text",
        "g": "1_0",
        "h": 0.5,
    }
    assert parse_parameters("--set", None) == {}


def test_names_of_joints_stay_as_they_are_written():
    assert _joint_names(["x=007", "theta = true"]) == {"x": "007", "theta": "true"}


# Killed, interrupted, unheard


def assert_same_but_for_time(attempt, other):
    assert replace(attempt, provenance=replace(attempt.provenance, time="")) == replace(
        other, provenance=replace(other.provenance, time="")
    )


def learn_until_trial(trial, recorded, *words):
    """Start learning in another process, and return it once a trial is finished."""
    process = start(*LEARN, "--from", str(recorded), "--out", "RUN", "--max-trials", "6", *words)
    deadline = time.monotonic() + 100
    while not Path(f"RUN/trials/trial_{trial:03d}.h5").exists():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return process


def test_killed_and_resumed_is_as_if_never_killed(here, recorded, finished, capsys):
    process = learn_until_trial(1, recorded)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    kept = len(misstep.load_run("RUN").trials)
    assert 2 <= kept < 6
    assert main(["resume", "RUN"]) == 1
    progress = capsys.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in progress] == [f"trial {i}/6" for i in range(kept + 1, 7)]
    resumed, uninterrupted = misstep.load_run("RUN"), misstep.load_run(finished)
    for trial, other in zip(resumed.trials, uninterrupted.trials, strict=True):
        assert_same_but_for_time(trial, other)


def test_interrupted(here, recorded):
    process = learn_until_trial(1, recorded)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 130
    assert errors.splitlines()[-1] == "misstep: interrupted; `misstep resume RUN` goes on"
    assert "Traceback" not in errors
    assert len(misstep.load_run("RUN").trials) >= 2


def test_nobody_reads_the_output():
    reading, writing = os.pipe()
    os.close(reading)
    words = [sys.executable, "-c", PROGRAM, "list", "systems"]
    done = subprocess.run(words, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("words", [("list", "systems"), ("--version",), ("study", "--help")])
def test_no_room_for_the_output(words):
    with open("/dev/full", "w") as full:
        words = [sys.executable, "-c", PROGRAM, *words]
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr == (
        "misstep: error: cannot write: No space left on device; free some room\n"
    )


def test_bad_input_from_a_shell(here):
    process = start("demonstrate", "cartpole", "--by", "magic", "--out", "N.h5")
    out, errors = process.communicate()
    assert (process.returncode, out) == (2, "")
    assert errors.startswith("misstep: error: no demonstrator named 'magic'; there are: bang-bang")
    assert errors.count("\n") == 1
