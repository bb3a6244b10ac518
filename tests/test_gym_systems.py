import math

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from misstep import Outcome, demonstrate, learn, load_dataset, make_system, rollout, save_dataset
from misstep.systems import GymSystem, Judged
from misstep.trajectory import Column

KNOWN = [
    "InvertedPendulum-v5",
    "InvertedDoublePendulum-v5",
    "Pendulum-v1",
    "MountainCarContinuous-v0",
]


class Acting:
    """A policy from a plain function of the observation."""

    def __init__(self, act):
        self.act = act

    def reset(self):
        pass

    def __call__(self, observation):
        return np.atleast_1d(self.act(observation))


def attempt(name, act, seed=0, **parameters):
    return rollout(make_system(name, **parameters), Acting(act), seed=seed, demonstrator="test")


@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is -?infinity")
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.parametrize("env_id", KNOWN)
def test_passes_gymnasium_checks(env_id):
    system = make_system(f"gym:{env_id}")
    check_env(system, skip_render_check=True)
    check_env(system.unwrapped, skip_render_check=True)
    system.close()


@pytest.mark.parametrize("env_id", KNOWN)
def test_it_is_the_environment_step_by_step(env_id):
    system, env = make_system(f"gym:{env_id}", duration=2.0), gymnasium.make(env_id)
    rng = np.random.default_rng(0)
    for seed in range(3):
        np.testing.assert_array_equal(system.reset(seed=seed)[0], env.reset(seed=seed)[0])
        over = False
        while not over:
            action = rng.uniform(env.action_space.low, env.action_space.high)
            observation, reward, terminated, truncated, _ = system.step(action)
            expected = env.step(action.astype(np.float32))
            np.testing.assert_array_equal(observation, expected[0])
            assert observation.dtype == np.float64
            assert reward == expected[1]
            assert terminated == expected[2]
            over = terminated or truncated


@pytest.mark.parametrize("env_id", KNOWN)
def test_parameters_rebuild_it_and_a_file_keeps_them(env_id, tmp_path):
    system = make_system(f"gym:{env_id}", duration=3.0)
    assert isinstance(system, Judged)
    shown = demonstrate(system, "random", n=2, seed=1, time="")
    save_dataset(shown, tmp_path / "D.h5")
    source = load_dataset(tmp_path / "D.h5")[0].provenance
    assert source.system == f"gym:{env_id}"
    again = make_system(source.system, **source.parameters)
    assert again.parameters == system.parameters == dict(source.parameters)
    assert demonstrate(again, "random", n=2, seed=1, time="") == shown
    assert all(t.outcome is Outcome.FAILURE for t in shown)


@pytest.mark.parametrize("env_id", KNOWN)
def test_cost_and_columns_describe_every_number(env_id):
    system = make_system(f"gym:{env_id}")
    observation, _ = system.reset(seed=0)
    n = len(observation)
    assert len(system.observation_columns) == n
    assert {len(system.cost.goal), len(system.cost.weights), len(system.cost.limits)} == {n}
    angles = np.array([column.unit == "rad" for column in system.observation_columns])
    goal = np.array([system.cost.goal])
    assert system.cost(goal, angles)[0] < system.cost(goal + 0.1, angles)[0]
    assert system.cost(goal, angles)[0] == 0.0


def test_columns_of_the_poles_are_what_their_names_say():
    for name in ("InvertedPendulum-v5", "InvertedDoublePendulum-v5"):
        system = make_system(f"gym:{name}")
        observation, _ = system.reset(seed=3)
        seen = dict(zip([c.name for c in system.observation_columns], observation, strict=True))
        data = system.unwrapped._env.unwrapped.data
        assert seen["x"] == data.qpos[0]
        assert seen["x_dot"] == data.qvel[0]
        if name == "InvertedPendulum-v5":
            assert (seen["theta"], seen["theta_dot"]) == (data.qpos[1], data.qvel[1])
        else:
            for k in (1, 2):
                assert seen[f"sin_theta_{k}"] == math.sin(data.qpos[k])
                assert seen[f"cos_theta_{k}"] == math.cos(data.qpos[k])
                assert seen[f"theta_{k}_dot"] == data.qvel[k]


def balance(observation):
    return observation @ (0.05, 4.0, 0.5, 1.0)


def test_inverted_pendulum_must_last_to_the_end():
    kept = attempt("gym:InvertedPendulum-v5", balance)
    assert kept.outcome is Outcome.SUCCESS
    assert kept.duration == pytest.approx(40.0)
    lost = attempt("gym:InvertedPendulum-v5", lambda o: 0.0, duration=20.0)
    assert lost.outcome is Outcome.FAILURE
    assert lost.failure_step == lost.n_steps < 500
    theta = np.abs(lost.column("theta"))
    assert (theta[:-1] <= 0.2).all()
    assert theta[-1] > 0.2


def test_double_pendulum_fails_when_its_tip_comes_down():
    for seed in range(5):
        system = make_system("gym:InvertedDoublePendulum-v5")
        system.reset(seed=seed)
        failed = False
        while not failed:
            _, _, terminated, _, info = system.step(np.zeros(1))
            failed = info["failed"]
            tip = system.unwrapped._env.unwrapped.data.site_xpos[0][2]
            assert failed == (tip <= 1.0) == terminated
        assert not info["timed_out"]


def swing_up(observation):
    """Pump energy, and hold near upright."""
    cos, sin, rate = observation
    energy = rate**2 / 6 + 5.0 * (cos - 1.0)
    if cos > 0.9:
        return -15.0 * sin - 4.0 * rate
    return -2.0 * np.sign(rate * energy) if rate else 2.0


def test_pendulum_must_be_upright_in_the_end():
    outcomes = []
    for seed in range(4):
        trajectory = attempt("gym:Pendulum-v1", swing_up, seed=seed)
        held = trajectory.column("cos_theta")[-61:] > math.cos(math.radians(12.0))
        assert (trajectory.outcome is Outcome.SUCCESS) == held.all()
        assert trajectory.duration == pytest.approx(10.0)
        outcomes.append(trajectory.outcome)
    assert Outcome.SUCCESS in outcomes
    hanging = attempt("gym:Pendulum-v1", lambda o: -2.0 * o[2])
    assert hanging.outcome is Outcome.FAILURE
    assert hanging.failure_step == 200


def test_mountain_car_must_reach_the_flag():
    there = attempt("gym:MountainCarContinuous-v0", lambda o: np.sign(o[1]))
    assert there.outcome is Outcome.SUCCESS
    assert there.column("position")[-1] >= 0.45 > there.column("position")[-2]
    assert there.failure_step is None
    stuck = attempt("gym:MountainCarContinuous-v0", lambda o: 1.0)
    assert stuck.outcome is Outcome.FAILURE
    assert stuck.n_steps == 999


def test_the_user_can_judge_differently():
    name = "gym:InvertedPendulum-v5"
    strict = attempt(name, balance, failure="abs(theta) > 0.1deg")
    assert strict.n_steps < 1000
    assert abs(strict.column("theta")[-1]) > math.radians(0.1)
    # The user's success stands alone: the default failure is gone, the environment's end is not.
    fallen = attempt(name, lambda o: 0.0, success="abs(theta) > 0.2")
    assert fallen.outcome is Outcome.SUCCESS
    assert "failure" not in fallen.provenance.parameters
    longer = make_system("gym:Pendulum-v1", hold=5.0, cost="1 - cos_theta")
    assert longer.parameters["hold"] == 5.0
    assert longer.parameters["success"] == "cos_theta > cos(12deg)"


def test_an_unknown_environment_needs_a_judge(refused):
    with refused(r"gym:Swimmer-v5 does not say .*: give success or failure, .* o0, o1, o2, "):
        make_system("gym:Swimmer-v5")
    system = make_system("gym:Swimmer-v5", success="o0 > 1", duration=1.0, reset_noise_scale=0.2)
    assert system.observation_columns == tuple(Column(f"o{i}", "") for i in range(8))
    assert system.action_columns == (Column("a0", ""), Column("a1", ""))
    assert system.cost is None
    assert system.parameters["reset_noise_scale"] == 0.2
    shown = demonstrate(system, "random", n=2, seed=0)
    assert len(shown) == 2
    assert shown[0].duration == pytest.approx(1.0)


def test_parameters_of_an_environment_change_it_and_its_columns():
    heavy = attempt("gym:Pendulum-v1", lambda o: 0.0, g=20.0)
    light = attempt("gym:Pendulum-v1", lambda o: 0.0, g=1.0)
    assert np.abs(heavy.column("theta_dot")).max() > np.abs(light.column("theta_dot")).max()
    assert heavy.provenance.parameters["g"] == 20.0


def test_control_period_and_duration():
    assert make_system("gym:MountainCarContinuous-v0").dt == 1 / 30  # from render_fps alone
    assert make_system("gym:Pendulum-v1").dt == 0.05
    told = make_system("gym:Pendulum-v1", dt=0.1, duration=1.0)
    assert told.dt == 0.1
    assert rollout(told, Acting(swing_up), seed=0, demonstrator="test").n_steps == 10


def test_learns_and_resumes(tmp_path):
    system = make_system("gym:InvertedPendulum-v5", duration=1.0)
    shown = demonstrate(system, "random", n=3, seed=0)
    run = learn(system, shown, "mean", max_trials=2, seed=0, out=tmp_path / "run")
    assert run.config.make_system().parameters == system.parameters
    assert all(t.provenance.system == "gym:InvertedPendulum-v5" for t in run.trials)


def test_by_itself_it_judges_nothing():
    system = GymSystem("InvertedPendulum-v5", duration=20.0)
    fallen = rollout(system, Acting(lambda o: 0.0), seed=0, demonstrator="test")
    assert fallen.outcome is Outcome.UNKNOWN
    assert rollout(system, Acting(balance), seed=0, demonstrator="test").outcome is Outcome.SUCCESS


@pytest.mark.parametrize(
    ("name", "parameters", "line"),
    [
        ("gym:Nope-v0", {}, "gym:Nope-v0 cannot be made: .*Nope"),
        ("gym:Pendulum-v9", {}, "gym:Pendulum-v9 cannot be made: .*`v1`"),
        ("gym:", {}, "'' is no id of a Gymnasium environment; one is, for example, Pendulum-v1"),
        ("gym:os:Robot-v0", {}, "'os:Robot-v0' is no id"),
        ("gym:CartPole-v1", {}, r"gym:CartPole-v1 has actions in Discrete\(2\), but a Box"),
        ("gym:FrozenLake-v1", {}, r"gym:FrozenLake-v1 has observations in Discrete\(16\), but"),
        ("gym:Pendulum-v1", {"mass": 2.0}, "gym:Pendulum-v1 cannot be made: .*'mass'"),
        ("gym:InvertedPendulum-v5", {"frame_skip": 0}, "cannot be made: .*division by zero"),
        ("gym:Pendulum-v1", {"duration": -1}, "gym: duration is -1 s but must be at least 0 s"),
        ("gym:Pendulum-v1", {"duration": 0.01}, "shorter than one control period of 0.05 s"),
        ("gym:Pendulum-v1", {"success": "theta > 1"}, "no column 'theta'; there are: cos_theta"),
    ],
)
def test_wrong_environments_are_told_in_one_line(refused, name, parameters, line):
    with refused(line):
        make_system(name, **parameters)


def test_wrong_actions_and_steps_are_told(refused):
    system = make_system("gym:Pendulum-v1", duration=0.05).unwrapped
    with refused(r"gym:Pendulum-v1: no episode is running; call reset\(\) before step"):
        system.step(np.zeros(1))
    system.reset(seed=0)
    with refused(r"the action is \[0. 0.\], but finite numbers of shape \(1,\)"):
        system.step(np.zeros(2))
    with refused(r"the action is \[nan\]"):
        system.step(np.array([np.nan]))


def test_random_needs_limits(refused):
    class Boundless(GymSystem):
        def __init__(self):
            super().__init__("Pendulum-v1")
            self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))

    with refused("random does not fit gym:Pendulum-v1: its actions must have limits"):
        demonstrate(Boundless(), "random")


@pytest.mark.parametrize("parameters", [{}, {"success": "o9 > 1"}, {"duration": 1e-3}])
def test_what_is_refused_after_it_was_made_is_closed(refused, parameters):
    closed = []

    class Unknown(gymnasium.envs.classic_control.PendulumEnv):
        def close(self):
            closed.append(self)

    gymnasium.register("Unknown-v0", Unknown)
    try:
        with refused("does not say what it is|no column 'o9'|shorter than one control period"):
            make_system("gym:Unknown-v0", **parameters)
    finally:
        del gymnasium.registry["Unknown-v0"]
    assert len(closed) == 1
