"""Badly scaled, nearly singular, degenerate and far away: right, or one clear refusal.

"Right" is measured against `high_precision.py`. A bound is a multiple of the rounding unit u and of
the condition number κ of the covariance, each column in its own deviation: what a change of the
covariance in its last digit does to the answer. Beyond κ = 1e11 a mixture may be refused.

``pytest --hypothesis-show-statistics`` tells the worst error seen, as a share of its bound.
"""

import math
import re
from typing import NamedTuple

import high_precision as hp
import numpy as np
import pytest
from high_precision import UNIT, exact, rounded
from hypothesis import event, given, target
from hypothesis import strategies as st

from misstep import MisstepError
from misstep.mixture import (
    Conditional,
    Conditioner,
    Donut,
    DonutMixture,
    DonutQuery,
    DonutShape,
    GaussianMixture,
    exploration_from_variance,
)

SEEDS = st.integers(0, 2**32 - 1)
COMPONENTS = st.sampled_from([1, 1, 2, 2, 3, 4, 6, 20])
CONDITIONS = st.one_of(st.floats(0, 6), st.floats(6, 16))
# Exponents of ten of the columns' scales: all alike, or each its own.
SCALES = st.sampled_from([-12, 0, 12, None])
EXPLORATIONS = st.one_of(
    st.sampled_from([0.0, 1e-300, 1e-15, 1e-9, 1 - 1e-9, 1 - 1e-15, 1.0]), st.floats(0, 1)
)
MAY_REFUSE = 1e11


def condition_of(covariance):
    """Condition number of a covariance, each column in its own deviation."""
    deviation = np.sqrt(np.diag(covariance))
    return np.linalg.cond(covariance / deviation / deviation[:, None])


def draw_scale(rng, d, exponent):
    return 10.0 ** (rng.integers(-12, 13, size=d) if exponent is None else np.full(d, exponent))


def draw_covariance(rng, scale, condition):
    """Draw a covariance whose condition number is about 10**condition."""
    d = len(scale)
    turn = np.linalg.qr(rng.normal(size=(d, d)))[0]
    matrix = (turn * np.logspace(0, -condition, d)) @ turn.T
    deviation = np.sqrt(np.diag(matrix))
    return 0.5 * (matrix + matrix.T) / np.outer(deviation, deviation) * np.outer(scale, scale)


class Parameters(NamedTuple):
    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray

    @property
    def conditions(self):
        return np.array([condition_of(c) for c in self.covariances])

    def precise(self):
        return hp.Mixture(*map(exact, self))


def draw(rng, d, K, condition, exponent, sizes=0.0, spread=2.0):
    """Draw a mixture whose components are up to 10**±sizes times the columns' scales."""
    scale = draw_scale(rng, d, exponent)
    own = 10.0 ** rng.uniform(-sizes, sizes, size=K)
    covariances = np.array([draw_covariance(rng, s * scale, condition) for s in own])
    weights = rng.dirichlet(np.full(K, 0.5)) + 1e-12
    return Parameters(weights, spread * scale * rng.normal(size=(K, d)), covariances)


MIXTURES = st.builds(
    lambda seed, **settings: draw(np.random.default_rng(seed), **settings),
    seed=SEEDS,
    d=st.integers(2, 5),
    K=COMPONENTS,
    condition=CONDITIONS,
    exponent=SCALES,
    sizes=st.sampled_from([0.0, 1.0, 6.0]),
    spread=st.sampled_from([0.0, 2.0, 1e6]),
)


def unless_refused(parameters, make):
    """Return what is made of a mixture, or None where it was refused with reason."""
    try:
        return make()
    except MisstepError as refusal:
        reason = str(refusal)
    event("refused")
    assert re.search("definite|singular", reason)
    assert parameters.conditions.max() > MAY_REFUSE
    return None


def accepted(parameters):
    """Return the fitted mixture, or None where it was refused with reason."""
    return unless_refused(parameters, lambda: GaussianMixture.from_parameters(*parameters))


class Errors(dict):
    """The worst errors of one example by what they are errors of, as shares of their bounds."""

    def see(self, name, error, bound):
        share = float(np.max(error / np.maximum(bound, 1e-300)))
        assert share <= 1.0, f"{name}: {share:g} times the bound"
        self[name] = max(share, self.get(name, 0.0))

    def seek_larger(self):
        for name, share in self.items():
            target(share, label=name)


def points_of(rng, parameters, distance):
    """Draw points next to a component, ten and 10**distance deviations away, and the middle."""
    k = rng.integers(len(parameters.weights))
    deviation = np.sqrt(np.diag(parameters.covariances[k]))
    direction = rng.normal(size=(3, len(deviation)))
    steps = np.array([1.0, 10.0, 10.0**distance])[:, None] * deviation * direction
    return np.vstack([parameters.means[k] + steps, parameters.means.mean(axis=0)])


def log_bounds(squared, conditions, d):
    """Bound the error of each component's log density at squared distances (K,)."""
    return 16.0 * UNIT * (d * conditions * (1.0 + rounded(squared)) + 100.0)


def largest_of_relevant(joint, bounds):
    """Return the largest bound among the terms that count in a sum of exp(joint)."""
    joint = rounded(joint)
    return bounds[joint + bounds > joint.max() - 46.0].max()


def exps(values):
    return np.array([float(hp.MP.exp(value)) for value in values])


def errors(ours, precise):
    return rounded(abs(exact(ours) - precise))


# The mixture


@given(parameters=MIXTURES, seed=SEEDS, distance=st.floats(0, 100))
def test_density_and_responsibilities(parameters, seed, distance):
    model = accepted(parameters)
    if model is None:
        return
    X = points_of(np.random.default_rng(seed), parameters, distance)
    log_density, p = model.score_samples(X), model.predict_proba(X)
    assert np.all(np.isfinite(log_density))
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-12)
    conditions = parameters.conditions
    if conditions.max() > MAY_REFUSE:
        return
    precise, seen = parameters.precise(), Errors()
    for x, ours, r in zip(X, log_density, p, strict=True):
        squared = precise.squared(exact(x))
        joint = precise.log_joint(squared)
        total = hp.log_sum(joint)
        bound = largest_of_relevant(joint, log_bounds(squared, conditions, len(x)))
        seen.see("log density", errors(ours, total), bound)
        seen.see("responsibilities", np.abs(r - exps(joint - total)), 2.0 * bound)
    seen.seek_larger()


def conditional_bounds(mean, covariance, x):
    """First-order bounds on the errors of m (d,) and S (d, d) at x (n,)."""
    n, joint = len(x), len(covariance)
    deviation = x - mean[:n]
    s = np.sqrt(np.diag(covariance))
    correlation = covariance / s / s[:, None]
    inverse = np.linalg.inv(correlation[:n, :n])
    gains = np.abs(correlation[n:, :n] @ inverse)
    reach = s[n:] * (1.0 + gains.sum(axis=1))
    push = (np.abs(inverse) @ np.abs(deviation / s[:n])).sum()
    unit = 16.0 * joint * UNIT
    summands = np.abs(mean[n:]) + s[n:] * (gains @ np.abs(deviation / s[:n]))
    return unit * (reach * push + summands), unit * np.outer(reach, reach)


@given(parameters=MIXTURES, seed=SEEDS, distance=st.floats(0, 100), n=st.integers(1, 4))
def test_conditional(parameters, seed, distance, n):
    model, conditions = accepted(parameters), parameters.conditions
    d = parameters.means.shape[1]
    n = min(n, d - 1)
    if model is None:
        return
    conditioner = unless_refused(parameters, lambda: Conditioner(model, range(n)))
    if conditioner is None:
        return
    precise, seen = hp.Conditioner(parameters.precise(), n), Errors()
    for x in points_of(np.random.default_rng(seed), parameters, distance)[:, :n]:
        h, m, S = conditioner.at(x)
        assert h.sum() == pytest.approx(1.0, rel=1e-12)
        assert np.all(np.isfinite(m))
        assert np.all(np.diagonal(S, axis1=1, axis2=2) > 0)
        if conditions.max() > MAY_REFUSE:
            continue
        squared, log_h, expected_m = precise.at(exact(x))
        bound = largest_of_relevant(log_h, log_bounds(squared, conditions, n))
        seen.see("h", np.abs(h - exps(log_h)), 2.0 * bound)
        for k, (mean, covariance) in enumerate(zip(*parameters[1:], strict=True)):
            m_bound, S_bound = conditional_bounds(mean, covariance, x)
            seen.see("m", errors(m[k], expected_m[k]), m_bound)
            seen.see("S", errors(S[k], precise.covariances[k]), S_bound)
    seen.seek_larger()


# The donut


def draw_conditional(seed, **settings):
    parameters = draw(np.random.default_rng(seed), **settings)
    return Parameters(parameters.weights / parameters.weights.sum(), *parameters[1:])


def conditionals(d, sizes=(0.0, 1.0, 6.0)):
    return st.builds(
        draw_conditional,
        seed=SEEDS,
        d=d,
        K=COMPONENTS,
        condition=CONDITIONS,
        exponent=SCALES,
        sizes=st.sampled_from(sizes),
        spread=st.sampled_from([0.0, 2.0, 1e6]),
    )


KS, REACHES = st.floats(1.2, 4.0), st.floats(1.0, 4.0)


def accepted_donut(parameters, exploration, k=2.0, reach=2.0):
    """Return the donut mixture and the precise one, or None where it was refused with reason."""
    conditional = Conditional(*parameters)
    mixture = unless_refused(parameters, lambda: DonutMixture(conditional, exploration, k, reach))
    if mixture is None:
        return None
    log_h = [hp.MP.log(w) for w in exact(parameters.weights)]
    return mixture, hp.DonutMixture(log_h, *map(exact, parameters[1:]), exact(mixture.shape))


@given(
    parameters=conditionals(st.integers(1, 4)),
    seed=SEEDS,
    distance=st.floats(0, 100),
    exploration=EXPLORATIONS,
    k=KS,
    reach=REACHES,
)
def test_donut_density_and_gradient(parameters, seed, distance, exploration, k, reach):
    made = accepted_donut(parameters, exploration, k, reach)
    if made is None:
        return
    (mixture, precise), seen = made, Errors()
    rng, d = np.random.default_rng(seed), parameters.means.shape[1]
    points = np.vstack([points_of(rng, parameters, distance), rng.choice(parameters.means)])
    log_density, gradient = mixture.log_pdf(points), mixture.gradient(points)
    assert np.all(log_density < np.inf)
    conditions = parameters.conditions
    if conditions.max() > MAY_REFUSE:
        return
    deviations = np.sqrt(np.diagonal(parameters.covariances, axis1=1, axis2=2))
    for a, ours, slope in zip(points, log_density, gradient, strict=True):
        squared = precise.squared(exact(a))
        wide = np.array([part[0] for part in precise.parts(exact(a))])
        unit = hp.log_sum(wide)
        bounds = log_bounds(squared, conditions, d)
        bound = 16.0 * largest_of_relevant(wide, bounds) + 64.0 * UNIT * (
            k**d + k**d / (k**d - 1.0) + abs(float(unit))
        )
        value, expected = precise.density(exact(a), unit)
        if bound > 1.0:
            continue
        seen.see("density", errors(hp.MP.exp(hp.MP.mpf(ours) - unit), value), bound)
        if abs(unit) > 600:
            continue
        counting = rounded(wide) + bounds > float(unit) - 46.0
        steep = 16.0 * np.sqrt(conditions * (1.0 + rounded(squared)))[counting, None]
        error = errors(exact(slope) * hp.MP.exp(-unit), expected)
        seen.see("gradient", error, bound * (steep / deviations[counting]).max(axis=0))
    seen.seek_larger()


@given(exploration=EXPLORATIONS, d=st.integers(1, 8), k=KS, reach=REACHES)
def test_the_family_of_donuts(exploration, d, k, reach):
    gamma, r_alpha, r_beta = DonutShape.of(exploration, d, k, reach)
    e, power = hp.MP.mpf(exploration), hp.MP.mpf(k) ** d
    unit = 8.0 * UNIT
    assert errors(gamma, 1 + e / (power - 1)) <= unit * gamma * (1.0 + k / (k - 1.0))
    assert errors(r_alpha, 1 / (1 + (hp.MP.mpf(reach) - 1) * e)) <= unit
    assert errors(r_beta, hp.MP.mpf(k) * hp.MP.mpf(r_alpha)) <= unit * r_beta
    density = Donut(np.zeros(d), np.eye(d), DonutShape(gamma, r_alpha, r_beta)).pdf([np.zeros(d)])
    height = (r_alpha / math.sqrt(2.0 * math.pi)) ** d
    rounding = 16.0 * d * UNIT * (k**d + gamma)
    assert density[0] / height == pytest.approx(1.0 - exploration, rel=1e-13, abs=rounding)


def nearest_maximum(precise, a, unit):
    """Return slope and curvature of log D over one action, in units of `unit`."""
    step = hp.MP.mpf(10) ** -15 * unit
    at = exact(a)
    shift = precise.wide(at)

    def slope(b):
        value, gradient = precise.density(b, shift)
        return gradient[0] / value * unit

    return slope(at), (slope(at + step) - slope(at - step)) / (2 * step) * unit


@given(
    parameters=conditionals(st.integers(1, 4)),
    exploration=EXPLORATIONS,
    warm=st.booleans(),
    distance=st.floats(0, 6),
)
def test_mode_of_one_donut(parameters, exploration, warm, distance):
    one = Parameters(np.ones(1), parameters.means[:1], parameters.covariances[:1])
    made = accepted_donut(one, exploration)
    if made is None:
        return
    (mixture, precise), seen = made, Errors()
    deviation, d = np.sqrt(np.diag(one.covariances[0])), one.means.shape[1]
    start = one.means[0] + 10.0**distance * deviation if warm else None
    mode = mixture.mode(start)
    assert np.all(np.isfinite(mode))
    condition = one.conditions.max()
    if condition > MAY_REFUSE:
        return
    # Of A exp(−αt) − B exp(−βt) at t = m², from its derivative.
    gamma, r_alpha, r_beta = map(hp.MP.mpf, mixture.shape)
    heights = gamma * r_alpha**d, (gamma - 1) * r_beta**d
    rates = r_alpha**2 / 2, r_beta**2 / 2
    steepness = heights[1] * rates[1] / (heights[0] * rates[0])
    t = hp.MP.log(steepness) / (rates[1] - rates[0]) if steepness > 1 else hp.MP.mpf(0)

    def log_density(t):
        parts = (h * hp.MP.exp(-rate * t) for h, rate in zip(heights, rates, strict=True))
        return hp.MP.log(next(parts) - next(parts))

    found = precise.squared(exact(mode))[0]
    places = d * UNIT * math.sqrt(condition) * (np.abs(mode) / deviation).max()
    seen.see("log density of a mode", log_density(t) - log_density(found), 1e-9 + 1e2 * places**2)
    seen.seek_larger()


# Components up to 1e6 times each other's size: beside one that is 1e11 times as wide as another, a
# climb is further than 1e6 deviations from the narrow one, and may run out of its steps.
@given(
    parameters=conditionals(st.just(1), sizes=(0.0, 1.0, 3.0)),
    exploration=EXPLORATIONS,
    seed=SEEDS,
    warm=st.booleans(),
    distance=st.floats(0, 6),
)
def test_mode_over_one_action(parameters, exploration, seed, warm, distance):
    mixture, precise = accepted_donut(parameters, exploration)
    k = np.random.default_rng(seed).integers(len(parameters.weights))
    deviations = np.sqrt(parameters.covariances[:, 0, 0])
    start = parameters.means[k] + 10.0**distance * deviations[k] if warm else None
    mode = mixture.mode(start)
    assert np.all(np.isfinite(mode))
    if warm:
        assert mixture.log_pdf([mode])[0] >= mixture.log_pdf([start])[0]
    weight = exps([wide - precise.wide(exact(mode)) for wide, _, _ in precise.parts(exact(mode))])
    unit = 1.0 / math.sqrt(weight @ deviations**-2.0)
    slope, curvature = nearest_maximum(precise, mode, exact(unit)[()])
    places = UNIT * abs(mode[0]) / unit
    assert abs(slope) <= 1e-5 + 100.0 * places
    assert curvature <= 1e-2


@given(scale=st.floats(-12, 12), spread=st.floats(-300, 300))
def test_exploration(scale, spread):
    v, s = np.array([[10.0**spread]]), np.array([10.0**scale])
    ratio = exact(v)[0, 0] / exact(s)[0] ** 2
    for formula, expected in (("prose", ratio / (1 + ratio)), ("printed", 1 / (1 + ratio))):
        assert exploration_from_variance(v, s, formula) == pytest.approx(
            float(expected), rel=8.0 * UNIT, abs=1e-300
        )


# A state in, an action out


@given(
    parameters=MIXTURES,
    seed=SEEDS,
    distance=st.floats(0, 100),
    scale=st.floats(-3, 3),
    formula=st.sampled_from(["prose", "printed"]),
)
def test_an_action_for_a_state(parameters, seed, distance, scale, formula):
    model = accepted(parameters)
    n = parameters.means.shape[1] - 1
    if model is None:
        return
    deviation = np.sqrt(np.diagonal(parameters.covariances, axis1=1, axis2=2))
    s = 10.0**scale * deviation[:, n:].mean(axis=0)
    conditioner = unless_refused(parameters, lambda: Conditioner(model, range(n)))
    if conditioner is None:
        return
    query = unless_refused(parameters, lambda: DonutQuery(conditioner, s, formula=formula))
    if query is None:
        return
    states = points_of(np.random.default_rng(seed), parameters, distance)[:, :n]
    actions, explorations = query.modes(states)
    assert np.all(np.isfinite(actions))
    assert np.all((explorations >= 0.0) & (explorations <= 1.0))
    for x, action, exploration in zip(states, actions, explorations, strict=True):
        conditional = conditioner.at(x)
        mixture = DonutMixture(conditional, exploration)
        dense = mixture.log_pdf([mixture.mode(), action])
        assert dense[0] == pytest.approx(dense[1], abs=1e-6)
        h, m, S = map(exact, conditional)
        mean = h @ m / hp.MP.fsum(h)
        variance = (h @ (S[:, 0, 0] + (m[:, 0] - mean[0]) ** 2)) / hp.MP.fsum(h)
        ratio = variance / exact(s)[0] ** 2
        expected = 1 / (1 + ratio) if formula == "printed" else ratio / (1 + ratio)
        # Of means far from zero and close to each other, that many digits differ.
        lost = float(abs(m).max() / hp.MP.sqrt(variance))
        bound = 1e-12 + 64.0 * UNIT * lost
        assert exploration == pytest.approx(float(expected), rel=bound, abs=1e-300)


# Expectation–maximisation


def draw_weight(rng, n, kind):
    """Draw weights (n,) from 0 to 1e9, at least four of them not 0."""
    if kind == "equal":
        return np.ones(n)
    weight = 10.0 ** rng.uniform(-9, 9, size=n)
    weight[4:] *= rng.random(n - 4) < 0.8
    return weight


WEIGHTS = st.sampled_from(["equal", "wide"])


def draw_samples(rng, n, d, exponent, offset):
    """Draw three clouds of samples (n, d), some of them twice, 10**offset deviations from zero."""
    scale = draw_scale(rng, d, exponent)
    X = rng.normal(size=(n, d)) + 5.0 * rng.normal(size=(3, d))[rng.integers(3, size=n)]
    X[n // 2 :] = X[rng.integers(n, size=n - n // 2)]
    return scale * (X + 10.0**offset * rng.normal(size=d)), scale


def spreads(Z, r, means):
    """Return Σ r |z − μ| / Σ r (K, d) and Σ r |z − μ||z − μ|ᵀ / Σ r (K, d, d)."""
    mass = r.sum(axis=0)[:, None]
    deviations = np.abs(Z[:, None] - means)
    first = np.einsum("nk,nkj->kj", r, deviations) / mass
    return first, np.einsum("nk,nki,nkj->kij", r, deviations, deviations) / mass[:, :, None]


def joint_bounds(Z, mixture):
    """Bound the errors of a fit's log joint densities (N, K), whose samples are standardised."""
    means, covariances = rounded(mixture.means), rounded(mixture.covariances)
    # What whitening sample and mean apart loses, and what the factor does.
    widest = np.abs(Z).max() + np.abs(means).max()
    narrowest = np.array([np.linalg.eigvalsh(c)[0] for c in covariances])
    conditions = np.array([condition_of(c) for c in covariances])
    squared = np.array([rounded(mixture.squared(exact(z))) for z in Z])
    whitened = widest / np.sqrt(narrowest)
    d = Z.shape[1]
    return log_bounds(squared, conditions, d) + 32.0 * d * UNIT * whitened * np.sqrt(1.0 + squared)


@pytest.mark.filterwarnings("ignore:expectation–maximisation did not converge")
@given(
    seed=SEEDS,
    n=st.integers(5, 24),
    d=st.integers(1, 3),
    K=st.sampled_from([1, 2, 3, 5, 20]),
    exponent=SCALES,
    offset=st.floats(-3, 6),
    weights=WEIGHTS,
    condition=st.floats(0, 6),
)
def test_a_weighted_step(seed, n, d, K, exponent, offset, weights, condition):
    rng = np.random.default_rng(seed)
    X, scale = draw_samples(rng, n, d, exponent, offset)
    weight = draw_weight(rng, n, weights)
    K = min(K, np.count_nonzero(weight))
    means = X[rng.choice(n, size=K, replace=False)] + scale * rng.normal(size=(K, d))
    precisions = np.array([draw_covariance(rng, 1.0 / scale, condition) for _ in range(K)])
    shares = rng.dirichlet(np.full(K, 2.0)) + 1e-3
    model = GaussianMixture(
        K, weights_init=shares, means_init=means, precisions_init=precisions, tol=0.0, max_iter=1
    )
    try:
        model.fit(X, sample_weight=weight)
    except MisstepError as refusal:
        reason = str(refusal)
    else:
        reason = ""
    if reason:
        # Two samples that weigh next to nothing may lie 1e4 deviations of all the others apart.
        event("refused")
        assert re.search("collapsed.* a covariance_floor > 1e-06 prevents it", reason)
        assert weights == "wide"
        return
    for value in (model.weights_, model.means_, model.covariances_, model.lower_bound_):
        assert np.all(np.isfinite(value))

    used = weight > 0
    Z, centre, unit = hp.standardised(exact(X[used]), exact(weight[used]))
    inverses = [hp.inverse(precision) for precision in exact(precisions)]
    start = hp.Mixture(
        exact(shares), (exact(means) - centre) / unit, np.array(inverses) / np.outer(unit, unit)
    )
    mass, new = hp.em_step(Z, exact(weight[used]), start, hp.MP.mpf(1e-6))
    r = rounded(hp.expectation(Z, start)[1]) * weight[used, None]
    claimed = rounded(mass / mass.sum())
    bounds = joint_bounds(rounded(Z), start)
    bound = 4.0 * (bounds * (r > 0)).max()
    if bound > 1e-3 or np.any((claimed < 1.1e-12) & (claimed > 0.9e-12)):
        event("too far apart to tell")
        return
    seen, kept = Errors(), claimed > 1e-12
    seen.see("weights", errors(model.weights_, mass / mass.sum()), bound * claimed + 1e-14)
    expected = rounded(new.covariances[kept])
    first, second = spreads(rounded(Z), r[:, kept], rounded(new.means[kept]))
    moved = np.abs(rounded(new.means - start.means))[kept]
    last_digit = np.abs(X).max(axis=0) / rounded(unit) + np.abs(rounded(Z)).max(axis=0)
    seen.see(
        "means",
        errors(model.means_, new.means * unit + centre)[kept] / rounded(unit),
        4.0 * bound * first + 64.0 * UNIT * (first + moved + last_digit),
    )
    # One that jumps keeps the covariance that its start's precision has.
    spread = second + moved[:, :, None] * moved[:, None, :] + 10.0**condition * np.abs(expected)
    seen.see(
        "covariances",
        errors(model.covariances_ / np.outer(rounded(unit), rounded(unit)), new.covariances)[kept],
        8.0 * bound * second + 256.0 * UNIT * spread + 1e-18,
    )
    seen.seek_larger()


def degenerate(rng, kind, n, d, scale):
    """Draw samples (n, d) of which fits are afraid."""
    cloud = rng.normal(size=(n, d))
    X = {
        "cloud": cloud,
        "one point": np.tile(cloud[0], (n, 1)),
        "two points": cloud[rng.integers(2, size=n)],
        "duplicates": cloud[rng.integers(min(d + 2, n), size=n)],
        "on a line": rng.normal(size=(n, 1)) * cloud[0],
        "nearly on a line": rng.normal(size=(n, 1)) * cloud[0] + 1e-9 * cloud,
        "whole numbers": np.round(cloud),
        "one constant": np.where(np.arange(d) == 0, 0.1, cloud),
        "an outlier": np.vstack([cloud[1:], 1e12 * cloud[:1]]),
    }[kind]
    return X * scale


KINDS = [
    "cloud",
    "one point",
    "two points",
    "duplicates",
    "on a line",
    "nearly on a line",
    "whole numbers",
    "one constant",
    "an outlier",
]


@pytest.mark.filterwarnings("ignore:expectation–maximisation did not converge")
@given(
    seed=SEEDS,
    kind=st.sampled_from(KINDS),
    n=st.integers(2, 40),
    d=st.integers(1, 4),
    K=st.sampled_from([None, 1, 2, 5, 20]),
    exponent=SCALES,
    weights=WEIGHTS,
    floor=st.sampled_from([1e-6, 1e-6, 1e-12, 0.0]),
)
def test_a_fit(seed, kind, n, d, K, exponent, weights, floor):
    rng = np.random.default_rng(seed)
    X = degenerate(rng, kind, n, d, draw_scale(rng, d, exponent))
    weight = draw_weight(rng, n, weights) if n > 4 else np.ones(n)
    model = GaussianMixture(K, covariance_floor=floor, max_iter=50, n_init=2, random_state=0)
    try:
        model.fit(X, sample_weight=weight)
    except MisstepError as refusal:
        (reason,) = re.findall("constant|only|collapsed|singular", str(refusal))
        event(f"refused: {reason}")
        if reason == "collapsed":
            assert floor < 1e-6
        return
    for value in (model.weights_, model.means_, model.covariances_, model.lower_bound_):
        assert np.all(np.isfinite(value))
    assert model.weights_.sum() == pytest.approx(1.0, rel=1e-12)
    conditions = np.array([condition_of(c) for c in model.covariances_])
    if conditions.max() > MAY_REFUSE:
        return
    seen, used = Errors(), weight > 0
    mixture = hp.Mixture(*map(exact, (model.weights_, model.means_, model.covariances_)))
    bounds, densities = [], []
    for x, ours in zip(X[used], model.score_samples(X[used]), strict=True):
        squared = mixture.squared(exact(x))
        joint = mixture.log_joint(squared)
        bounds.append(largest_of_relevant(joint, log_bounds(squared, conditions, d)))
        densities.append(hp.log_sum(joint))
        seen.see("log density", errors(ours, densities[-1]), bounds[-1])
    # The fit's own whitening, of standardised samples, is held to a thousandfold.
    mean = exact(weight[used]) @ np.array(densities) / hp.MP.fsum(exact(weight[used]))
    seen.see("lower bound", errors(model.lower_bound_, mean), 1e-9 + 1e3 * max(bounds))
    seen.seek_larger()


# Two hundred columns


@pytest.fixture(scope="module")
def wide():
    """Return a Gaussian in 200 columns of scales 1e-12 to 1e12, and it with sixty digits."""
    rng = np.random.default_rng(0)
    scale = draw_scale(rng, 200, None)
    covariance = draw_covariance(rng, scale, 4.0)
    parameters = Parameters(np.ones(1), scale * rng.normal(size=(1, 200)), covariance[None])
    return parameters, parameters.precise()


def test_density_in_200_columns(wide):
    parameters, precise = wide
    x = points_of(np.random.default_rng(1), parameters, 3.0)[1]
    squared = precise.squared(exact(x))
    model = GaussianMixture.from_parameters(*parameters)
    error = errors(model.score_samples([x])[0], precise.log_joint(squared)[0])
    assert error <= log_bounds(squared, parameters.conditions, 200)[0]
    # The state's factor is a part of the whole one: what is left of one action needs no other.
    h, m, S = model.condition(range(199), x[:199])
    (lower,), (mean,) = precise.lowers, precise.means
    y = hp.solve_lower(lower[:199, :199], exact(x - mean)[:199])
    m_bound, S_bound = conditional_bounds(parameters.means[0], parameters.covariances[0], x[:199])
    assert h == 1.0
    assert errors(m[0, 0], mean[199] + lower[199, :199] @ y) <= m_bound[0]
    assert errors(S[0, 0, 0], lower[199, 199] ** 2) <= S_bound[0, 0]


def test_a_donut_in_200_columns(wide, refused):
    parameters, precise = wide
    mixture = DonutMixture(Conditional(*parameters), 1.0, k=1.05)
    assert mixture.log_pdf(parameters.means)[0] == -math.inf
    mode = mixture.mode()
    found = precise.squared(exact(mode))[0]
    assert float(found) == pytest.approx(mixture.ridge_radius**2, rel=1e-7)
    gamma, r_alpha, r_beta = exact(mixture.shape)
    wide_one, narrow = (
        hp.log_gaussian(found * r**2, precise.lowers[0]) + 200 * hp.MP.log(r)
        for r in (r_alpha, r_beta)
    )
    expected = hp.MP.log(gamma * hp.MP.exp(wide_one) - (gamma - 1) * hp.MP.exp(narrow))
    assert mixture.log_pdf([mode])[0] == pytest.approx(float(expected), rel=1e-11)
    with refused("a donut in 200 dimensions takes k from .* to 1.109, .* got k=2.0"):
        DonutMixture(Conditional(*parameters), 1.0)


def test_a_fit_in_200_columns():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(300, 200)) * draw_scale(rng, 200, None)
    model = GaussianMixture(2, random_state=0).fit(X)
    assert np.all(np.isfinite(model.covariances_))
    assert model.lower_bound_ == pytest.approx(model.score(X), rel=1e-9)
    # Of fewer samples than columns the floor makes a covariance.
    few = GaussianMixture(1).fit(X[:50])
    Z = (X[:50] - X[:50].mean(axis=0)) / X[:50].std(axis=0)
    unit = np.outer(X[:50].std(axis=0), X[:50].std(axis=0))
    expected = Z.T @ Z / 50 + 1e-6 * np.eye(200)
    np.testing.assert_allclose(few.covariances_[0] / unit, expected, rtol=1e-7, atol=1e-12)


# One clear refusal


def test_what_leaves_the_range_of_numbers(refused):
    model = GaussianMixture.from_parameters([1.0], [[0.0, 0.0]], [[[1.0, 0.5], [0.5, 1.0]]])
    with refused("sample 1 lies so far from every component"):
        model.score_samples([[1.0, 1.0], [1e200, 0.0]])
    with refused("sample 0 lies so far"):
        model.predict_proba([[1e200, -1e200]])
    assert np.isfinite(model.condition([0], [1e200]).means).all()
    steep = GaussianMixture.from_parameters([1.0], [[0.0, 0.0]], [[[1.0, 1e6], [1e6, 2e12]]])
    with refused("the actions there leave the range of numbers"):
        steep.condition([0], [1e305])
    with refused("the actions there leave the range of numbers"):
        Conditioner(steep, [0]).at_each([[1.0], [1e305]])


@pytest.mark.parametrize("distance", [1e150, 1e160, 1e300])
def test_an_action_where_squares_overflow(distance):
    mixture = draw(np.random.default_rng(0), d=2, K=3, condition=1.0, exponent=0)
    model = GaussianMixture.from_parameters(*mixture)
    query = DonutQuery(Conditioner(model, [0]), [1.0])
    actions, explorations = query.modes([[distance], [-distance]])
    assert np.all(np.isfinite(actions))
    np.testing.assert_array_equal(explorations, 1.0)


@pytest.mark.parametrize(("distance", "d"), [(1e150, 2), (1e160, 2), (1e300, 2), (1e300, 4)])
def test_a_spread_that_leaves_the_range_of_numbers(distance, d):
    joint = draw(np.random.default_rng(0), d=d, K=3, condition=1.0, exponent=0)
    model = GaussianMixture.from_parameters(*joint)
    for state in (distance, -distance):
        variance = model.condition([0], [state]).variance
        assert not np.isnan(variance).any()
        assert np.all(np.diag(variance) > 0.0)
        assert exploration_from_variance(variance, np.ones(d - 1)) <= 1.0
        for formula in ("prose", "printed"):
            query = DonutQuery(Conditioner(model, [0]), np.ones(d - 1), formula=formula)
            action, exploration = query.modes([[state]])
            assert np.isfinite(action).all()
            expected = exploration_from_variance(variance, np.ones(d - 1), formula)
            np.testing.assert_allclose(exploration, expected, rtol=1e-9)


@pytest.mark.parametrize("variance", [1e300, 1e308])
def test_a_donut_whose_density_is_no_number_is_flat(variance):
    donut = Donut([1.5], [[variance]], DonutShape.of(1.0, d=1))
    near = [[1.5], [2.1], [-0.4]]
    assert not np.isnan(donut.log_pdf(near)).any()
    np.testing.assert_array_equal(donut.gradient(near), np.zeros((3, 1)))


@pytest.mark.parametrize("gap", [0.0, 1e-16, 1e-15])
def test_a_singular_covariance(refused, gap):
    singular = np.array([[1.0, 1.0 - gap], [1.0 - gap, 1.0]]) * np.outer(
        [1e-12, 1e12], [1e-12, 1e12]
    )
    with refused("not symmetric positive definite, or too nearly singular"):
        GaussianMixture.from_parameters([1.0], [[0.0, 0.0]], [singular])
    with refused("positive definite"):
        DonutMixture(Conditional(np.ones(1), np.zeros((1, 2)), singular[None]), 0.5)
    with refused("positive definite"):
        Donut([0.0, 0.0], singular, DonutShape.of(0.5, 2))


def test_symmetry_is_asked_of_every_column_in_its_own_scale(refused):
    lopsided = np.diag([1e24, 1e-24, 1e-24])
    lopsided[1, 2] = 1e-25
    with refused("not symmetric"):
        GaussianMixture.from_parameters([1.0], np.zeros((1, 3)), [lopsided])


@pytest.mark.parametrize("direction", [(1.0, 0.3), (1.0, -1 / 3), (1.0, 1e-12)])
def test_every_line_is_a_line(refused, direction):
    X = np.random.default_rng(0).normal(size=(50, 1)) * direction
    with refused("the 1-component fit collapsed: the samples lie on a line"):
        GaussianMixture(1, covariance_floor=0.0).fit(X)
    assert GaussianMixture(1).fit(X).converged_


@pytest.mark.parametrize(
    ("k", "d", "line"), [(2.0, 30, "got k=2.0"), (1 + 1e-12, 1, "rounding closes"), (1e10, 1, "1e")]
)
def test_a_hole_that_rounding_would_close(refused, k, d, line):
    with refused(line):
        DonutShape.of(1.0, d, k)
    with refused(line):
        Donut(np.zeros(d), np.eye(d), DonutShape(1.0 + 1e-9, 1.0, k))
    model = GaussianMixture.from_parameters([1.0], np.zeros((1, d + 1)), [np.eye(d + 1)])
    with refused(line):
        DonutQuery(Conditioner(model, [0]), np.ones(d), k=k)


@pytest.mark.parametrize("factor", [1e-300, 1e-9, 1e9, 1e299])
def test_only_the_ratios_of_weights_count(factor):
    rng = np.random.default_rng(0)
    X, weight = rng.normal(size=(30, 2)), rng.random(30)
    plain = GaussianMixture(random_state=0).fit(X, sample_weight=weight)
    scaled = GaussianMixture(random_state=0).fit(X, sample_weight=factor * weight)
    np.testing.assert_allclose(scaled.covariances_, plain.covariances_, rtol=1e-9)
    assert scaled.bics_ == pytest.approx(plain.bics_)
    assert scaled.bic(X, sample_weight=factor * weight) == pytest.approx(
        plain.bic(X, sample_weight=weight)
    )
