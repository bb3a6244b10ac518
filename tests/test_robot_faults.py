"""Two hundred faults: nothing finished is lost, and the last action sent is the safe one."""

import math
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import Counter

import numpy as np
import pytest
from robots import Clock, scripted_learner

from misstep import MisstepError, load_run, make_system, save_dataset
from misstep.learners import LEARNERS
from misstep.learning import begin
from misstep.robot.addresses import TOKEN
from misstep.robot.client import RobotClient
from misstep.robot.guard import Safety, State
from misstep.robot.limits import Limits, Reason
from misstep.robot.log import Sent, read_log
from misstep.robot.protocol import VERSION, Kind, encode, encode_state
from misstep.robot.service import LOGS, ExplorationService, Phase
from misstep.robot.session import Hub
from misstep.robot.socket_server import SocketServer

SECRET = "s3cret"  # noqa: S105 - of a service that lives for a test
UPRIGHT = (0.0, 0.0, 0.0, 0.0)
SAFE = -2.0
N_FAULTS = 200
RATE = 1000.0  # N/s: 20 N a period
PERIOD = 0.02


def until(condition):
    """Wait until something holds that another thread or process does."""
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


class Faults:
    """A robot that goes wrong in every way, on a service that others harm too."""

    def __init__(self, address, service, clock, grow):
        self.address, self.service, self.clock, self.grow = address, service, clock, grow
        self.robot = None

    def ask(self, observation=UPRIGHT, ahead=0.0, **more):
        """Report a state a period later, with a stamp that is so far ahead of the time."""
        self.clock.now += PERIOD
        return self.robot.ask(observation, stamp=self.clock.now + ahead, **more)

    def is_settled(self):
        """Let a period pass, and return whether the actuator is safe and no trial runs."""
        self.clock.now += PERIOD
        status = self.service.status()
        return status["safe"] and status["phase"] != "running"

    def drive(self, n_steps=3):
        """Begin a trial and get it going."""
        if self.robot is None:
            self.robot = RobotClient(self.address, SECRET, patience=30.0)
        start = self.robot.start()
        for _ in range(n_steps):
            assert self.ask().in_trial
        return start

    def finish(self):
        """Make a whole trial, and learn that it was kept by being told the number of the next."""
        number = self.drive().number
        self.ask(over=True)
        assert self.robot.start().number == number + 1
        return number + 1

    def hang_up(self):
        self.robot.close()
        self.robot = None
        until(lambda: self.service.phase is not Phase.RUNNING)

    def raw(self):
        """Return a plain connection that knows the token and has begun a trial."""
        if self.robot is not None:
            self.hang_up()
        plain = socket.socket(socket.AF_UNIX)
        plain.connect(self.address.removeprefix("unix:"))
        hello = {"token": SECRET, "role": "drive", "version": VERSION, "name": "raw"}
        # All at once: the service has to take it apart.
        state = encode_state(State(1, self.clock.now, UPRIGHT))
        until(lambda: self.service.phase is Phase.READY)
        plain.sendall(b"".join(map(framed, (encode(Kind.HELLO, hello), encode(Kind.START), state))))
        plain.settimeout(30.0)
        received = b""
        while bytes([Kind.COMMAND]) not in received:
            received += plain.recv(4096)
        return plain

    # Each leaves the robot in a trial that cannot go on well

    def robot_vanishes(self, rng):
        self.drive()
        self.hang_up()

    def message_is_cut(self, rng):
        plain = self.raw()
        message = framed(encode_state(State(2, self.clock.now, UPRIGHT)))
        plain.sendall(message[: rng.integers(1, len(message))])
        plain.close()

    def message_is_cut_and_the_line_stays_open(self, rng):
        plain = self.raw()
        message = framed(encode_state(State(2, self.clock.now, UPRIGHT)))
        plain.sendall(message[: rng.integers(1, len(message))])
        until(self.is_settled)  # the watchdog
        plain.close()

    def garbage_arrives(self, rng):
        plain = self.raw()
        plain.sendall(framed(rng.bytes(rng.integers(0, 60))))
        plain.close()

    def a_length_is_absurd(self, rng):
        plain = self.raw()
        plain.sendall(struct.pack("<I", 2**31) + rng.bytes(100))
        plain.close()

    def robot_falls_silent(self, rng):
        self.drive()
        told = []
        until(lambda: self.is_settled() and told.append(self.robot.poll()) is None and told[-1])
        assert told[-1].action == (SAFE,)
        assert told[-1].reason & Reason.WATCHDOG

    def clock_jumps(self, rng):
        self.drive()
        ahead = rng.choice([-1.0, 1.0]) * 3600.0
        while (command := self.ask(ahead=ahead)).in_trial:
            assert command.reason & Reason.REFUSED
        assert command.action == (SAFE,)

    def states_are_nonsense(self, rng):
        self.drive()
        nonsense = [(math.nan,) * 4, (), (0.0, 0.0, 9.0, 0.0), (math.inf, 0, 0, 0), UPRIGHT * 40]
        while (command := self.ask(nonsense[rng.integers(len(nonsense))])).in_trial:
            assert command.reason & Reason.REFUSED
        assert command.action == (SAFE,)

    def somebody_stops(self, rng):
        self.drive()
        with RobotClient(self.address, SECRET, role="watch") as person:
            person.stop()
            assert self.ask().action == (SAFE,)
            person.clear()

    def policy_fails(self, rng):
        self.drive()
        self.service.policy.answer = [ZeroDivisionError(), np.array([math.nan]), np.zeros(3)][
            rng.integers(3)
        ]
        command = self.ask()
        assert command.action == (SAFE,)
        assert command.reason & Reason.STOP
        self.robot.clear()

    def disk_is_full(self, rng):
        self.drive()
        self.grow(int(rng.integers(1, 200)))
        for _ in range(5):
            command = self.ask()
        self.grow(None)
        assert command.action == (SAFE,)
        assert command.reason & Reason.STOP
        self.robot.clear()

    def disk_is_full_at_the_end_of_a_trial(self, rng):
        number = self.drive().number
        self.grow(-1)  # neither the log nor the trial can be written
        assert self.ask(over=True).action == (SAFE,)
        with pytest.raises(MisstepError, match="emergency stop is latched"):
            self.robot.start()
        assert self.service.wait(60.0)
        assert len(self.service.run.trials) == number
        self.grow(None)
        self.robot.clear()
        with pytest.raises(MisstepError, match="cannot write"):  # tells of it, and tries again
            self.robot.start()
        assert self.robot.start().number == number + 1
        self.hang_up()


WAYS = (
    Faults.robot_vanishes,
    Faults.message_is_cut,
    Faults.message_is_cut_and_the_line_stays_open,
    Faults.garbage_arrives,
    Faults.a_length_is_absurd,
    Faults.robot_falls_silent,
    Faults.clock_jumps,
    Faults.states_are_nonsense,
    Faults.somebody_stops,
    Faults.policy_fails,
    Faults.disk_is_full,
    Faults.disk_is_full_at_the_end_of_a_trial,
)


def framed(message):
    return struct.pack("<I", len(message)) + message


@pytest.fixture
def grow():
    """Return a function that lets files be so many bytes larger than the log (None: any).

    With -1, nothing at all can be written.

    What a full disk does, the limit on the size of a file does too: a write comes back short, or
    is refused.
    """
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    largest = []

    def set_limit(more):
        size = limits[0] if more is None else 0 if more < 0 else more + largest[0]()
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))

    yield set_limit, largest
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, before)


def test_after_two_hundred_faults_nothing_is_lost_and_the_robot_is_safe(
    demonstrations, tmp_path, monkeypatch, grow
):
    kind = scripted_learner()
    monkeypatch.setitem(LEARNERS._own, "scripted", kind)
    policy = kind.scripted
    policy.reset = lambda: setattr(policy, "answer", np.array([15.0]))
    system = make_system("cartpole", duration=1.0)
    run = begin(system, demonstrations, "scripted", max_trials=10_000, stop_on_success=False)
    run.keep_in(tmp_path / "run")
    clock = Clock()
    service = ExplorationService(
        run,
        system=system,
        limits=Limits.of(system, rate=RATE, safe=SAFE),
        safety=Safety(watchdog=0.05),
        clock=clock,
    )
    service.policy = policy
    set_limit, largest = grow
    log = tmp_path / "run" / LOGS / "0000.log"
    largest.append(lambda: log.stat().st_size)
    hub = Hub(service, SECRET)
    server = SocketServer(hub, f"unix:{tmp_path}/s")
    faults = Faults(server.address, service, clock, set_limit)
    rng = np.random.default_rng(0)
    made, finished = Counter(), 0
    for n in range(N_FAULTS):
        way = WAYS[n % len(WAYS)]
        way(faults, rng)
        made[way.__name__] += 1
        until(faults.is_settled)
        if n % 10 == 9:
            finished = faults.finish()
            faults.hang_up()
            until(faults.is_settled)
    if faults.robot is not None:
        faults.hang_up()
    server.close()
    hub.close()
    service.close()
    assert sum(made.values()) == N_FAULTS
    assert len(made) == 12
    again = load_run(tmp_path / "run")
    assert len(again.trials) >= finished > 0
    assert again.trials == run.trials
    check_log(log, service.limits)


def check_log(log, limits):
    """Check what was sent, from the log alone."""
    _, records = read_log(log)
    sent = [record for record in records if isinstance(record, Sent)]
    assert len(sent) > 3 * N_FAULTS
    actions = np.array([record.action for record in sent])
    assert np.isfinite(actions).all()
    assert (np.abs(actions) <= 20.0).all()
    assert (actions[:, 0] == 15.0).sum() > N_FAULTS
    assert sent[-1].action == (SAFE,)
    for record in sent:
        if record.reason & Reason.STOP:
            assert record.action == (SAFE,)


# A service that is killed

PROGRAM = "import sys; from misstep.cli import main; sys.exit(main())"
LATER = ("--watchdog-ms", "10000", "--deadline-ms", "10000")


def test_a_killed_service_has_lost_nothing_and_its_robot_is_safe(
    demonstrations, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(TOKEN, SECRET)
    save_dataset(demonstrations, "D.h5")
    new = ("--from", "D.h5", "--system", "cartpole", "--learner", "mean", "--max-trials", "100")
    finished = 0
    for turn in range(2):
        words = ("serve", "RUN", *(new if turn == 0 else ()), "--socket", "unix:s", *LATER)
        serving = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *words], stdout=subprocess.DEVNULL
        )
        until(lambda: is_listening("s"))
        robot = RobotClient("unix:s", patience=60.0, timeout=60.0)
        assert robot.start().number == finished
        for _ in range(3):
            assert robot.ask((0.0, 0.0, 0.1, 0.0), cost=1.0).in_trial
        robot.ask((0.0, 0.0, 0.6, 0.0), cost=9.0, failed=True, over=True)
        finished = robot.start().number
        assert robot.ask((0.0, 0.0, 0.1, 0.0)).action != (0.0,)
        os.kill(serving.pid, signal.SIGKILL)
        serving.wait()
        command = robot.ask((0.0, 0.0, 0.1, 0.0))
        assert (command.action, command.in_trial) == ((0.0,), False)
        assert command.reason & Reason.SILENT
        robot.close()
        run = load_run("RUN")
        assert [trial.n_steps for trial in run.trials] == [3] * finished == [3] * (turn + 1)
        records = list(read_log(f"RUN/actions/{turn:04d}.log")[1])
        assert isinstance(records[-1], Sent)  # the last word of the killed one
        assert records[-1].reason & Reason.POLICY


def is_listening(path):
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(path) == 0
