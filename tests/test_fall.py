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
    cautious_control,
    learn_danger,
)

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
    np.testing.assert_array_equal(
        learn_danger(failures, DT).coefficients, learn_danger(with_more, DT).coefficients
    )


def test_the_control_minimises_the_expected_square():
    rng = np.random.default_rng(1)
    attempts = [unstable(rng) for _ in range(4)]
    danger = Danger(np.array([0.1, 1.0, 0.4]), 0.2, 1.0)
    bias, gain = cautious_control(attempts, danger, horizon=3)
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
        assert bias[0] + gain[0] @ state == pytest.approx(best.x[0], abs=1e-5)


def test_several_actions_each_get_a_gain():
    rng = np.random.default_rng(2)
    attempts = []
    for _ in range(4):
        one = unstable(rng)
        idle = rng.uniform(-1, 1, size=(len(one.a), 1))
        attempts.append(one._replace(a=np.hstack([one.a, idle])))
    bias, gain = cautious_control(attempts, learn_danger(attempts, DT), horizon=3)
    assert bias.shape == (2,)
    assert gain.shape == (2, 2)
    # The second action does nothing, so hardly anything is asked of it.
    assert np.abs(gain[1]).max() < 0.2 * np.abs(gain[0]).max()


def test_needs_a_failure_time():
    system = make_system("cartpole", fall_angle_deg=180.0, duration=1.0, stop_at_fall=False)
    shown = demonstrate(make_system("cartpole"), "weak", n=2, seed=0)
    untimed = [type(t)(**{**t.__dict__, "failure_step": None}) for t in shown]
    with pytest.raises(MisstepError, match="fall needs the time of at least one failure"):
        learn(system, type(shown)(untimed), "fall", state=STATE)
