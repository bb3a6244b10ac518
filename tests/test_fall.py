from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from misstep import demonstrate, evaluate, learn, make_system
from misstep.errors import MisstepError
from misstep.learners.fall import (
    BLAME,
    EFFECT_PENALTY,
    INTERCEPT_PENALTY,
    SLOPE_PENALTY,
    TIME_SCALES,
    Danger,
    Scaled,
    cascade,
    learn_danger,
    respond,
    shares_of_the_usual,
    ways_to_fail,
)
from misstep.learners.learner import LEARNERS, Evidence, Task
from misstep.learners.linear import LinearPolicy

STATE = ("theta", "theta_dot")
DT = 0.02


def unstable(rng, failed=True, n=2, rate=4.0):
    """A scaled attempt whose leading direction grows like e^(rate t) while others decay."""
    direction = np.array([1.0, 0.5, -0.3])[:n]
    x, a = [0.01 * rng.normal(size=n)], []
    for _ in range(60):
        push = rng.uniform(-1, 1)
        along = x[-1] @ direction / (direction @ direction)
        rest = x[-1] - along * direction
        along = along * np.exp(rate * DT) + 0.02 * push
        x.append(along * direction + 0.9 * rest)
        a.append([push])
    return Scaled(np.array(x), np.array(a), failed, float(rng.exponential()))


@pytest.mark.parametrize("kind", ["noisy", "weak", "delayed", "reversed", "random", "bang-bang"])
def test_balances_on_the_first_trial_whoever_failed_before(kind):
    system = make_system("cartpole")
    for seed in range(3):
        run = learn(system, demonstrate(system, kind, seed=seed), "fall", state=STATE, seed=seed)
        assert run.trials_to_success == 1
        assert evaluate(system, run.policy, episodes=3, seed=seed).successes == 3


def test_danger_is_the_best_of_the_penalised_least_squares():
    attempts = [unstable(np.random.default_rng(seed)) for seed in range(4)]
    danger = learn_danger(attempts, DT)
    direction = np.linalg.svd([a.weight * a.x[-1] for a in attempts])[2][0]
    found = []
    for tau in TIME_SCALES:
        X, Z, w = [], [], []
        for attempt in attempts:
            for t, x in enumerate(attempt.x):
                remaining = (len(attempt.x) - 1 - t) * DT
                X.append([1.0, *x])
                Z.append(np.exp(-remaining / tau) * attempt.x[-1])
                w.append(attempt.weight * np.exp(-remaining / (BLAME * tau)))
        X, Z, w = np.array(X), np.array(Z), np.array(w) / np.sum(w)
        # A penalty is one more sample of zero; least squares then needs no normal equations.
        ghosts = np.diag(np.sqrt([INTERCEPT_PENALTY, SLOPE_PENALTY, SLOPE_PENALTY]))
        root = np.sqrt(w)[:, None]
        W = np.linalg.lstsq(
            np.vstack([root * X, ghosts]), np.vstack([root * Z, np.zeros((3, 2))]), rcond=None
        )[0]
        error = (w[:, None] * (Z - X @ W) ** 2).sum() / (w[:, None] * Z**2).sum()
        found.append((1.0 - error, tau, W @ direction))
    r_squared, tau, coefficients = max(found, key=lambda row: row[0])
    assert danger.time_scale == tau
    assert danger.r_squared == pytest.approx(r_squared, rel=1e-9)
    np.testing.assert_allclose(danger.coefficients, coefficients, rtol=1e-7, atol=1e-12)


def test_attempts_that_did_not_fail_say_nothing_of_the_danger():
    rng = np.random.default_rng(0)
    failures = [unstable(rng) for _ in range(3)]
    with_more = [*failures, unstable(rng, failed=False)]
    grouped = ways_to_fail(with_more, n_demonstrations=4)
    assert len(grouped) == 1
    assert [id(a) for a in grouped[0]] == [id(a) for a in failures]


def test_an_attempt_counts_by_how_long_it_lasted_but_never_more_than_a_demonstration():
    whole = demonstrate(make_system("cartpole"), "weak", seed=0)[0]
    lasting = [whole.cut(n) for n in (10, 20, 30, 5, 40)]
    shares = shares_of_the_usual(lasting, n_demonstrations=3)
    assert shares == pytest.approx([0.5, 1.0, 1.0, 0.25, 1.0])


def test_later_trials_differ_and_half_of_them_keep_half_of_the_longest_lasting():
    system = make_system("cartpole")
    task, shown = Task.of(system, STATE), demonstrate(system, "weak", n=8, seed=1)
    demonstrations, trials = tuple(shown[:4]), tuple(shown[4:])
    best = max(range(4), key=lambda i: trials[i].duration)
    # Gains that no learner would find by itself, to be seen again.
    policies = tuple(LinearPolicy(task, np.zeros(1), np.full((1, 2), 1e6 + i)) for i in range(4))
    evidence = Evidence(demonstrations, trials, policies)
    fall = LEARNERS["fall"]()
    gains = [fall.policy(task, evidence, np.random.default_rng(i)).gain[0] for i in range(30)]
    kept = [gain for gain in gains if gain[0] > 1e5]
    assert 8 <= len(kept) <= 22
    assert len({gain.tobytes() for gain in gains}) == 30
    own = np.median([gain for gain in gains if gain[0] < 1e5], axis=0)
    assert np.median(kept, axis=0) == pytest.approx(0.5 * (1e6 + best + own), abs=20)
    steady = LEARNERS["fall"](steady_trials=5)
    same = [steady.policy(task, evidence, np.random.default_rng(i)).gain for i in range(3)]
    assert np.array_equal(same[0], same[1])
    assert np.array_equal(same[0], same[2])


def test_ways_to_fail_are_the_lines_along_which_attempts_ended():
    rng = np.random.default_rng(3)

    def ending_in(x):
        return Scaled(np.array([[0.0, 0.0], x]), np.zeros((1, 1)), True, 1.0)

    falls = [ending_in([s, 0.1 * rng.normal()]) for s in (1.0, -1.2, 0.9)]
    rails = [ending_in([0.1 * rng.normal(), s]) for s in (3.0, -2.5)]
    grouped = ways_to_fail([*falls, *rails], n_demonstrations=3)
    assert [[id(a) for a in way] for way in grouped] == [
        [id(a) for a in falls],
        [id(a) for a in rails],
    ]


def test_the_slow_danger_is_commanded_through_the_fast_one():
    # p' = 2 p + 3 a falls fast; q' = p drifts, and no action reaches it but through p.
    rng = np.random.default_rng(4)
    attempts = []
    for _ in range(20):
        x, a = [np.array([0.02, 0.3]) * rng.normal(size=2)], []
        while len(a) < 200 and abs(x[-1][0]) < 1.0:
            a.append([rng.uniform(-1, 1)])
            p, q = x[-1]
            x.append(np.array([p + DT * (2.0 * p + 3.0 * a[-1][0]), q + DT * 2.0 * p]))
        attempts.append(Scaled(np.array(x), np.array(a), True, 1.0))
    fast = Danger(np.array([0.0, 1.0, 0.0]), 0.2, 1.0)
    slow = Danger(np.array([0.0, 0.4, 1.0]), 1.0, 1.0)
    alone, both = cascade(attempts, [fast], 0.06, DT), cascade(attempts, [fast, slow], 0.06, DT)
    for rows, steady in ((alone, False), (both, True)):
        p, q = 0.0, 0.5
        for _ in range(1500):
            action = np.clip(rows[0] @ [1.0, p, q], -1, 1)
            p, q = p + DT * (2.0 * p + 3.0 * action), q + DT * 2.0 * p
        assert (abs(p) < 0.1 and abs(q) < 0.1) == steady


def test_the_control_minimises_the_expected_square():
    rng = np.random.default_rng(1)
    attempts = [unstable(rng) for _ in range(4)]
    danger = Danger(np.array([0.1, 1.0, 0.4]), 0.2, 1.0)
    response = respond(attempts, [a.a for a in attempts], danger, horizon=3)
    # The posterior of the coefficients, from its definition, one window at a time.
    X, y, w = [], [], []
    for attempt in attempts:
        for t in range(len(attempt.a) - 2):
            X.append([1.0, *attempt.x[t], attempt.a[t : t + 3].mean()])
            y.append(danger.coefficients @ [1.0, *attempt.x[t + 3]])
            w.append(attempt.weight)
    X, y, w = np.array(X), np.array(y), np.array(w) / np.mean(w)
    y /= np.sqrt(np.mean(y**2))
    A = np.einsum("n,ni,nj->ij", w, X, X) + EFFECT_PENALTY * np.eye(4)
    c = np.linalg.solve(A, np.einsum("n,ni,n->i", w, X, y))
    noise = w @ (y - X @ c) ** 2 / (len(y) - 4) + 1e-9
    second = np.outer(c, c) + 3 * noise * np.linalg.inv(A)
    for state in rng.normal(size=(5, 2)):
        features = lambda a, x=state: np.array([1.0, *x, a])  # noqa: E731
        best = minimize(
            lambda a, f=features: f(a[0]) @ second @ f(a[0]), [0.0], method="BFGS", tol=1e-12
        )
        assert response.gain[0] @ [1.0, *state] == pytest.approx(best.x[0], abs=1e-5)


def test_several_actions_each_get_a_gain():
    rng = np.random.default_rng(2)
    attempts = []
    for _ in range(4):
        one = unstable(rng)
        idle = rng.uniform(-1, 1, size=(len(one.a), 1))
        attempts.append(one._replace(a=np.hstack([one.a, idle])))
    gain = cascade(attempts, [learn_danger(attempts, DT)], 0.06, DT)
    assert gain.shape == (2, 3)
    # The second action does nothing, so hardly anything is asked of it.
    assert np.abs(gain[1]).max() < 0.2 * np.abs(gain[0]).max()


def test_an_attempt_that_began_as_a_failure_says_nothing():
    system = make_system("cartpole")
    shown = demonstrate(system, "weak", n=4, seed=0)
    fallen = replace(shown[0], failure_step=0)
    task = Task.of(system, STATE)

    def gain(demonstrations):
        evidence = Evidence(tuple(demonstrations), ())
        return LEARNERS["fall"]().policy(task, evidence, np.random.default_rng(0)).gain

    np.testing.assert_array_equal(gain([*shown, fallen]), gain(shown))
    with pytest.raises(MisstepError, match="at least one failure, after the start of its attempt"):
        gain([fallen])


def test_needs_a_failure_time():
    system = make_system("cartpole", fall_angle_deg=180.0, duration=1.0, stop_at_fall=False)
    shown = demonstrate(make_system("cartpole"), "weak", n=2, seed=0)
    untimed = [type(t)(**{**t.__dict__, "failure_step": None}) for t in shown]
    with pytest.raises(MisstepError, match="fall needs the time of at least one failure"):
        learn(system, type(shown)(untimed), "fall", state=STATE)
