import io
import json
import pickle
import re
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.stats import binomtest
from trials import timeless

from misstep import (
    Dataset,
    MisstepError,
    demonstrate,
    evaluate,
    learn,
    load_run,
    make_system,
    resume,
    rollout,
)
from misstep.learning import wilson_interval
from misstep.systems import CartPole
from misstep.trajectory import Column, Outcome
from misstep.version import __version__

STATE = ("theta", "theta_dot")


class Idle:
    """Does nothing."""

    def reset(self):
        pass

    def __call__(self, observation):
        return np.zeros(1)


def assert_same_policies(one, other):
    assert len(one.policies) == len(other.policies)
    observations = np.random.default_rng(0).normal(size=(20, 4))
    for a, b in zip(one.policies, other.policies, strict=True):
        a.reset()
        b.reset()
        for observation in observations:
            np.testing.assert_array_equal(a(observation), b(observation))


def assert_same_runs(one, other):
    assert timeless(one.trials) == timeless(other.trials)
    assert timeless(one.demonstrations) == timeless(other.demonstrations)
    assert_same_policies(one, other)


@pytest.fixture
def short(cartpole, demonstrations):
    """Return a function that learns for three trials."""

    def run(learner="donut", **settings):
        settings = {"state": STATE, "max_trials": 3, "stop_on_success": False, **settings}
        return learn(cartpole, demonstrations, learner, **settings)

    return run


@pytest.fixture
def kept(short, tmp_path):
    """Return a run and the folder that it is kept in."""
    return short(out=tmp_path / "run"), tmp_path / "run"


# The loop


@pytest.mark.parametrize("learner", ["donut", "donut-cost", "mean"])
def test_same_seed_same_run(short, learner):
    one, two = short(learner, seed=5), short(learner, seed=5)
    assert_same_runs(one, two)
    assert [t.provenance.demonstrator for t in one.trials] == [f"learner:{learner}"] * 3
    assert len(one.computing_seconds) == 3
    assert one.policy is one.policies[-1]
    other = short(learner, seed=6)
    assert not np.array_equal(other.trials[0].observations[0], one.trials[0].observations[0])


def test_a_trial_is_what_its_policy_does(short, cartpole):
    run = short(max_trials=2)
    for policy, trial in zip(run.policies, run.trials, strict=True):
        seed = trial.provenance.seed
        again = rollout(cartpole, policy, seed=seed, demonstrator=trial.provenance.demonstrator)
        assert timeless([again]) == timeless([trial])


def test_a_longer_run_begins_like_a_shorter_one(short):
    assert timeless(short(max_trials=4).trials[:2]) == timeless(short(max_trials=2).trials)


def test_stops_at_the_first_success():
    # So short an episode that the pole does not reach 30°.
    easy = make_system("cartpole", duration=0.1)
    failures = demonstrate(make_system("cartpole"), by="weak", n=2, seed=0)
    run = learn(easy, failures, "mean", state=STATE, max_trials=5)
    assert run.trials_to_success == len(run.trials) == 1
    assert run.succeeded
    assert run.finished
    on = learn(easy, failures, "mean", state=STATE, max_trials=3, stop_on_success=False)
    assert len(on.trials) == 3
    assert on.trials_to_success == 1


def test_a_run_without_success_says_so(short):
    seen = []
    run = short(on_trial=lambda run: seen.append(len(run.trials)))
    assert seen == [1, 2, 3]
    assert all(t.outcome is Outcome.FAILURE for t in run.trials)
    assert run.trials_to_success is None
    assert not run.succeeded
    assert run.finished


# Kept in a folder


def test_a_kept_run_is_loaded_as_it_was(kept):
    run, folder = kept
    loaded = load_run(folder)
    assert loaded.trials == run.trials
    assert loaded.computing_seconds == run.computing_seconds
    assert loaded.folder == folder
    assert asdict(loaded.config) == asdict(run.config)
    assert_same_runs(loaded, run)
    assert len(resume(loaded).trials) == 3


def test_a_kept_run_is_the_run_that_is_not_kept(short, kept):
    assert_same_runs(short(), kept[0])


@pytest.mark.parametrize("learner", ["donut", "donut-cost"])
@pytest.mark.parametrize("lost", [1, 2, 3])
def test_resumes_where_the_last_trials_are_missing(short, tmp_path, learner, lost):
    whole = short(learner, out=tmp_path / "run")
    for index in range(3 - lost, 3):
        (tmp_path / "run" / "trials" / f"trial_{index:03d}.h5").unlink()
    run = load_run(tmp_path / "run")
    assert len(run.trials) == 3 - lost
    assert not run.finished
    assert_same_runs(resume(run), whole)
    assert_same_runs(load_run(tmp_path / "run"), whole)


def test_more_than_a_thousand_trials_keep_their_order(kept):
    run, folder = kept
    for index in range(3, 1002):
        for kind, suffix in (("trials", "h5"), ("policies", "npz")):
            original = folder / kind / f"trial_{index % 3:03d}.{suffix}"
            (folder / kind / f"trial_{index:03d}.{suffix}").hardlink_to(original)
    loaded = load_run(folder)
    assert len(loaded.trials) == 1002
    assert loaded.trials == [run.trials[index % 3] for index in range(1002)]


KILLED = """
import sys
from pathlib import Path
import misstep

folder, system = Path(sys.argv[1]), misstep.make_system("cartpole")
if (folder / "run.json").exists():
    misstep.resume(misstep.load_run(folder))
else:
    failures = misstep.demonstrate(system, by="weak", n=3, seed=0)
    misstep.learn(
        system, failures, "donut-cost", state=("theta", "theta_dot"), max_trials=12, seed=3,
        stop_on_success=False, out=folder,
    )
"""


def test_killed_at_any_instant_it_ends_as_if_it_had_not_been(cartpole, demonstrations, tmp_path):
    settings = {"state": STATE, "max_trials": 12, "seed": 3, "stop_on_success": False}
    whole = learn(cartpole, demonstrations, "donut-cost", **settings)
    folder, rng = tmp_path / "run", np.random.default_rng(0)
    killed_at = []
    for wanted in (0, 2, 4, 7, 9):
        process = subprocess.Popen([sys.executable, "-c", KILLED, str(folder)])
        while len(list(folder.glob("trials/trial_*.h5"))) < wanted or not folder.exists():
            assert process.poll() in (None, 0)
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.05))
        process.send_signal(signal.SIGKILL)
        assert process.wait() in (0, -signal.SIGKILL)
        killed_at.append(len(list(folder.glob("trials/trial_*.h5"))))
    assert min(killed_at) < 12
    if (folder / "run.json").exists():
        run = resume(load_run(folder))
    else:
        run = learn(cartpole, demonstrations, "donut-cost", out=folder, **settings)
    assert_same_runs(run, whole)
    assert_same_runs(load_run(folder), whole)


def test_a_folder_left_before_the_run_began_can_be_used(short, tmp_path):
    (tmp_path / "run" / "policies").mkdir(parents=True)
    (tmp_path / "run" / "trials").mkdir()
    short(max_trials=1, out=tmp_path / "run")
    assert len(load_run(tmp_path / "run").trials) == 1


# Evaluation


@pytest.mark.parametrize("n", [1, 2, 10, 57, 1000])
def test_wilson_s_interval_against_scipy(n):
    for successes in sorted({0, 1, n // 3, n // 2, n - 1, n}):
        expected = binomtest(successes, n).proportion_ci(0.95, method="wilson")
        np.testing.assert_allclose(wilson_interval(successes, n), expected, rtol=1e-9, atol=1e-12)


def test_evaluation_counts_what_the_system_says():
    outcomes = []

    class Watched(CartPole):
        def step(self, action):
            result = super().step(action)
            if result[2] or result[3]:
                outcomes.append(result[4]["success"])
            return result

    system = Watched(duration=0.75)
    evaluation = evaluate(system, Idle(), episodes=60, seed=1)
    assert len(outcomes) == evaluation.episodes == 60
    assert 5 < evaluation.successes < 55
    assert evaluation.successes == sum(outcomes)
    assert evaluation.success_rate == sum(outcomes) / 60
    assert evaluation.interval_95 == wilson_interval(sum(outcomes), 60)
    assert len(evaluation.costs) == 60
    assert min(evaluation.costs) > 0.0
    # The pole that starts furthest from upright costs most: every start is another.
    assert len(set(evaluation.costs)) == 60
    assert evaluate(system, Idle(), episodes=60, seed=1) == evaluation
    assert evaluate(system, Idle(), episodes=60, seed=2).costs != evaluation.costs


# Bad input


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"learner": "doughnut"}, "no learner named 'doughnut'"),
        ({"gamma": 2.0}, "learner donut has no parameter 'gamma'; it has: n_components"),
        ({"reach": 0.0}, "learner donut: reach is 0 but must be at least 1"),
        ({"state": ("phi",)}, "state phi: choose distinct columns among x, x_dot"),
        ({"state": ()}, "choose distinct columns"),
        ({"max_trials": 0}, "max_trials is 0: at least one trial is needed"),
        ({"seed": -1}, "seed is -1: it must not be negative"),
    ],
)
def test_settings_are_checked_before_anything_is_written(
    refused, short, tmp_path, settings, message
):
    with refused(message):
        short(out=tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_demonstrations_have_to_fit_the_system(refused, cartpole, demonstrations, tmp_path):
    def misfit(**changes):
        shown = Dataset(replace(t, **changes) for t in demonstrations)
        learn(cartpole, shown, "mean", out=tmp_path / "run")

    columns = cartpole.observation_columns
    with refused("observation columns x.*phi.*but cartpole has x.*theta"):
        misfit(observation_columns=(*columns[:3], Column("phi", "rad")))
    with refused(r"theta \[deg\].*but cartpole has .*theta \[rad\]"):
        misfit(observation_columns=(*columns[:2], Column("theta", "deg"), columns[3]))
    with refused("action columns torque.*but cartpole has force"):
        misfit(action_columns=(Column("torque", "N·m"),))
    with refused("one step every 0.01 s, but cartpole takes one every 0.02 s"):
        misfit(dt=0.01)
    assert not (tmp_path / "run").exists()


def test_a_refused_first_trial_leaves_nothing_behind(refused, cartpole, demonstrations, tmp_path):
    free = Dataset(replace(t, costs=None) for t in demonstrations)
    with refused("attempt 0 has no costs"):
        learn(cartpole, free, "donut-cost", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_evaluation_is_checked(refused, cartpole):
    with refused("episodes is 0"):
        evaluate(cartpole, Idle(), episodes=0)
    with refused("seed is -1"):
        evaluate(cartpole, Idle(), seed=-1)


def test_folders_that_cannot_be_used(refused, short, kept, tmp_path):
    with refused("holds a run already: resume it, or choose another folder"):
        short(out=kept[1])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("dear reader")
    with refused("full is not empty"):
        short(out=tmp_path / "full")
    (tmp_path / "half" / "trials").mkdir(parents=True)
    (tmp_path / "half" / "trials" / "trial_000.h5").write_text("mine")
    with refused("half is not empty"):
        short(out=tmp_path / "half")
    (tmp_path / "file").write_text("")
    for place in ("file", "file/run"):
        with refused("cannot make the folder"):
            short(out=tmp_path / place)
    assert (tmp_path / "full" / "thesis.txt").read_text() == "dear reader"


def test_what_is_no_run(refused, tmp_path):
    for place in (tmp_path, tmp_path / "nowhere"):
        with refused("is not a run folder: it has no run.json"):
            load_run(place)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": "0"}, "seed must be a JSON whole number"),
        ({"seed": 1.5}, "seed must be a JSON whole number"),
        ({"seed": True}, "seed must be a JSON whole number"),
        ({"seed": -1}, "seed is -1"),
        ({"max_trials": 0}, "max_trials is 0"),
        ({"max_trials": None}, "max_trials must be"),
        ({"stop_on_success": "no"}, "stop_on_success must be a JSON boolean"),
        ({"system": ["cartpole"]}, "system must be a JSON string"),
        ({"system": "acrobot"}, "no system named 'acrobot'"),
        ({"learner": 7}, "learner must be a JSON string"),
        ({"learner": "doughnut"}, "no learner named 'doughnut'"),
        ({"state": "theta"}, "state must be a JSON array"),
        ({"state": ["phi"]}, "choose distinct columns"),
        ({"state": [["theta"]]}, "choose distinct columns"),
        ({"system_parameters": []}, "system_parameters must be a JSON object"),
        ({"system_parameters": {"colour": "red"}}, "has no parameter 'colour'"),
        ({"system_parameters": {"cart_mass": [1]}}, "cart_mass"),
        ({"learner_parameters": [["k", 2]]}, "learner_parameters must be a JSON object"),
        ({"extra": 1}, "is not a run's configuration"),
    ],
)
def test_a_damaged_configuration(refused, kept, change, message):
    path = kept[1] / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with refused(message):
        load_run(kept[1])


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "\x00", '{"seed": NaN}', "[" * 100_000])
def test_a_configuration_that_is_not_json(refused, kept, text):
    (kept[1] / "run.json").write_text(text)
    with refused(r"run\.json is not"):
        load_run(kept[1])


def test_damaged_or_missing_files(refused, kept):
    folder = kept[1]

    def check(place, content, message):
        path = folder / place
        original = path.read_bytes()
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        with refused(message):
            load_run(folder)
        path.write_bytes(original)

    check("demonstrations.h5", None, "demonstrations.h5")
    check("demonstrations.h5", b"rubbish", "demonstrations.h5")
    check("trials/trial_001.h5", b"rubbish", "trial_001.h5")
    check("trials/trial_001.h5", None, r"trial_001\.h5 is missing, but trial_002\.h5 is there")
    check("policies/trial_001.npz", None, "cannot read .*trial_001.npz")
    check("policies/trial_001.npz", b"", "cannot read .*trial_001.npz")
    check("policies/trial_001.npz", b"rubbish", "cannot read .*trial_001.npz")
    assert len(load_run(folder).trials) == 3


def npz(**arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


class Bomb:
    """Raises when it is unpickled."""

    def __reduce__(self):
        return exec, ("raise AssertionError('unpickled')",)


def test_a_pickle_is_refused_and_not_loaded(refused, kept):
    path = kept[1] / "policies" / "trial_000.npz"
    with np.load(path) as archive:
        arrays = dict(archive)
    path.write_bytes(npz(**{**arrays, "weights": np.array([Bomb()], dtype=object)}))
    with pytest.raises(AssertionError, match="unpickled"), np.load(path, allow_pickle=True) as bomb:
        bomb["weights"]
    with refused("cannot read .*trial_000.npz: Object arrays cannot be loaded"):
        load_run(kept[1])
    path.write_bytes(pickle.dumps(Bomb()))
    with refused("cannot read .*trial_000.npz"):
        load_run(kept[1])


def test_policies_that_are_none(refused, kept):
    path = kept[1] / "policies" / "trial_000.npz"
    with np.load(path) as archive:
        arrays = dict(archive)

    def check(message, **changes):
        changed = {k: v for k, v in {**arrays, **changes}.items() if v is not None}
        path.write_bytes(npz(**changed))
        with refused(message):
            load_run(kept[1])

    check("lacks the array 'weights'", weights=None)
    check("lacks the array 'computing_seconds'", computing_seconds=None)
    check("holds no policy", weights=np.array(["heavy"]))
    check("holds no policy: .*definite", covariances=-arrays["covariances"])
    check("holds no policy: .*finite", means=np.full_like(arrays["means"], np.nan))
    check("holds no policy", settings=np.ones(2))
    check("holds no policy", scale=np.ones(7))
    check("holds no policy", computing_seconds=np.ones(7))


def test_a_policy_file_may_not_claim_more_memory_than_a_policy_needs(refused, kept):
    path = kept[1] / "policies" / "trial_000.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("weights.npy", bytes(80 * 2**20))
    assert path.stat().st_size < 2**20
    with refused(f"^{re.escape(str(path))} unpacks to more than any policy holds$"):
        load_run(kept[1])
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**14,)}
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("weights.npy", header.getvalue())
    with refused("cannot read"):
        load_run(kept[1])


def test_a_policy_file_with_flipped_bytes_is_read_or_refused(kept):
    path = kept[1] / "policies" / "trial_000.npz"
    original, rng = path.read_bytes(), np.random.default_rng(0)
    refusals = []
    for _ in range(150):
        damaged = bytearray(original)
        for place in rng.integers(len(damaged), size=rng.integers(1, 4)):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            run = load_run(kept[1])
        except MisstepError as error:
            refusals.append(str(error))
        else:
            assert len(run.policies) == 3
    assert len(refusals) > 100
    assert not any("\n" in refusal for refusal in refusals)


def test_no_test_starts_where_a_trial_did(monkeypatch):
    # With the command lines' own defaults, a run and its evaluation have the same seed.
    system, starts = make_system("cartpole"), []
    shown = demonstrate(system, "weak", n=4, seed=0)
    reset = system.reset

    def watched(*, seed=None, options=None):
        starts.append(seed)
        return reset(seed=seed, options=options)

    monkeypatch.setattr(system, "reset", watched)
    run = learn(system, shown, "mean", max_trials=20, seed=0, stop_on_success=False)
    tried, starts[:] = set(starts), []
    evaluate(system, run.policy, episodes=20, seed=0)
    assert len(tried) == len(set(starts)) == 20
    assert not tried & set(starts)


def test_a_run_of_another_version_says_which_trials_are_not_of_it(tmp_path):
    system = make_system("cartpole")
    shown = demonstrate(system, "weak", n=4, seed=0)
    learn(system, shown, "mean", max_trials=1, stop_on_success=False, out=tmp_path / "run")
    config = json.loads((tmp_path / "run" / "run.json").read_text())
    config.update(max_trials=2, version="0.0.1")
    (tmp_path / "run" / "run.json").write_text(json.dumps(config))
    resume(load_run(tmp_path / "run"))
    first, second = load_run(tmp_path / "run").trials
    assert first.provenance.notes == ()
    assert second.provenance.notes == (f"made by misstep {__version__}, of a run that 0.0.1 began",)
