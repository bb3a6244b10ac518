"""The compiled expectation–maximisation, its threads, its chunks and its warm start."""

import math

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from misstep.mixture import GaussianMixture, RowChunks, compiled, em, reference, starts
from misstep.mixture.chunks import survey
from misstep.mixture.elementary import exp_nonpositive, log_positive

SEEDS = st.integers(0, 2**32 - 1)


def samples_of(mixture, n, rng):
    return GaussianMixture.from_parameters(*mixture).sample(n, rng)[0]


def step(samples, mixture, floor=0.0, panels=None):
    """One iteration in place; return the log-likelihood before it and the mass."""
    K, d = mixture.means.shape
    n_panels = em.panels_of(samples)
    moments = em.Moments.room_for(n_panels, K, d)
    only_moments = em.Rule(np.zeros(d), 0.0, -1)
    for first, last in panels or [(0, n_panels)]:
        work = em.Work.room_for(K, d)
        em.iterate(samples, mixture, moments, work, first, last, 0.0, only_moments)
    em.add_panels(moments)
    mass = moments.mass[0].copy()
    em.maximise(moments, mixture, np.full(d, floor))
    return moments.log_likelihood[0], mass


@given(seed=SEEDS, d=st.integers(1, 9), K=st.integers(1, 4), n=st.integers(1, 5000))
def test_one_iteration_against_the_reference(random_mixture, seed, d, K, n):
    rng = np.random.default_rng(seed)
    parameters = random_mixture(rng, K, d)
    X = samples_of(parameters, n, rng)
    weight = rng.random(n) + 0.1
    floor = 1e-3
    expected = reference.em_step(X, weight, *parameters, floor)
    mixture = em.Mixture(*(p.copy() for p in parameters))
    log_likelihood, mass = step(em.in_blocks(X, weight), mixture, floor)
    assert log_likelihood == pytest.approx(expected[0], rel=1e-9, abs=1e-9)
    np.testing.assert_allclose(mixture.weights, expected[1], rtol=1e-8, atol=1e-12)
    # A component that no sample claims keeps its place.
    claimed = mass > 1e-9 * mass.sum()
    np.testing.assert_allclose(mixture.means[claimed], expected[2][claimed], rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(
        mixture.covariances[claimed], expected[3][claimed], rtol=1e-6, atol=1e-6
    )


@given(seed=SEEDS, d=st.integers(1, 5), K=st.integers(1, 4), n=st.integers(1, 600))
def test_log_joint_against_the_reference(random_mixture, seed, d, K, n):
    rng = np.random.default_rng(seed)
    parameters = random_mixture(rng, K, d)
    X = samples_of(parameters, n, rng)
    work, out = em.Work.room_for(K, d), np.empty((-(-n // em.BLOCK) * em.BLOCK, K))
    assert compiled.precompute(parameters[0], parameters[2], work.whiteners, work.constants)
    em.log_joint(em.in_blocks(X, np.ones(n)).blocks, parameters[1], np.zeros(d), work, out)
    np.testing.assert_allclose(out[:n], reference.log_joint(X, *parameters), rtol=1e-9, atol=1e-9)


@given(seed=SEEDS, d=st.integers(1, 4), K=st.integers(1, 4))
def test_an_iteration_never_lowers_the_likelihood(random_mixture, seed, d, K):
    rng = np.random.default_rng(seed)
    X = samples_of(random_mixture(rng, K, d), 150, rng)
    samples = em.in_blocks(X, rng.random(150))
    covariances = np.tile(np.cov(X.T).reshape(d, d), (K, 1, 1))
    mixture = em.Mixture(np.full(K, 1.0 / K), X[:K].copy(), covariances)
    values = [step(samples, mixture)[0] for _ in range(20)]
    # Without a floor a component may shrink onto a few samples; what follows is NaN.
    values = np.array(values)[np.isfinite(values)]
    assert len(values) > 3
    assert np.all(np.diff(values) >= -1e-9 * np.abs(values[:-1]))


@pytest.mark.parametrize("n", [1, em.BLOCK - 1, em.BLOCK, em.BLOCK + 1, 3 * em.BLOCK])
def test_blocks_hold_each_sample_once(n):
    rng = np.random.default_rng(n)
    X, weight = rng.normal(size=(n, 3)), rng.random(n)
    samples = em.in_blocks(X, weight)
    assert samples.blocks.shape[2] == em.BLOCK
    np.testing.assert_array_equal(samples.blocks.transpose(0, 2, 1).reshape(-1, 3)[:n], X)
    np.testing.assert_array_equal(samples.weight.reshape(-1)[:n], weight)
    assert not samples.weight.reshape(-1)[n:].any()
    assert np.all(np.isfinite(samples.blocks))


@njit
def apply_exp(z, out):
    for i in range(z.shape[0]):
        out[i] = exp_nonpositive(z[i])


@njit
def apply_log(z, out):
    for i in range(z.shape[0]):
        out[i] = log_positive(z[i])


def test_exponential():
    z = np.concatenate([-np.logspace(-20, math.log10(708), 5000), [0.0, -1.0, -708.0]])
    out = np.empty_like(z)
    apply_exp(z, out)
    np.testing.assert_allclose(out, np.exp(z), rtol=1e-15)
    far = np.array([-709.0, -1e10, -np.inf])
    apply_exp(far, out[:3])
    np.testing.assert_allclose(out[:3], np.exp(-708.0), rtol=1e-15)


def test_logarithm():
    z = np.concatenate([np.logspace(-300, 300, 5000), 1.0 + np.logspace(-15, 0, 5000), [1.0, 0.5]])
    out = np.empty_like(z)
    apply_log(z, out)
    np.testing.assert_allclose(out, np.log(z), rtol=1e-15, atol=1e-15)


# Starts


@given(seed=SEEDS, d=st.integers(1, 4), K=st.integers(1, 5), n=st.integers(5, 700))
def test_seeds_against_plain_k_means_plus_plus(seed, d, K, n):
    rng = np.random.default_rng(seed)
    X, weight = starts.sort_samples(rng.normal(size=(n, d)), rng.random(n))
    samples, draws = em.in_blocks(X, weight), rng.random(K)
    labels = starts.kmeans_plus_plus(samples, n, draws)
    seeds = []
    for u in draws:
        near = np.min([((X - s) ** 2).sum(axis=1) for s in seeds] or [np.ones(n)], axis=0)
        cumulative = np.cumsum(weight * near)
        seeds.append(X[np.searchsorted(cumulative, u * cumulative[-1], side="right")])
    distance = ((X[:, None] - np.array(seeds)) ** 2).sum(axis=2)
    expected = distance.argmin(axis=1)
    np.testing.assert_array_equal(labels.reshape(-1)[:n], expected)

    spread = starts.spread_of(X, weight, np.full(X.shape[1], 1e-3))
    mixture = starts.moments_of(samples, n, labels, K, spread)
    scale = weight.sum() / n
    for k in range(K):
        w = weight * (expected == k)
        np.testing.assert_allclose(mixture.means[k], w @ X / w.sum(), rtol=1e-9, atol=1e-12)
        deviation = X - mixture.means[k]
        prior = (d + 1) * scale
        covariance = ((w * deviation.T) @ deviation + prior * spread / K) / (w.sum() + prior)
        np.testing.assert_allclose(mixture.covariances[k], covariance, rtol=1e-9, atol=1e-12)
    assert mixture.weights.sum() == pytest.approx(1.0)


def test_sorting_with_and_without_ties():
    rng = np.random.default_rng(0)
    distinct = rng.normal(size=(50, 3))
    tied = rng.integers(0, 3, size=(50, 3)).astype(float)
    for X in (distinct, tied):
        got, weight = starts.sort_samples(X, np.ones(50))
        rows, counts = np.unique(X, axis=0, return_counts=True)
        np.testing.assert_array_equal(got, rows)
        np.testing.assert_array_equal(weight, counts)


# Threads


def test_panels_shared_out_are_the_same_to_the_last_bit(random_mixture):
    rng = np.random.default_rng(0)
    parameters = random_mixture(rng, 3, 3)
    samples = em.in_blocks(samples_of(parameters, 20_000, rng), np.ones(20_000))
    assert em.panels_of(samples) == 20
    results = []
    for panels in ([(0, 20)], [(0, 7), (7, 20)], [(12, 20), (0, 12)]):
        mixture = em.Mixture(*(p.copy() for p in parameters))
        results.append((step(samples, mixture, panels=panels)[0], mixture))
    for value, mixture in results[1:]:
        assert value == results[0][0]
        for one, other in zip(mixture, results[0][1], strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("n_components", [None, 8])
def test_the_number_of_threads_changes_no_bit(random_mixture, n_components):
    rng = np.random.default_rng(1)
    X = samples_of(random_mixture(rng, 4, 3, spread=4.0), 30_000, rng)
    weight = rng.random(30_000)

    def fit(n_jobs):
        mixture = GaussianMixture(
            n_components, max_components=4, n_init=2, tol=1e-3, n_jobs=n_jobs, random_state=0
        )
        return mixture.fit(X, sample_weight=weight)

    alone = fit(1)
    for n_jobs in (2, 3):
        shared = fit(n_jobs)
        assert shared.bics_ == alone.bics_
        assert shared.n_iter_ == alone.n_iter_
        np.testing.assert_array_equal(shared.covariances_, alone.covariances_)


def test_threads_are_checked(refused):
    with refused("n_jobs must be a whole number ≥ 1, got 0"):
        GaussianMixture(n_jobs=0).fit(np.random.default_rng(0).normal(size=(20, 2)))


# Chunks


def start_of(X, K):
    d = X.shape[1]
    return {
        "n_components": K,
        "weights_init": np.full(K, 1.0 / K),
        "means_init": X[:K],
        "precisions_init": np.tile(np.linalg.inv(np.cov(X.T).reshape(d, d)), (K, 1, 1)),
    }


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize("size", [1, 100, 333, 5000])
def test_chunks_take_the_same_steps_as_the_whole(random_mixture, size):
    rng = np.random.default_rng(2)
    X = 5.0 + 3.0 * samples_of(random_mixture(rng, 3, 3), 1200 if size > 1 else 40, rng)
    settings = {"tol": 0.0, "max_iter": 20, **start_of(X, 3)}
    whole = GaussianMixture(**settings).fit(X)
    chunked = GaussianMixture(**settings).fit_chunks(RowChunks(X, size))
    assert chunked.n_iter_ == whole.n_iter_ == 20
    assert chunked.lower_bound_ == pytest.approx(whole.lower_bound_, rel=1e-10)
    assert chunked.bics_ == pytest.approx(whole.bics_, rel=1e-10)
    np.testing.assert_allclose(chunked.means_, whole.means_, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(chunked.covariances_, whole.covariances_, rtol=1e-7, atol=1e-9)


def test_a_scan_over_chunks_of_a_file_finds_what_memory_finds(random_mixture, tmp_path):
    rng = np.random.default_rng(3)
    X = samples_of(random_mixture(rng, 3, 2, spread=6.0), 6000, rng).astype(np.float32)
    whole = GaussianMixture(max_components=4, tol=1e-8, random_state=0).fit(X)
    with h5py.File(tmp_path / "samples.hdf5", "w") as file:
        rows = file.create_dataset("samples", data=X)
        chunked = GaussianMixture(max_components=4, tol=1e-8, random_state=0)
        chunked.fit_chunks(RowChunks(rows, 1000), n_subsample=1500)
    assert chunked.n_components_ == whole.n_components_ == 3
    assert set(chunked.bics_) == {1, 2, 3, 4}
    assert chunked.lower_bound_ == pytest.approx(whole.lower_bound_, abs=1e-6)
    order = [np.argsort(m.means_[:, 0]) for m in (chunked, whole)]
    np.testing.assert_allclose(chunked.means_[order[0]], whole.means_[order[1]], atol=1e-2)


def test_a_survey_counts_and_draws_uniformly():
    X = np.stack([np.arange(1000.0), 1e6 + np.random.default_rng(0).normal(size=1000)], axis=1)
    drawn = np.zeros(1000)
    for seed in range(200):
        found = survey(RowChunks(X, 77), 50, np.random.default_rng(seed))
        assert found.n_samples == 1000
        assert len(np.unique(found.subsample[:, 0])) == 50
        drawn[found.subsample[:, 0].astype(int)] += 1
    np.testing.assert_allclose(found.mean, X.mean(axis=0), rtol=1e-13)
    np.testing.assert_allclose(found.scale, X.std(axis=0), rtol=1e-9)
    # 200 draws with chance 0.05 in each: ten blocks of a hundred samples, five standard deviations.
    blocks = drawn.reshape(10, 100).sum(axis=1)
    assert np.all(np.abs(blocks - 1000) < 5 * math.sqrt(1000))


CLOUD = np.random.default_rng(0).normal(size=(30, 2))


@pytest.mark.parametrize(
    ("chunks", "message"),
    [
        (iter([CLOUD]), "chunks is an iterator"),
        ([CLOUD, CLOUD[:, :1]], r"chunk 1 has shape \(30, 1\): all chunks take \(n, 2\)"),
        ([CLOUD[:, 0]], r"chunk 0 has shape \(30,\)"),
        ([CLOUD, CLOUD * np.nan], "chunk 1 holds a number that is not finite"),
        ([CLOUD[:1]], "at least two samples, got 1"),
        ([], "at least two samples, got 0"),
        ([CLOUD * [0.0, 1.0]], "column 0 of X is constant"),
    ],
)
def test_chunks_are_checked(refused, chunks, message):
    with refused(message):
        GaussianMixture(1).fit_chunks(chunks)


class Shrinking:
    """Chunks that lose a row with each pass."""

    def __init__(self):
        self.rows = 30

    def __iter__(self):
        self.rows -= 1
        return iter([CLOUD[: self.rows]])


def test_chunks_that_change_are_refused(refused):
    with refused("held 29 samples in the first pass but 28 in a later one"):
        GaussianMixture(1).fit_chunks(Shrinking())
    with refused("size=0"):
        RowChunks(CLOUD, 0)
    with refused("n_subsample must be at least 2"):
        GaussianMixture(1).fit_chunks([CLOUD], n_subsample=1)


# Warm start


def test_refitting_from_a_mixture(random_mixture):
    rng = np.random.default_rng(4)
    parameters = random_mixture(rng, 3, 2, spread=8.0)
    before = samples_of(parameters, 2000, rng)
    after = np.concatenate([before, samples_of(parameters, 200, rng)])
    model = GaussianMixture(random_state=0).fit(before)
    cold = GaussianMixture(random_state=0).fit(after)
    warm = GaussianMixture(start=model, random_state=0).fit(after)
    assert model.n_components_ == cold.n_components_ == warm.n_components_ == 3
    assert set(warm.bics_) == {2, 3, 4}
    assert warm.bics_[3] == pytest.approx(cold.bics_[3], rel=1e-4)
    order = [np.argsort(m.means_[:, 0]) for m in (warm, cold)]
    np.testing.assert_allclose(warm.means_[order[0]], cold.means_[order[1]], atol=0.05)
    # It begins where the other ended: no iteration can raise what has converged.
    again = GaussianMixture(3, start=cold, tol=1e-4).fit(after)
    assert again.n_iter_ <= 1
    assert again.lower_bound_ == pytest.approx(cold.lower_bound_, abs=1e-4)


def test_a_mixture_to_refit_from_is_checked(refused):
    model = GaussianMixture(2, random_state=0).fit(CLOUD)
    with refused("start has 2 columns and the samples 3"):
        GaussianMixture(start=model).fit(np.random.default_rng(0).normal(size=(30, 3)))
    with refused("without weights_init"):
        GaussianMixture(start=model, **start_of(CLOUD, 2)).fit(CLOUD)
