import numpy as np
import pytest

from misstep import Column, Dataset, Outcome, Provenance, Trajectory, demonstrate, make_system
from misstep.blame import FaultKind, action_limits, find_blame
from misstep.blame.agreement import find_agreement
from misstep.blame.blame import GROWTH, PLANS
from misstep.blame.boundary import Boundary, leapt
from misstep.blame.growth import growth_dangers
from misstep.blame.recovery import Recovery, regulator

# x' = GROWN x + PUSH u with |u| <= 1: recoverable exactly where |x| < PUSH / (GROWN - 1) = 1, and
# the least |u| with which it is, is |x|.
GROWN, PUSH = 1.1, 0.1
FALLEN = 5.0
NOWHERE = Provenance("", {}, "", None, "")


def growing(actions, start, *, dt=0.05, outcome=Outcome.FAILURE, policy=None):
    """Record the unstable line until it has fallen, under actions in turn or under a policy."""
    x, done = [start], []
    for t in range(200):
        done.append(float(policy(x[-1])) if policy else actions[t % len(actions)])
        x.append(GROWN * x[-1] + PUSH * done[-1])
        if abs(x[-1]) > FALLEN:
            break
    failed = abs(x[-1]) > FALLEN
    return Trajectory(
        np.array(x)[:, None],
        np.array(done)[:, None],
        dt,
        (Column("x", "m"),),
        (Column("force", "N"),),
        NOWHERE,
        outcome if failed else Outcome.SUCCESS,
        failure_step=len(done) if failed else None,
    )


@pytest.fixture(scope="module")
def line():
    rng = np.random.default_rng(0)
    return Dataset(
        growing(rng.uniform(-1, 1, 60), start) for start in (0.3, -0.2, 0.5, -0.4, 0.05, -0.1)
    )


@pytest.fixture(scope="module")
def line_recovery(line):
    return Recovery.learn(line, action_limits(line), np.random.default_rng(0))


def test_danger_is_the_least_strength_that_recovers_an_unstable_line(line, line_recovery):
    strongest = max(np.abs(t.actions).max() for t in line)
    x = np.linspace(-2, 2, 81)[:, None]
    expected = np.minimum(np.abs(x[:, 0]) / strongest, 1.0)
    assert np.abs(line_recovery.danger(x) - expected).max() < 0.06
    assert np.array_equal(
        line_recovery.danger(x)[np.abs(expected - 1) > 0.06] < 1,
        expected[np.abs(expected - 1) > 0.06] < 1,
    )


def test_the_rescue_pushes_back(line_recovery):
    x = np.array([[0.6], [-0.6]])
    action = line_recovery.rescue(x, line_recovery.danger(x))
    assert action[0, 0] < -0.3
    assert action[1, 0] > 0.3


def test_more_states_than_are_asked_about_one_by_one(line_recovery):
    x = np.linspace(0, 2, 1001)[:, None]
    danger = line_recovery.danger(x)
    last = np.flatnonzero(danger < 1)[-1]
    assert line_recovery.danger(x[[last]])[0] < 1
    assert line_recovery.danger(x[[last + 1]])[0] == 1
    assert np.all(danger[last + 1 :] == 1)


@pytest.mark.parametrize(
    ("policy", "kind"),
    [
        (lambda x: 0.8 * np.sign(x), FaultKind.WRONG_WAY),
        (lambda x: -0.3 * np.clip(x, -1, 1), FaultKind.TOO_WEAK),
        (lambda x: -1.0 * (abs(x) > 0.97), FaultKind.TOO_WEAK),
    ],
)
def test_the_fault_is_named(line, policy, kind):
    attempt = growing(None, 0.3, policy=policy)
    blame = find_blame(Dataset([*line, attempt]))[-1]
    assert blame.fault is not None
    assert blame.fault.kind is kind
    assert 0 <= blame.fault.time <= blame.point_of_no_return
    assert f"from {blame.fault.time:.2f} s the force" in blame.sentence
    strongest = max(np.abs(t.actions).max() for t in [*line, attempt])
    recoverable = np.flatnonzero(np.abs(attempt.observations[:, 0]) < strongest)
    assert blame.point_of_no_return == pytest.approx(recoverable[-1] * attempt.dt, abs=attempt.dt)


def survives(system, state):
    """Whether full force either way, landing softly at last, keeps the true pole up."""
    for lead in (0.2, 0.27, 0.35):
        system.set_state(*state)
        s = np.array(state)
        for _ in range(150):
            s, *_, info = system.step(np.array([5000.0 * (s[2] + lead * s[3])]))
            if info["failed"]:
                break
        else:
            return True
    return False


@pytest.mark.parametrize(
    ("kind", "limit"), [("weak", 20.0), ("reversed", 10.0), ("bang-bang", 5.0)]
)
def test_the_point_of_no_return_is_that_of_the_true_system(kind, limit):
    system = make_system("cartpole", force_limit=limit)
    shown = demonstrate(system, kind, 4, 3)
    for attempt, blame in zip(shown, find_blame(shown), strict=True):
        steps = range(attempt.failure_step - 1, -1, -1)
        true = next(t for t in steps if survives(system, attempt.observations[t]))
        assert abs(blame.point_of_no_return - true * attempt.dt) < 2.5 * attempt.dt
        assert blame.point_of_no_return < attempt.failure_time


@pytest.fixture(scope="module")
def noisy():
    shown = demonstrate(make_system("cartpole"), "noisy", 4, 0)
    return shown, find_blame(shown)


def test_blame_is_a_share_that_is_whole_past_the_point_of_no_return(noisy):
    for attempt, blame in zip(*noisy, strict=True):
        assert blame.method == PLANS
        for curve in (blame.blame, blame.departure, blame.disagreement, blame.danger):
            assert np.all((curve >= 0) & (curve <= 1))
        assert len(blame.blame) == attempt.n_steps
        assert len(blame.danger) == attempt.n_steps + 1
        assert np.all(blame.blame >= blame.danger[:-1])
        lost = round(blame.point_of_no_return / attempt.dt)
        assert np.all(blame.danger[lost + 1 :] == 1)
        assert np.all(blame.blame[lost + 1 :] == 1)
        assert blame.danger[lost] < 1
        assert f"recoverable until {blame.point_of_no_return:.2f} s" in blame.sentence


def test_same_seed_same_blame(noisy):
    shown, blames = noisy
    again = find_blame(shown)
    assert [b.sentence for b in again] == [b.sentence for b in blames]
    assert all(np.array_equal(a.blame, b.blame) for a, b in zip(again, blames, strict=True))


def test_what_is_recorded_after_a_failure_changes_nothing_before_it():
    going_on = make_system("cartpole", stop_at_fall=False, duration=3.0)
    shown = demonstrate(going_on, "weak", 4, 0)
    stopped = Dataset(t.cut(t.failure_step) for t in shown)
    for long, short in zip(find_blame(shown), find_blame(stopped), strict=True):
        assert long.point_of_no_return == pytest.approx(short.point_of_no_return, abs=0.05)


def test_the_boundary_is_the_fall_and_the_end_of_the_track():
    shown = [
        *demonstrate(make_system("cartpole"), "noisy", 4, 0),
        *demonstrate(make_system("cartpole", track_limit=0.5), "random", 8, 0),
    ]
    positions = np.array([True, False, True, False])
    boundary = Boundary.find(shown, positions)
    assert all(boundary.told)
    assert np.degrees(boundary.high[2]) == pytest.approx(30, abs=1.5)
    assert np.degrees(boundary.low[2]) == pytest.approx(-30, abs=1.5)
    inside = [boundary.inside(t.observations[: t.failure_step]) for t in shown]
    assert np.concatenate(inside).mean() > 0.99
    ends = np.array([t.observations[t.failure_step] for t in shown])
    assert not boundary.inside(ends).any()


def late(shown, seconds):
    """Return the attempts with failure times that a person marked late."""
    return Dataset(
        Trajectory(
            t.observations,
            t.actions,
            t.dt,
            t.observation_columns,
            t.action_columns,
            t.provenance,
            t.outcome,
            None,
            min(t.n_steps, t.failure_step + round(seconds / t.dt)),
        )
        for t in shown
    )


def test_failures_marked_late_are_told_by_how_they_grew():
    shown = demonstrate(make_system("cartpole", stop_at_fall=False, duration=4.0), "weak", 4, 0)
    marked = [late([t], seconds)[0] for t, seconds in zip(shown, (0.1, 0.5, 0.2, 0.6), strict=True)]
    positions = np.array([True, False, True, False])
    assert not all(Boundary.find(marked, positions).told)
    blames = find_blame(Dataset(marked))
    assert GROWTH in {b.method for b in blames}
    for blame, attempt in zip(blames, marked, strict=True):
        assert 0 < blame.point_of_no_return < attempt.failure_time


def test_growth_rises_to_one():
    shown = list(demonstrate(make_system("cartpole"), "weak", 4, 0))
    for danger, attempt in zip(growth_dangers(shown), shown, strict=True):
        assert danger is not None
        assert len(danger) == attempt.failure_step + 1
        assert danger[0] < 0.5
        assert danger[-1] == 1


@pytest.mark.parametrize("path", [[0, 0, 0, 0], [0, 1, 2, 0]])
def test_what_ends_where_it_began_has_not_grown(path):
    states, actions = np.array(path, float)[:, None], np.array([[1.0], [-1.0], [0.5]])
    columns = (Column("x", "m"),), (Column("u", "N"),)
    source = Provenance("", {}, "", None, "")
    stuck = Trajectory(states, actions, 0.1, *columns, source, Outcome.FAILURE, None, 3)
    assert growth_dangers([stuck, stuck]) == [None, None]
    (blame,) = find_blame(Dataset([stuck]))
    assert blame.danger is None
    assert "cannot be told" in blame.sentence


def test_who_acts_alone_departs_and_who_acts_alike_does_not():
    rng = np.random.default_rng(0)

    def attempt(wrong):
        x = rng.uniform(-1, 1, 101)
        actions = -x[:-1] + 0.05 * rng.standard_normal(100)
        actions[wrong] += 1.0
        columns = (Column("x", ""),), (Column("u", ""),)
        return Trajectory(x[:, None], actions[:, None], 0.1, *columns, NOWHERE)

    attempts = [*(attempt(slice(0, 0)) for _ in range(4)), attempt(slice(40, 60))]
    worth = [np.ones(100)] * 5
    found = find_agreement(attempts, worth, np.random.default_rng(0))
    assert np.all(found[4].departure[40:60] > 0.9)
    assert found[4].departure[:40].mean() < 0.2
    assert all(f.departure.mean() < 0.2 for f in found[:4])


def test_demonstrators_disagree_where_they_do():
    rng = np.random.default_rng(0)

    def attempt(sign):
        x = rng.uniform(-1, 1, 301)
        actions = np.where(x[:-1] > 0, sign, 0.0) + 0.02 * rng.standard_normal(300)
        columns = (Column("x", ""),), (Column("u", ""),)
        return Trajectory(x[:, None], actions[:, None], 0.1, *columns, NOWHERE)

    attempts = [attempt(sign) for sign in (1, 1, -1, -1)]
    found = find_agreement(attempts, [np.ones(300)] * 4, np.random.default_rng(0))
    x = attempts[0].observations[:-1, 0]
    assert found[0].disagreement[x > 0.3].min() > 0.6
    assert found[0].disagreement[x < -0.3].max() < 0.2


def test_without_failure_times_it_says_what_to_do(line):
    untimed = Dataset(
        Trajectory(
            t.observations,
            t.actions,
            t.dt,
            t.observation_columns,
            t.action_columns,
            NOWHERE,
            Outcome.FAILURE,
        )
        for t in line
    )
    for blame in find_blame(untimed):
        assert blame.point_of_no_return is None
        assert blame.danger is None
        assert "misstep mark" in blame.sentence


def test_a_success_among_failures_has_no_point_of_no_return(line):
    good = growing(None, 0.5, policy=lambda x: np.clip(-3 * x, -1, 1))
    blame = find_blame(Dataset([*line, good]))[-1]
    assert good.outcome is Outcome.SUCCESS
    assert blame.point_of_no_return is None
    assert blame.sentence.startswith("succeeded")
    assert blame.danger.max() < 1


def test_time_outs_are_not_told(line):
    def over(start):
        rng = np.random.default_rng(int(1000 * start))
        actions = rng.uniform(-1, 1, 100)
        x = np.cumsum(np.append(start, 0.01 * actions))
        return Trajectory(
            x[:, None],
            actions[:, None],
            0.05,
            (Column("x", "m"),),
            (Column("force", "N"),),
            NOWHERE,
            Outcome.FAILURE,
            failure_step=100,
        )

    # Those on the line fall at 5 m; these end where the others had been well.
    blames = find_blame(Dataset([*line, over(0.1), over(0.2)]))
    assert all(b.point_of_no_return is not None for b in blames[:-2])
    assert all(b.point_of_no_return is None for b in blames[-2:])
    assert "ended in time" in blames[-1].sentence


def test_failures_that_come_in_one_leap_are_not_told():
    # What a strike leads to is seen at once: the block stands or has fallen back.
    shown = demonstrate(make_system("flipup"), "bracket", 4, 0)
    assert all(leapt(shown))
    for blame in find_blame(shown):
        assert blame.point_of_no_return is None
        assert "one leap" in blame.sentence


def test_an_angle_that_wraps_round_does_not_leap():
    t = demonstrate(make_system("cartpole", stop_at_fall=False, duration=2.0), "weak", 1, 0)[0]
    theta = t.column("theta")
    wrapped = int(np.flatnonzero(np.abs(np.diff(theta)) > 5)[0]) + 1
    assert leapt(late([t], (wrapped - t.failure_step) * t.dt)) == [False]


def test_a_failure_at_the_start_was_lost_from_there(line):
    t = line[0]
    lost = Trajectory(
        t.observations,
        t.actions,
        t.dt,
        t.observation_columns,
        t.action_columns,
        NOWHERE,
        Outcome.FAILURE,
        failure_step=0,
    )
    blame = find_blame(Dataset([*line, lost]))[-1]
    assert blame.point_of_no_return == 0
    assert np.all(blame.blame == 1)
    assert "from its start" in blame.sentence


def test_limits_are_those_of_the_system_where_it_is_known(line, demonstrations):
    known, seen = action_limits(demonstrations), action_limits(line)
    assert known.known
    assert (known.low[0], known.high[0]) == (-20, 20)
    assert not seen.known
    assert seen.high[0] == -seen.low[0] == max(np.abs(t.actions).max() for t in line)
    assert "not named" in seen.source
    assert seen.scaled(seen.high)[0] == 1
    assert seen.scaled(seen.low)[0] == -1
    assert seen.scaled(seen.neutral)[0] == 0


def test_an_action_that_never_varies_is_refused(refused):
    idle = growing([0.0], 0.3)
    with refused("the action force is 0 N in all attempts"):
        find_blame(Dataset([idle]))


def test_the_regulator_is_that_of_repeated_riccati_steps():
    rng = np.random.default_rng(0)
    a, b = np.eye(3) + 0.2 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
    q, value = np.diag([0.1, 0.2, 0.3]), np.eye(3)
    for _ in range(2000):
        gain = np.linalg.solve(np.eye(2) + b.T @ value @ b, b.T @ value @ a)
        value = q + a.T @ value @ (a - b @ gain)
    assert regulator(a, b, np.diag(q)) == pytest.approx(gain, abs=1e-8)


def test_what_nothing_acts_on_gets_no_regulator():
    assert not regulator(np.array([[1.2]]), np.array([[0.0]]), np.array([1.0])).any()
