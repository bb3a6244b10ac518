"""Without a name, the highest rung whose feedback is there is taken."""

from dataclasses import replace

import pytest

from misstep import demonstrate, learn, make_system, save_dataset
from misstep.cli import main
from misstep.learners import Task, default_learner
from misstep.trajectory import Dataset, Outcome


@pytest.fixture(scope="module")
def system():
    return make_system("cartpole")


@pytest.fixture(scope="module")
def shown(system):
    return demonstrate(system, "noisy", n=4, seed=0)


def test_each_rung_in_turn(system, shown):
    task = Task.of(system, ("theta", "theta_dot"))
    assert default_learner(task, shown)[0] == "dynamics"
    blind = replace(task, cost=None)
    assert default_learner(blind, shown)[0] == "fall"
    untimed = [replace(t, failure_step=None) for t in shown]
    assert default_learner(blind, untimed)[0] == "balanced-mean"
    unjudged = [replace(t, outcome=Outcome.UNKNOWN) for t in untimed]
    assert default_learner(blind, unjudged)[0] == "mean"


def test_learn_takes_it(system, shown):
    run = learn(system, shown, seed=0)
    assert run.config.learner == "dynamics"
    assert run.trials_to_success <= 3


def test_the_command_line_says_so(shown, tmp_path, capsys):
    save_dataset(shown, tmp_path / "D.h5")
    words = ["learn", "cartpole", "--from", str(tmp_path / "D.h5"), "--out", str(tmp_path / "RUN")]
    assert main(words) == 0
    assert (
        "learner dynamics (rung 4: the system has a cost as a function)" in capsys.readouterr().out
    )


def test_an_action_limit_that_nobody_comes_near_changes_nothing():
    near, far = (make_system("cartpole", force_limit=limit) for limit in (40.0, 4000.0))
    shown = demonstrate(near, "weak", seed=3)
    other = demonstrate(far, "weak", seed=3)
    pairs = zip(shown, other, strict=True)
    assert Dataset([replace(t, provenance=o.provenance) for t, o in pairs]) == other
    first, second = (
        learn(s, d, "fall", state=("theta", "theta_dot"), seed=0, max_trials=1)
        for s, d in ((near, shown), (far, other))
    )
    assert first.policies[0].gain == pytest.approx(second.policies[0].gain)
