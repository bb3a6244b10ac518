"""A service over a socket, and everything that can go wrong with it, for tests and studies."""

import math
import resource
import signal
import socket
import struct
import time
from collections import Counter
from contextlib import contextmanager

import numpy as np
from robots import Clock, scripted_learner

from misstep import MisstepError, load_run, make_system
from misstep.learners import LEARNERS
from misstep.learning import begin
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

    def refusal(self):
        """Ask for a trial in vain; return why there is none."""
        try:
            raise AssertionError(f"a trial began: {self.robot.start()}")
        except MisstepError as error:
            return str(error)

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
        while not (command := self.ask()).reason & Reason.STOP:  # what is reserved is used up
            pass
        self.grow(None)
        assert command.action == (SAFE,)
        assert not command.in_trial
        self.robot.clear()

    def disk_is_full_at_the_end_of_a_trial(self, rng):
        number = self.drive().number
        self.grow(-1)  # what is reserved for the log remains, but the trial cannot be written
        last = self.ask(over=True)
        assert not last.in_trial
        for _ in range(2):
            assert "cannot write" in self.refusal()  # and tries again
            assert self.service.wait(60.0)
        assert len(self.service.run.trials) == number
        self.grow(None)
        assert "cannot write" in self.refusal()  # tells of the last failure
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


@contextmanager
def small_disk(log):
    """Give a function that lets files be so many bytes larger than the log is (None: any).

    With -1, nothing at all can be written.

    What a full disk does, the limit on the size of a file does too: a write comes back short, or
    is refused.
    """
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    def grow(more):
        size = limits[0] if more is None else 0 if more < 0 else more + log.stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))

    yield grow
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, before)


def harm(folder, demonstrations, n_faults, seed=0):
    """Make so many faults, and check that nothing finished is lost and the robot ends safe.

    Returns a Counter of what was done, and the number of trials that were finished and are kept.
    """
    kind = scripted_learner()
    LEARNERS._own["scripted"] = kind
    policy = kind.scripted
    policy.reset = lambda: setattr(policy, "answer", np.array([15.0]))
    system = make_system("cartpole", duration=1.0)
    run = begin(system, demonstrations, "scripted", max_trials=10_000, stop_on_success=False)
    run.keep_in(folder / "run")
    clock = Clock()
    service = ExplorationService(
        run,
        system=system,
        limits=Limits.of(system, rate=RATE, safe=SAFE),
        safety=Safety(watchdog=0.05),
        duration=1000.0,
        clock=clock,
    )
    service.policy = policy
    log = folder / "run" / LOGS / "0000.log"
    hub = Hub(service, SECRET)
    server = SocketServer(hub, f"unix:{folder}/s")
    rng = np.random.default_rng(seed)
    made, finished = Counter(), 0
    with small_disk(log) as grow:
        faults = Faults(server.address, service, clock, grow)
        for n in range(n_faults):
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
    del LEARNERS._own["scripted"]
    kept = check_kept(folder / "run", run, finished)
    check_log(log, n_faults)
    return made, kept


def check_kept(folder, run, finished):
    """Return how many trials are in the folder: all that were finished, as they were."""
    LEARNERS._own["scripted"] = scripted_learner()
    again = load_run(folder)
    del LEARNERS._own["scripted"]
    assert len(again.trials) >= finished
    assert again.trials == run.trials
    return len(again.trials)


def check_log(log, n_faults):
    """Check what was sent, from the log alone."""
    _, records = read_log(log)
    sent = [record for record in records if isinstance(record, Sent)]
    assert len(sent) > 3 * n_faults
    actions = np.array([record.action for record in sent])
    assert np.isfinite(actions).all()
    assert (np.abs(actions) <= 20.0).all()
    assert (actions[:, 0] == 15.0).sum() > n_faults
    assert sent[-1].action == (SAFE,)
    for record in sent:
        if record.reason & Reason.STOP:
            assert record.action == (SAFE,)
