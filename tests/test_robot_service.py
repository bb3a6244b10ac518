import json
import math
import resource
import signal
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
    run_state_machine_as_test,
)
from robots import NASTY, Actuator, Clock
from trials import timeless

from misstep import MisstepError, demonstrate, learn, load_dataset, load_run, make_system
from misstep.learning import begin
from misstep.robot.cadence import Cadence
from misstep.robot.guard import Command, Safety, State
from misstep.robot.limits import Limits, Reason
from misstep.robot.log import ActionLog, Event, Sent, read_log
from misstep.robot.service import DRIVEN, LOGS, ExplorationService, Phase
from misstep.systems import Judged
from misstep.trajectory import Outcome

OPTIONS = {"state": ("theta", "theta_dot"), "max_trials": 3, "stop_on_success": False, "seed": 5}
UPRIGHT = (0.0, 0.0, 0.0, 0.0)
PERIOD = 0.02


@pytest.fixture(scope="module")
def short():
    return make_system("cartpole", duration=2.0)


class Robot:
    """Drives a service by hand: counts states, stamps them, moves the clock."""

    def __init__(self, service, clock):
        self.service, self.clock, self.sequence = service, clock, 0

    def start(self):
        assert self.service.wait(60.0)
        return self.service.start()

    def report(self, observation=UPRIGHT, **more):
        self.clock.now += PERIOD
        self.sequence += 1
        stamp = more.pop("stamp", self.clock.now - 7.0)
        return self.service.exchange(State(self.sequence, stamp, observation, **more))


@pytest.fixture
def served(short, demonstrations, scripted, tmp_path):
    """Return a function that makes a service of scripted policies, and a robot on it."""
    services = []

    def make(system=None, folder=None, **options):
        system = short if system is None else system
        run = begin(short, demonstrations, "scripted", max_trials=50, stop_on_success=False)
        if folder is not None:
            run.keep_in(tmp_path / folder)
        clock = Clock()
        services.append(ExplorationService(run, system=system, clock=clock, **options))
        return services[-1], Robot(services[-1], clock)

    yield make
    for service in services:
        service.close()


# The same run as in-process


def lock_step(service, system):
    """Drive a service with a simulation until the run is finished."""
    sequence = 0
    while True:
        assert service.wait(60.0)
        start = service.start()
        if start is None:
            return
        observation, info = system.reset(seed=start.seed)
        cost, over = None, False
        while True:
            sequence += 1
            command = service.exchange(
                State(
                    sequence,
                    PERIOD * sequence,
                    tuple(observation.tolist()),
                    cost,
                    info["failed"],
                    info.get("success", False),
                    over,
                )
            )
            if over:
                break
            assert command.in_trial
            step = system.step(np.array(command.action))
            observation, reward, terminated, truncated, info = step
            cost, over = -float(reward), terminated or truncated


@pytest.mark.parametrize("learner", ["mean", "donut", "fall", "hill-climbing", "power"])
def test_a_lock_stepped_robot_makes_the_run_that_learn_makes(
    short, demonstrations, learner, tmp_path
):
    within = learn(short, demonstrations, learner, **OPTIONS)
    run = begin(short, demonstrations, learner, **OPTIONS).keep_in(tmp_path / "run")
    service = ExplorationService(run, system=short, simulated_time=True)
    lock_step(service, short)
    service.close()
    assert service.phase is Phase.FINISHED
    assert timeless(run.trials) == timeless(within.trials)
    again = load_run(tmp_path / "run")
    assert timeless(again.trials) == timeless(within.trials)
    for ours, theirs in zip(again.policies, within.policies, strict=True):
        for name, array in theirs.arrays().items():
            np.testing.assert_array_equal(ours.arrays()[name], array)


def test_a_judged_system_is_judged_alike_by_the_service_alone(demonstrations):
    bare = make_system("cartpole", duration=2.0, stop_at_fall=False)
    judges = {"failure": "abs(theta) > 20deg", "success": "abs(theta) < 3deg", "hold": 0.1}
    judged = Judged(bare, **judges, cost="abs(theta)")
    within = learn(judged, demonstrations, "fall", **OPTIONS)
    run = begin(judged, demonstrations, "fall", **OPTIONS)
    service = ExplorationService(run, system=judged, simulated_time=True)
    # The robot itself says nothing of failure, success or cost, nor when it is over.
    sequence = 0
    while service.wait(60.0) and (start := service.start()) is not None:
        observation, _ = bare.reset(seed=start.seed)
        command = None
        while command is None or command.in_trial:
            if command is not None:
                observation = bare.step(np.array(command.action))[0]
            sequence += 1
            stamp = PERIOD * sequence
            command = service.exchange(State(sequence, stamp, tuple(observation.tolist())))
    service.close()
    assert timeless(run.trials) == timeless(within.trials)
    assert {trial.outcome for trial in run.trials} <= {Outcome.SUCCESS, Outcome.FAILURE}


def test_an_interrupted_run_goes_on_where_it_was(short, demonstrations, tmp_path):
    within = learn(short, demonstrations, "donut", **OPTIONS)
    run = begin(short, demonstrations, "donut", **OPTIONS).keep_in(tmp_path / "run")
    run.config = replace(run.config, max_trials=2)
    first = ExplorationService(run, system=short, simulated_time=True)
    lock_step(first, short)
    first.close()
    second = ExplorationService(load_run(tmp_path / "run"), simulated_time=True)
    lock_step(second, short)
    second.close()
    assert timeless(second.run.trials) == timeless(within.trials)


# A trial


def test_a_trial_is_recorded_as_it_was_sent(served, scripted):
    service, robot = served(limits=None)
    start = robot.start()
    assert (start.number, service.phase) == (0, Phase.RUNNING)
    sent = []
    for step in range(4):
        scripted.answer = np.array([15.0 * step])
        sent.append(robot.report((0.01 * step, 0, 0, 0), cost=step / 2).action)
    over = robot.report((0.05, 0, 0, 0), cost=9.0, failed=True, over=True)
    assert (over.action, over.in_trial) == ((0.0,), False)
    assert service.wait(60.0)
    [trial] = service.run.trials
    assert sent == [(0.0,), (15.0,), (20.0,), (20.0,)]
    np.testing.assert_array_equal(trial.actions, sent)
    np.testing.assert_array_equal(trial.observations[:, 0], [0.0, 0.01, 0.02, 0.03, 0.05])
    np.testing.assert_array_equal(trial.costs, [0.5, 1.0, 1.5, 9.0])
    assert (trial.outcome, trial.failure_step) == (Outcome.FAILURE, 4)
    assert trial.provenance.seed == start.seed
    assert service.phase is Phase.READY


def test_the_longest_trial_ends_itself(served):
    service, robot = served(duration=0.1)
    robot.start()
    commands = [robot.report() for _ in range(6)]
    assert [command.in_trial for command in commands] == [True] * 5 + [False]
    assert service.wait(60.0)
    assert service.run.trials[0].n_steps == 5
    assert service.run.trials[0].outcome is Outcome.UNKNOWN
    assert service.run.trials[0].costs is None


def test_to_last_without_failing_is_a_success_where_only_a_failure_is_defined(served, short):
    service, robot = served(system=Judged(short, failure="abs(theta) > 0.3"), duration=0.1)
    robot.start()
    while robot.report().in_trial:
        pass
    robot.start()
    for angle in (0.1, 0.2, 0.4):
        command = robot.report((0.0, 0.0, angle, 0.0))
    assert not command.in_trial
    assert service.wait(60.0)
    assert [t.outcome for t in service.run.trials] == [Outcome.SUCCESS, Outcome.FAILURE]
    assert service.run.trials[1].failure_step == 2


@pytest.mark.parametrize("outcome", list(Outcome))
def test_a_person_judges(served, outcome):
    service, robot = served()
    assert not service.mark(outcome, "a person")
    robot.start()
    robot.report()
    robot.report()
    robot.report(failed=outcome is Outcome.SUCCESS)
    assert service.mark(outcome, "a person")
    assert not robot.report().in_trial
    assert service.wait(60.0)
    [trial] = service.run.trials
    assert (trial.outcome, trial.n_steps) == (outcome, 2)
    assert trial.failure_step == (2 if outcome is Outcome.FAILURE else None)


def test_between_trials_the_action_is_safe(served, short):
    service, robot = served(limits=Limits.of(short, safe=-2.0))
    assert robot.report().action == (-2.0,)
    assert robot.report().reason == Reason.IDLE
    assert service.run.trials == []


# Safety


def test_without_fresh_states_the_robot_is_told_to_be_safe(served, scripted, short):
    service, robot = served(limits=Limits.of(short, rate=50.0))
    robot.start()
    scripted.answer = np.array([3.0])
    for _ in range(3):
        command = robot.report()
    assert command.action == pytest.approx((3.0,))
    robot.clock.now += 0.1
    assert service.tick() is None  # not yet
    robot.clock.now += 0.001
    told = []
    while (command := service.tick()) is not None:
        assert command.reason & Reason.WATCHDOG
        told.append(command.action[0])
        robot.clock.now += PERIOD
    assert told == pytest.approx([2.0, 1.0, 0.0])  # 50 N/s are 1 N a period
    assert service.phase is Phase.READY
    assert service.run.trials == []
    assert not robot.report().in_trial  # too late for that trial


def test_the_watchdog_needs_no_ticking_when_the_robot_speaks_again(served, scripted):
    _, robot = served()
    robot.start()
    scripted.answer = np.array([3.0])
    robot.report()
    robot.clock.now += 0.2
    command = robot.report()
    assert command.action == (0.0,)
    assert command.reason == Reason.WATCHDOG


def test_a_refused_state_leaves_what_was_wanted(served, scripted):
    service, robot = served()
    robot.start()
    scripted.answer = np.array([3.0])
    robot.report()
    command = robot.report((math.nan, 0.0, 0.0, 0.0))
    assert command.action == (3.0,)
    assert command.reason == Reason.POLICY | Reason.REFUSED
    assert command.sequence == robot.sequence
    for _ in range(5):  # refused states are no sign of life
        command = robot.report((0.0, 0.0))
    assert command.reason == Reason.WATCHDOG | Reason.REFUSED
    assert service.status()["refused"] == {"not finite": 1, "wrong length": 5}


@pytest.mark.parametrize(
    "flaw", [np.array([math.nan]), np.zeros(2), np.zeros((1, 1)), ZeroDivisionError("no")]
)
def test_a_policy_that_fails_stops_the_robot(served, scripted, flaw):
    service, robot = served()
    robot.start()
    robot.report()
    scripted.answer = flaw
    command = robot.report()
    assert command.action == (0.0,)
    assert command.reason & Reason.STOP
    assert service.stopped
    assert service.run.trials == []


def test_a_policy_that_is_late_is_not_followed(served, scripted):
    service, robot = served()
    robot.start()
    scripted.answer = np.array([3.0])
    robot.report()

    def dawdle():
        robot.clock.now += 0.021

    scripted.before = dawdle
    command = robot.report()
    scripted.before = None
    assert (command.action, command.reason) == ((0.0,), Reason.LATE)
    assert robot.report().action == (3.0,)
    assert service.status()["deadline_misses"] == 1


def test_an_emergency_stop_never_waits_for_a_policy(served, scripted, short):
    service, robot = served(limits=Limits.of(short, rate=1.0))
    robot.start()
    scripted.answer = np.array([3.0])
    for _ in range(9):
        robot.report()
    pushed = []

    def stop():  # somebody else stops while the policy is at work
        service.stop("somebody")
        pushed.append(service.tick())

    scripted.before = stop
    command = robot.report()
    scripted.before = None
    [push] = pushed
    assert push.action == command.action == (0.0,)
    assert push.number < command.number
    assert command.reason & push.reason & Reason.STOP
    with pytest.raises(MisstepError, match="emergency stop is latched"):
        service.start()
    service.clear("somebody")
    assert robot.report().reason == Reason.IDLE
    assert robot.start() is not None


def test_a_policy_of_a_trial_that_is_over_is_not_followed(served, scripted):
    service, robot = served()
    robot.start()
    scripted.answer = np.array([3.0])
    robot.report()
    robot.report()
    scripted.before = lambda: service.disconnect("robot")
    command = robot.report()
    assert (command.action, command.in_trial) == ((0.0,), False)
    scripted.before = None
    robot.start()
    scripted.answer = np.array([3.0])
    robot.report()
    robot.report()
    scripted.before = lambda: service.mark(Outcome.FAILURE, "a person")
    assert robot.report().action == (0.0,)
    scripted.before = None
    assert service.wait(60.0)
    np.testing.assert_array_equal(service.run.trials[0].actions, [[3.0], [3.0]])


def test_a_dry_run_shows_and_learns_nothing(served, scripted):
    service, robot = served(safety=Safety(dry_run=True), folder="run")
    robot.start()
    scripted.answer = np.array([3.0])
    command = robot.report()
    assert (command.action, command.intended) == ((0.0,), (3.0,))
    assert not robot.report(over=True).in_trial
    assert robot.start().number == 0
    assert service.run.trials == []


def test_a_robot_that_goes_leaves_no_trial(served):
    service, robot = served()
    first = robot.start()
    for _ in range(3):
        robot.report()
    service.disconnect("robot")
    assert service.phase is Phase.READY
    assert robot.start() == first  # the same trial, anew
    robot.sequence = 0
    service.connect("another")
    assert robot.report().reason == Reason.IDLE


def test_in_simulated_time_nothing_but_a_stop_is_told_between_states(served, scripted, short):
    service, robot = served(limits=Limits.of(short, rate=50.0), simulated_time=True)
    robot.start()
    scripted.answer = np.array([3.0])
    assert [robot.report().action[0] for _ in range(2)] == pytest.approx([1.0, 2.0])
    service.disconnect("robot")
    assert service.tick() is None
    assert robot.report().action == pytest.approx((1.0,))
    service.stop("somebody")
    assert service.tick().action == (0.0,)
    assert service.tick() is None


# With the last policy alone


def test_the_last_policy_drives_and_nothing_is_learned(short, demonstrations, tmp_path):
    run = learn(short, demonstrations, "fall", **OPTIONS, out=tmp_path / "run")
    before = timeless(run.trials)
    leaning = (0.0, 0.0, 0.1, 0.0)
    for _ in range(2):  # twice: the second goes on counting where the first was
        service = ExplorationService(
            load_run(tmp_path / "run"), simulated_time=True, learning=False
        )
        sequence = 0
        for _ in range(2):
            assert service.wait(60.0)
            service.start()
            for step in range(3):
                sequence += 1
                state = State(sequence, sequence * PERIOD, leaning, over=step == 2)
                action = service.exchange(state).action
                if step < 2:
                    run.policy.reset()
                    assert action == tuple(run.policy(np.array(leaning)))
        service.close()
    assert timeless(load_run(tmp_path / "run").trials) == before
    kept = [load_dataset(f)[0] for f in sorted((tmp_path / "run" / DRIVEN).glob("*.h5"))]
    assert len(kept) == 4
    assert len({trial.provenance.seed for trial in kept}) == 4


# The log


def test_the_log_says_why_each_action_was_sent(served, scripted, tmp_path):
    service, robot = served(folder="run")
    service.connect("robot")
    start = robot.start()
    scripted.answer = np.array([30.0])
    robot.report((0.5, 0.0, 0.0, 0.0))
    robot.report((math.inf, 0.0, 0.0, 0.0))
    service.stop("somebody")
    robot.report()
    service.close()
    header, records = read_log(tmp_path / "run" / LOGS / "0000.log")
    assert header["safe"] == [0.0]
    sent, events = [], []
    for record in records:
        (sent if isinstance(record, Sent) else events).append(record)
    assert [record.action for record in sent] == [(20.0,), (20.0,), (0.0,)]
    assert sent[0].observation == (0.5, 0.0, 0.0, 0.0)
    assert sent[0].explain() == "100.020000 s  sent 20: policy, value"
    assert sent[1].reason == Reason.POLICY | Reason.VALUE | Reason.REFUSED
    assert np.isnan(sent[1].observation).all()
    assert sent[2].reason == Reason.STOP
    assert [event.text for event in events] == [
        "robot drives",
        f"trial 0 starts, seed {start.seed}",
        "state 2 refused: not finite",
        "trial 0 abandoned: emergency stop by somebody",
        "emergency stop by somebody",
        "the service ends",
    ]


def test_a_log_that_was_cut_is_read_as_far_as_it_goes(tmp_path):
    path = tmp_path / "a.log"
    log = ActionLog(path, {"n_observations": 2, "n_actions": 1})
    log.event(0.5, "bégin")
    for i in range(3):
        log.command(float(i), Command((1.0,), (2.0,), 3, i - 1, i), (0.1, 0.2))
    log.close()
    whole = path.read_bytes()
    expected = list(read_log(path)[1])
    assert expected[0] == Event(0.5, "bégin")
    assert [record.sequence for record in expected[1:]] == [None, 0, 1]
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        try:
            read = list(read_log(path)[1])
        except MisstepError:
            assert length < whole.index(b"}") + 1  # not even the header is there
        else:
            assert read == expected[: len(read)]
            assert len(expected) - len(read) == 4 - sum(length >= end for end in _ends(whole))
    for garbage in (b"\7" + bytes(60), bytes(2**17) + b"\7"):
        path.write_bytes(whole + garbage)
        with pytest.raises(MisstepError, match="damaged at byte"):
            list(read_log(path)[1])


def test_what_a_killed_service_leaves_is_whole_records(tmp_path):
    """At any moment: the file as it is then, never closed."""
    path = tmp_path / "a.log"
    log = ActionLog(path, {"n_observations": 2, "n_actions": 1})
    written = []
    for i in range(8000):  # through two ends of what is mapped
        assert log.reserve()
        log.command(float(i), Command((1.0,), (2.0,), 3, i, i), (0.1, 0.2))
        written.append(i)
        if i % 1000 == 999:
            log.event(float(i), "x" * i)
            assert [r.sequence for r in read_log(path)[1] if isinstance(r, Sent)] == written
    left = path.read_bytes()
    records = list(read_log(path)[1])
    log.close()
    assert list(read_log(path)[1]) == records
    assert left.startswith(path.read_bytes())
    # A record whose head was not yet written when the kill came is none.
    whole = path.read_bytes()
    path.write_bytes(whole + bytes(4) + b"half a body" + bytes(3000))
    assert list(read_log(path)[1]) == records


def _ends(log):
    """Return where each record of the log above ends."""
    start = log.index(b"}") + 1
    event = start + 4 + 8 + len("bégin".encode())
    return [event + i * ((len(log) - event) // 3) for i in range(4)]


def test_logs_and_trials_that_are_taken_away_leave_the_others_alone(
    short, demonstrations, tmp_path
):
    folder = tmp_path / "run"
    learn(short, demonstrations, "mean", **OPTIONS, out=folder)
    kept = {folder / LOGS / "0001.log": b"a log", folder / DRIVEN / "trial_001.h5": b"a trial"}
    for path, content in kept.items():
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    service = ExplorationService(load_run(folder), simulated_time=True, learning=False)
    assert service.wait(60.0)
    assert service.start().number == 2
    for sequence in range(3):
        service.exchange(State(sequence, sequence * PERIOD, UPRIGHT, over=sequence == 2))
    service.close()
    assert {path: path.read_bytes() for path in kept} == kept
    assert load_dataset(folder / DRIVEN / "trial_002.h5")[0].n_steps == 2
    assert read_log(folder / LOGS / "0002.log")[0]["system"] == "cartpole"


@pytest.mark.parametrize(
    "header",
    [
        b"[]",
        b'{"n_observations": -4, "n_actions": 1}',
        b'{"n_observations": 1e999, "n_actions": 1}',
        b'{"n_observations": 99999999999, "n_actions": 1}',
        b"[" * 100_000,
    ],
)
def test_a_header_that_is_none_is_refused(tmp_path, refused, header):
    (tmp_path / "a.log").write_bytes(b"MISSTEP1" + len(header).to_bytes(4, "little") + header)
    with refused("is not a log of a service"):
        read_log(tmp_path / "a.log")


def test_no_log_is_overwritten(tmp_path, refused):
    header = {"n_observations": 1, "n_actions": 1}
    ActionLog(tmp_path / "a.log", header).close()
    with refused("cannot write the log"):
        ActionLog(tmp_path / "a.log", header)
    (tmp_path / "b.log").write_bytes(b"")
    with refused("is not a log"):
        read_log(tmp_path / "b.log")


@pytest.fixture
def full_disk():
    """Return a function that lets no file grow beyond so many bytes; undone at the end."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, before)


def test_what_cannot_be_logged_is_not_sent(served, scripted, full_disk, tmp_path):
    service, robot = served(folder="run", duration=1000.0)
    robot.start()
    scripted.answer = np.array([3.0])
    assert robot.report().action == (3.0,)
    log = tmp_path / "run" / LOGS / "0000.log"
    full_disk(log.stat().st_size)  # what is reserved remains
    commands = []
    while not service.stopped:
        commands.append(robot.report())
    assert {command.action for command in commands} == {(3.0,), (0.0,)}
    assert commands[-1].reason & Reason.STOP
    assert commands[-1].action == (0.0,)
    full_disk(resource.RLIM_INFINITY)
    service.clear("a person")
    assert robot.start().number == 0
    assert robot.report().action == (0.0,)
    scripted.answer = np.array([4.0])
    assert robot.report().action == (4.0,)
    assert service.status()["unlogged"] == 0
    records = list(read_log(log)[1])
    sent = [r.action for r in records if isinstance(r, Sent)]
    assert sent == [(3.0,), *(command.action for command in commands), (0.0,), (4.0,)]
    assert "the disk has no room for the log" in [r.text for r in records if isinstance(r, Event)]


def test_a_disk_that_stays_full_lets_nothing_but_safe_actions_out(
    served, scripted, full_disk, tmp_path
):
    service, robot = served(folder="run", duration=1000.0)
    robot.start()
    scripted.answer = np.array([3.0])
    log = tmp_path / "run" / LOGS / "0000.log"
    full_disk(log.stat().st_size)
    while not service.stopped:
        robot.report()
    while service.status()["unlogged"] < 3:
        assert robot.report().action == (0.0,)
    service.clear("a person")  # in vain
    assert robot.report().action == (0.0,)
    assert service.stopped
    full_disk(resource.RLIM_INFINITY)
    assert robot.report().action == (0.0,)
    assert [r.action for r in read_log(log)[1] if isinstance(r, Sent)][-1] == (0.0,)


def test_a_finished_trial_outlives_a_full_disk(served, full_disk, tmp_path):
    service, robot = served(folder="run")
    robot.start()
    for _ in range(20):
        robot.report()
    full_disk(4000)  # the log goes on, a trial's file does not fit
    robot.report(over=True)
    for _ in range(2):
        with pytest.raises(MisstepError, match="cannot write"):
            robot.start()
    assert service.wait(60.0)
    assert service.run.trials == []
    full_disk(resource.RLIM_INFINITY)
    with pytest.raises(MisstepError, match="cannot write"):
        robot.start()  # tells of the last failure, and tries again
    assert robot.start().number == 1
    assert timeless(load_trials(tmp_path / "run")) == timeless(service.run.trials)
    assert service.run.trials[0].n_steps == 20


def load_trials(folder):
    return [load_dataset(file)[0] for file in sorted((folder / "trials").glob("*.h5"))]


def test_durations_are_counted_in_constant_memory():
    cadence = Cadence()
    assert cadence.quantile(0.5) is None
    durations = np.random.default_rng(0).lognormal(-9.0, 1.0, 5000)
    for seconds in durations:
        cadence.add(float(seconds))
    for q in (0.01, 0.5, 0.99):
        exact = np.quantile(durations, q, method="inverted_cdf")
        assert exact <= cadence.quantile(q) <= exact * 2 ** (1 / 8)
    assert cadence.quantile(1.0) == cadence.longest == durations.max()
    cadence.add(0.0)
    cadence.add(1e9)
    assert cadence.n == 5002


def test_what_is_told_can_be_said_in_json(served, short):
    service, _ = served(limits=Limits.of(short, rate=3.0))
    told = json.loads(json.dumps({**service.describe(), **service.status()}, allow_nan=False))
    assert (told["rate"], told["jerk"], told["dt"]) == ([3.0], [None], PERIOD)


# Whatever comes, in whatever order


class AnyExchange(RuleBasedStateMachine):
    """A service with wild policies, states and clocks; what leaves is safe, or in time."""

    shown = system = scripted = None
    seen: Counter

    @initialize(rate=st.sampled_from([20.0, math.inf]), jerk=st.sampled_from([1e3, 1e4, math.inf]))
    def serve(self, rate, jerk):
        run = begin(self.system, self.shown, "scripted", max_trials=10_000, stop_on_success=False)
        self.clock = Clock()
        limits = Limits.of(self.system, rate=rate, jerk=jerk, ranges={"x": (-2.0, 2.0)})
        self.service = ExplorationService(
            run, system=self.system, limits=limits, clock=self.clock, duration=0.3
        )
        self.actuator = Actuator(limits)
        self.sequence = 0

    def wait(self, seconds):
        self.clock.now += seconds
        self.actuator.look_at(self.clock.now)

    def check(self, command):
        self.actuator.obey(command, self.clock.now)
        assert bool(command.reason & Reason.STOP) == self.service.stopped
        self.seen.update(part.name for part in Reason if part & command.reason)

    @rule()
    def start(self):
        assert self.service.wait(60.0)
        try:
            assert self.service.start() is not None
        except MisstepError:
            assert self.service.stopped

    @rule(
        row=st.just(UPRIGHT) | st.lists(st.sampled_from(NASTY) | st.floats(-3, 3), max_size=5),
        ahead=st.sampled_from([1, 1, 1, 0, -1, 5]),
        late=st.sampled_from([0.0, 0.0, 0.0, 0.15, -0.15, math.nan]),
        waited=st.sampled_from([PERIOD, PERIOD, 0.0, 0.05, 0.15, -5.0]),
        answer=st.sampled_from([*NASTY, 1.0, 2.0, 3.0, 4.0, 19.0, "raise", "shape"]),
        thinking=st.sampled_from([0.0, 0.0, 0.019, 0.03, 1.0, -1.0]),
        over=st.sampled_from([False, False, False, True]),
    )
    def report_anything(self, row, ahead, late, waited, answer, thinking, over):
        self.wait(waited)
        self.sequence += ahead
        self.scripted.answer = {"raise": OSError("x"), "shape": np.zeros(3)}.get(
            answer, np.array([answer] if isinstance(answer, float) else [0.0])
        )

        self.scripted.before = lambda: self.wait(thinking)
        stamp = self.clock.now - late
        command = self.service.exchange(State(self.sequence, stamp, tuple(row), over=over))
        self.check(command)
        assert command.sequence == self.sequence
        if command.reason & Reason.POLICY and not command.reason & Reason.REFUSED:
            assert math.isfinite(answer)
            assert thinking < PERIOD
            assert len(row) == 4

    @rule(
        n=st.integers(1, 10),
        wanted=st.floats(-30.0, 30.0),
        over=st.booleans(),
        thinking=st.sampled_from([0.0, 0.019, 0.03]),
    )
    def report_well(self, n, wanted, over, thinking):
        """A stretch of a trial, so that the wild ones meet one that is well on its way."""
        if self.service.phase is not Phase.RUNNING:
            self.service.clear("somebody")
            self.start()
        self.scripted.answer = np.array([wanted])
        self.scripted.before = lambda: self.wait(thinking)
        for i in range(n):
            self.wait(PERIOD)
            self.sequence += 1
            last = over and i == n - 1
            state = State(self.sequence, self.clock.now, UPRIGHT, over=last)
            self.check(self.service.exchange(state))

    @rule(waited=st.sampled_from([0.0, PERIOD, 0.05, 0.2, -1.0]))
    def tick(self, waited):
        self.wait(waited)
        command = self.service.tick()
        if command is not None:
            assert not command.reason & Reason.POLICY
            self.check(command)

    @precondition(lambda self: not self.service.stopped)
    @rule()
    def stop(self):
        self.service.stop("somebody")
        command = self.service.tick()
        if command is not None:
            self.check(command)
        assert self.actuator.is_safe

    @precondition(lambda self: self.service.stopped)
    @rule()
    def clear(self):
        self.service.clear("somebody")
        assert self.actuator.is_safe

    @rule(outcome=st.sampled_from(list(Outcome)))
    def mark(self, outcome):
        self.service.mark(outcome, "somebody")

    @rule()
    def silence(self):
        """Whatever came before: when nothing more comes, the actuator ends safe."""
        self.report_well(3, 15.0, False, 0.0)
        for _ in range(200):  # 20 N at 20 N/s
            self.wait(PERIOD)
            command = self.service.tick()
            if command is not None:
                self.check(command)
        assert self.actuator.is_safe
        assert self.service.phase is not Phase.RUNNING

    def teardown(self):
        if hasattr(self, "service"):
            self.service.close()
            self.seen["trials"] += len(self.service.run.trials)


def test_whatever_comes_what_leaves_is_safe_or_in_time(short, scripted):
    shown = demonstrate(short, by="weak", n=2, seed=0)
    seen = Counter()
    parts = {"shown": shown, "system": short, "scripted": scripted, "seen": seen}
    run_state_machine_as_test(
        type("Machine", (AnyExchange,), parts),
        settings=settings(max_examples=40, stateful_step_count=40, deadline=None),
    )
    # The machine has been everywhere.
    reasons = {part.name for part in Reason} - {"DRY_RUN", "SILENT"}
    assert all(seen[name] > 3 for name in (*reasons, "trials")), seen
