"""What others ask of an estimator, an environment and a data set, in their own words.

scikit-learn's tests of its mixture run against ours; Gymnasium's checks, vectors and wrappers on
every system of the registry; and the arrays that imitation and d3rlpy are given, through Minari and
through robomimic's layout. (Both need torch, which has no place here.)
"""

import inspect
import json
from contextlib import closing
from functools import partial
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
import sklearn.mixture.tests.test_gaussian_mixture as theirs
from gymnasium import wrappers
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from misstep import demonstrate, make_system, save_dataset
from misstep.errors import MisstepError
from misstep.mixture import GaussianMixture as Ours
from misstep.robot.addresses import TOKEN
from misstep.robot.gazebo.build import PACKAGES, build
from misstep.robot.socket_server import SocketServer
from misstep.robot.system_server import SystemHub
from misstep.systems import SYSTEMS

# Gymnasium prefers normalised actions and bounded observations; here both are physical quantities,
# and `RescaleAction` makes actions what it prefers.
physical = pytest.mark.filterwarnings(
    "ignore:.*we recommend using a symmetric and normalized space",
    "ignore:.*A Box observation space (min|max)imum value is -?infinity",
)


# scikit-learn


class GaussianMixture(Ours):
    """Our mixture with scikit-learn's defaults; nothing else is changed."""

    def __init__(
        self,
        n_components=1,
        *,
        covariance_type="full",
        tol=1e-3,
        reg_covar=1e-6,
        max_iter=100,
        n_init=1,
        init_params="kmeans",
        weights_init=None,
        means_init=None,
        precisions_init=None,
        random_state=None,
        warm_start=False,
        verbose=0,
        verbose_interval=10,
    ):
        given = {name: value for name, value in locals().items() if not name.startswith("_")}
        del given["self"]
        super().__init__(**given)


STARTS = ["random", "random_from_data", "k-means++", "kmeans"]
FIT_PREDICT = [(0, 2, 1e-7), (1, 2, 1e-1), (3, 300, 1e-7), (4, 300, 1e-1)]
SEEDS = range(3)
PASSED = {
    "convergence_detected_with_warm_start": [()],
    "fitted_precision_covariance_concistency": [("full", np.float64)],
    "gaussian_mixture_aic_bic": [()],
    "gaussian_mixture_attributes": [()],
    "gaussian_mixture_fit": [(np.float64,)],
    "gaussian_mixture_fit_best_params": [()],
    "gaussian_mixture_fit_predict": [(*case, np.float64) for case in FIT_PREDICT],
    "gaussian_mixture_fit_predict_n_init": [()],
    "gaussian_mixture_n_parameters": [()],
    "gaussian_mixture_predict_predict_proba": [()],
    "gaussian_mixture_single_component_stable": [()],
    "init": [()],
    "init_means_not_duplicated": [(start, seed) for start in STARTS for seed in SEEDS],
    "max_iter_zero": [()],
    "means_for_all_inits": [(start, seed, np.float64) for start in STARTS for seed in SEEDS],
    "monotonic_likelihood": [()],
    "multiple_init": [()],
    "score": [(np.float64,)],
    "score_samples": [()],
    "warm_start": [(seed,) for seed in SEEDS],
}
"""Names, and the cases of each that are about full covariances and float64."""
OTHERS = {
    "the wording of a message": """
        check_weights check_means check_precisions gaussian_mixture_fit_convergence_warning sample
        regularisation""",
    "other kinds of covariance": """
        bic_1d_1component gaussian_mixture_setting_best_params
        gaussian_mixture_precisions_init_diag""",
    "progress in print, which the compiled loops have not": "gaussian_mixture_verbose",
    "arrays of other libraries": """
        gaussian_mixture_array_api_compliance
        gaussian_mixture_raises_where_array_api_not_implemented""",
    "its private methods": """
        gaussian_mixture_precisions_init
        gaussian_mixture_all_init_does_not_estimate_gaussian_parameters""",
    "its private functions, whatever class is in its place": """
        suffstat_sk_full suffstat_sk_tied suffstat_sk_diag gaussian_suffstat_sk_spherical
        compute_log_det_cholesky gaussian_mixture_log_probabilities
        gaussian_mixture_estimate_log_prob_resp""",
}


def test_the_documentation_counts_them():
    own = " ".join(OTHERS["its private functions, whatever class is in its place"].split()).split()
    others = len(" ".join(OTHERS.values()).split()) - len(own)
    page = (Path(__file__).parents[1] / "docs" / "api" / "mixture.md").read_text()
    assert f"{len(PASSED)} of the {len(PASSED) + others} tests" in page


def test_every_test_of_scikit_learn_is_accounted_for():
    tests = {
        name.removeprefix("test_")
        for name, value in inspect.getmembers(theirs, inspect.isfunction)
        if name.startswith("test_") and value.__module__ == theirs.__name__
    }
    others = " ".join(OTHERS.values()).split()
    assert sorted([*PASSED, *others]) == sorted(tests)


@pytest.mark.filterwarnings("ignore:expectation–maximisation did not converge")
@pytest.mark.parametrize(
    ("name", "arguments"), [(name, case) for name, cases in PASSED.items() for case in cases]
)
def test_scikit_learn_s_own(name, arguments, monkeypatch):
    monkeypatch.setattr(theirs, "GaussianMixture", GaussianMixture)
    monkeypatch.setattr(theirs, "COVARIANCE_TYPE", ["full"])
    parameters = list(inspect.signature(getattr(theirs, f"test_{name}")).parameters)
    getattr(theirs, f"test_{name}")(**dict(zip(parameters, arguments, strict=True)))


# Gymnasium


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """Serve a cart-pole, as a robot does, and return its address."""
    secret = "of this test"  # noqa: S105
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(TOKEN, secret)
        hub = SystemHub(make_system("cartpole"), secret, watchdog=60.0)
        server = SocketServer(hub, f"unix:{tmp_path_factory.mktemp('robot')}/s")
        yield server.address
        server.close()
        hub.close()


@pytest.fixture(params=sorted(SYSTEMS))
def make(request):
    """Return a function, of no arguments and picklable, that makes a system of the registry."""
    name = request.param
    if name == "cartpole-gazebo":
        try:
            build()
        except MisstepError as error:
            pytest.skip(f"{error} (make gazebo; Debian packages: {PACKAGES})")
    if name == "remote":
        return partial(make_system, name, address=request.getfixturevalue("robot"))
    return partial(make_system, name)


def attempt(env, actions, seed=0):
    """Return the observations, rewards and last `info` of one episode, which closes the system."""
    observation, info = env.reset(seed=seed)
    observations, rewards = [observation], []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            break
    env.close()
    return np.array(observations), np.array(rewards), info


def drawn_actions(space, n, seed=0):
    """Draw actions (n, m) of the whole space."""
    return np.random.default_rng(seed).uniform(space.low, space.high, (n, *space.shape))


def symmetric(env):
    """Return a space that holds all observations and their negatives."""
    most = np.maximum(-env.observation_space.low, env.observation_space.high)
    return Box(-most, most, dtype=np.float64)


@physical
def test_gymnasium_s_check(make):
    with closing(make()) as env:
        check_env(env, skip_render_check=True)


@physical
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: wrappers.TimeLimit(env, 7),
        wrappers.RecordEpisodeStatistics,
        lambda env: wrappers.RescaleAction(env, -1.0, 1.0),
        lambda env: wrappers.TransformObservation(env, np.negative, symmetric(env)),
    ],
    ids=["TimeLimit", "RecordEpisodeStatistics", "RescaleAction", "TransformObservation"],
)
def test_gymnasium_s_check_of_a_wrapped_system(make, wrap):
    with closing(wrap(make())) as env:
        check_env(env, skip_render_check=True)


def test_wrappers_change_what_they_say(make):
    plain = make()
    low, high = plain.action_space.low, plain.action_space.high
    actions = drawn_actions(plain.action_space, 20)
    observations, rewards, _ = attempt(plain, actions)

    limited = wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(make(), 7))
    short, _, info = attempt(limited, actions)
    np.testing.assert_array_equal(short, observations[:8])
    assert info["episode"]["l"] == min(7, len(rewards))
    assert info["episode"]["r"] == pytest.approx(rewards[:7].sum(), rel=1e-5)

    centred = 2.0 * (actions - low) / (high - low) - 1.0
    rescaled, _, _ = attempt(wrappers.RescaleAction(make(), -1.0, 1.0), centred)
    np.testing.assert_allclose(rescaled, observations, rtol=1e-6, atol=1e-9)

    far = np.tile(high + 1.0, (5, 1))
    clipped, _, _ = attempt(wrappers.ClipAction(make()), far)
    np.testing.assert_array_equal(clipped, attempt(make(), np.tile(high, (5, 1)))[0])

    normalising = wrappers.NormalizeObservation(make())
    normalised, _, _ = attempt(normalising, actions)
    assert np.all(np.isfinite(normalised))
    np.testing.assert_allclose(
        normalising.obs_rms.mean, observations.mean(axis=0), rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("vector", [SyncVectorEnv, partial(AsyncVectorEnv, context="forkserver")])
def test_vectors_do_what_each_system_does(make, vector):
    # There is one robot.
    n = 1 if make.args == ("remote",) else 2
    envs = vector([make] * n)
    actions = drawn_actions(envs.single_action_space, 5)
    first, _ = envs.reset(seed=[3, 4][:n])
    seen, alive = [first], []
    for action in actions:
        observations, _, terminated, truncated, _ = envs.step(np.tile(action, (n, 1)))
        seen.append(observations)
        alive.append(~(terminated | truncated))
    envs.close()
    for i, seed in enumerate([3, 4][:n]):
        alone, _, _ = attempt(make(), actions, seed=seed)
        np.testing.assert_array_equal(np.array(seen)[: len(alone), i], alone)
        assert np.all(np.array(alive)[: len(alone) - 2, i])


# imitation and d3rlpy


@pytest.fixture(scope="module")
def failures():
    return demonstrate(make_system("cartpole", duration=3.0), "weak", n=3, seed=0)


@pytest.fixture(scope="module")
def through_minari(failures, tmp_path_factory):
    folder = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        save_dataset(failures, "minari:cartpole/failed-v0")
        yield list(minari.load_dataset("cartpole/failed-v0"))


def test_what_imitation_takes(failures, through_minari):
    # imitation.data.types.TrajectoryWithRew: obs (T + 1, n), acts (T, m), rews (T,) floats,
    # infos (T,) or None, terminal bool.
    for ours, episode in zip(failures, through_minari, strict=True):
        T = len(episode)
        infos = np.array([{k: v[t + 1] for k, v in episode.infos.items()} for t in range(T)])
        assert episode.observations.shape == (T + 1, 4)
        assert episode.actions.shape == (T, 1)
        assert episode.rewards.shape == infos.shape == (T,)
        assert np.issubdtype(episode.rewards.dtype, np.floating)
        assert episode.terminations[-1] or episode.truncations[-1]
        np.testing.assert_array_equal(episode.observations, ours.observations)
        np.testing.assert_array_equal(episode.actions, ours.actions)
        np.testing.assert_array_equal(episode.rewards, -ours.costs)
        assert [info["failure"] for info in infos].index(True) == ours.failure_step - 1


def test_what_d3rlpy_takes(failures, through_minari):
    # d3rlpy.dataset.MDPDataset: one row a transition, an episode ending where either flag is set.
    episodes = through_minari
    arrays = {
        "observations": np.concatenate([e.observations[:-1] for e in episodes]),
        "actions": np.concatenate([e.actions for e in episodes]),
        "rewards": np.concatenate([e.rewards for e in episodes]),
        "terminals": np.concatenate([e.terminations for e in episodes]),
        "timeouts": np.concatenate([e.truncations for e in episodes]),
    }
    n = sum(t.n_steps for t in failures)
    assert {len(a) for a in arrays.values()} == {n}
    ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"])
    np.testing.assert_array_equal(ends, np.cumsum([t.n_steps for t in failures]) - 1)
    assert not np.any(arrays["terminals"] & arrays["timeouts"])
    begins = np.append(0, ends[:-1] + 1)
    np.testing.assert_array_equal(
        arrays["observations"][begins], [t.observations[0] for t in failures]
    )


def test_what_robomimic_takes(failures, tmp_path):
    # robomimic.utils.dataset.SequenceDataset: of each demo in a mask, one row a transition.
    save_dataset(failures, tmp_path / "d.hdf5", format="robomimic")
    with h5py.File(tmp_path / "d.hdf5") as file:
        names = [name.decode() for name in file["mask/failure"]]
        assert sorted(file["data"]) == sorted(names)
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "cartpole"
        for i, ours in enumerate(failures):
            demo = file[f"data/demo_{i}"]
            for group, rows in (("obs", slice(None, -1)), ("next_obs", slice(1, None))):
                columns = np.stack(
                    [np.ravel(demo[group][k.name]) for k in ours.observation_columns]
                )
                np.testing.assert_array_equal(columns.T, ours.observations[rows])
            np.testing.assert_array_equal(demo["actions"], ours.actions)
            np.testing.assert_array_equal(demo["rewards"], -ours.costs)
            np.testing.assert_array_equal(
                demo["dones"], np.arange(ours.n_steps) == ours.n_steps - 1
            )
            assert demo.attrs["num_samples"] == ours.n_steps
