"""One process at a time drives a run; the lock goes with it, and reading is free."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from misstep import demonstrate, learn, load_run, make_system, resume, save_dataset
from misstep.cli import main
from misstep.errors import MisstepError
from misstep.locks import LOCK, driven
from misstep.robot.service import ExplorationService

STATE = ("theta", "theta_dot")
# Learns nothing that succeeds, for ever.
DRIVER = """
import sys, time
from misstep import load_run, resume

def wait(run):
    print(len(run.trials), flush=True)
    time.sleep(60)

resume(load_run(sys.argv[1]), on_trial=wait)
"""


@pytest.fixture
def begun(tmp_path):
    """A run with one trial of 50, whose trials do not succeed."""
    system = make_system("cartpole", duration=2.0)
    shown = demonstrate(system, "weak", n=2, seed=0)
    save_dataset(shown, tmp_path / "D.h5")
    folder = tmp_path / "run"
    learn(system, shown, "mean", state=STATE, max_trials=1, stop_on_success=False, out=folder)
    config = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**config, "max_trials": 50}))
    return folder


@pytest.fixture
def driver(begun):
    """Another process that drives the run, and has made a trial."""
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, begun], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "2\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def refusals(folder):
    """Try every way to drive a run; return what each says."""
    said = []
    for drive in (resume, ExplorationService):
        with pytest.raises(MisstepError) as caught:
            drive(load_run(folder))
        said.append(str(caught.value))
    return said


def test_a_second_driver_is_refused_and_told_who_is_first(begun, driver):
    before = {path: path.read_bytes() for path in begun.rglob("*.h5")}
    for line in refusals(begun):
        assert line.startswith(f"{begun} is driven by process {driver.pid} on ")
        assert line.endswith("stop that, or wait until it ends")
    # Reading is free.
    assert len(load_run(begun).trials) == 2
    assert main(["evaluate", str(begun), "--episodes", "2"]) in (0, 1)
    assert {path: path.read_bytes() for path in begun.rglob("*.h5")} == before


@pytest.mark.parametrize(
    "words",
    [
        ["resume", "RUN"],
        ["serve", "RUN", "--socket", "127.0.0.1:0"],
        ["serve", "RUN", "--socket", "127.0.0.1:0", "--keep-policy"],
    ],
)
def test_commands_are_refused_in_one_line(begun, driver, capsys, words):
    assert main([str(begun) if word == "RUN" else word for word in words]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert f"is driven by process {driver.pid}" in line
    assert len(load_run(begun).trials) == 2


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_lock_goes_with_its_process(begun, driver, how):
    driver.send_signal(how)
    driver.wait()
    run = resume(load_run(begun), on_trial=stop_after(1))
    assert len(run.trials) == 3


def stop_after(n):
    """Return what ends a run by an error after n trials, as a Ctrl-C would."""
    made = []

    def on_trial(run):
        made.append(None)
        if len(made) == n:
            run.config.__dict__["max_trials"] = len(run.trials)

    return on_trial


def test_a_child_does_not_keep_the_lock_of_a_parent_that_is_gone(begun):
    program = (
        "import subprocess, sys, os\n"
        "from pathlib import Path\n"
        "from misstep.locks import driven\n"
        "with driven(Path(sys.argv[1])):\n"
        "    child = subprocess.Popen(['sleep', '60'], close_fds=False)\n"
        "    print(child.pid, flush=True)\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, begun], stdout=subprocess.PIPE, text=True, check=False
    )
    child = int(done.stdout)
    try:
        with driven(begun):
            pass
    finally:
        os.kill(child, signal.SIGKILL)


def test_the_same_process_goes_on_with_its_own_run(begun):
    run = load_run(begun)
    resume(run, on_trial=stop_after(1))
    run.config.__dict__["max_trials"] = 3
    assert len(resume(run).trials) == 3


def test_a_run_that_went_on_meanwhile_is_not_overwritten(begun):
    stale = load_run(begun)
    resume(load_run(begun), on_trial=stop_after(2))
    before = {path: path.read_bytes() for path in begun.rglob("trial_*")}
    with pytest.raises(MisstepError, match="holds 3 trials, but 1 when it was loaded"):
        resume(stale)
    with pytest.raises(MisstepError, match="holds trial_001 already"):
        stale.add(stale.policy, stale.trials[0], 0.0)
    assert {path: path.read_bytes() for path in begun.rglob("trial_*")} == before


def test_two_that_begin_the_same_run_do_not_mix(tmp_path):
    folder = tmp_path / "run"
    save_dataset(demonstrate(make_system("cartpole"), "weak", n=2, seed=0), tmp_path / "D.h5")
    words = ["learn", "cartpole", "--from", str(tmp_path / "D.h5"), "--learner", "mean"]
    words += ["--out", str(folder), "--max-trials", "3"]
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "misstep", *words, "--seed", str(seed)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for seed in (1, 2)
    ]
    errors = {}
    for process in started:
        errors[process.wait(120)] = process.stderr.read()
        process.stderr.close()
    assert 2 in errors
    assert errors[2].count("\n") == 1
    run = load_run(folder)
    assert len(run.trials) == 3
    assert run.config.seed in (1, 2)


def test_a_read_only_copy_is_read(begun):
    folders = [begun, begun / "trials", begun / "policies"]
    (begun / LOCK).unlink(missing_ok=True)
    for folder in folders:
        folder.chmod(0o555)
    try:
        assert len(load_run(begun).trials) == 1
        if os.getuid() != 0:  # root may write everywhere
            with pytest.raises(MisstepError, match="cannot drive"):
                resume(load_run(begun))
    finally:
        for folder in folders:
            folder.chmod(0o755)


def test_a_lock_file_that_says_nothing_still_locks(tmp_path):
    with driven(tmp_path):
        (tmp_path / LOCK).write_bytes(b"\xff{")
        refused = pytest.raises(MisstepError, match="is driven by another process: stop that")
        with refused, driven(tmp_path):
            pass
    with driven(tmp_path):
        pass


def test_a_study_that_runs_is_not_joined(tmp_path):
    spec = Path(tmp_path / "S.toml")
    spec.write_text(
        '[study]\nname = "s"\nseeds = 1\nmax_trials = 1\ntests = 1\n\n[[case]]\nname = "c"\n'
        'system = "cartpole"\ndemonstrators = ["weak"]\nlearners = ["mean"]\n'
    )
    words = ["study", str(spec), "--out", str(tmp_path / "out"), "--workers", "1"]
    assert main(words) == 0
    with driven(tmp_path / "out"):
        assert main(words) == 2
    assert main(words) == 0
