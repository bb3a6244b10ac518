import json
import math
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from robots import NASTY, Clock
from trials import timeless

from misstep import MisstepError, learn, load_run, make_system
from misstep.cli import main
from misstep.learning import begin
from misstep.robot.addresses import TOKEN, parse_address
from misstep.robot.client import RobotClient, drive
from misstep.robot.guard import Command, Safety, State
from misstep.robot.limits import Limits, Reason
from misstep.robot.link import open_link
from misstep.robot.protocol import (
    LONGEST,
    VERSION,
    Kind,
    Observed,
    decode,
    decode_action,
    decode_command,
    decode_observed,
    decode_state,
    encode,
    encode_action,
    encode_command,
    encode_observed,
    encode_state,
    kind_of,
)
from misstep.robot.remote_system import RemoteSystem, describe_system
from misstep.robot.service import ExplorationService, Phase
from misstep.robot.session import MOST_CLIENTS, Hub
from misstep.robot.socket_server import SocketServer
from misstep.robot.system_server import SystemHub
from misstep.robot.websocket_server import WebSocketServer
from misstep.systems import SYSTEMS
from misstep.trajectory import Outcome

SECRET = "s3cret"  # noqa: S105 - of a service that lives for a test
UPRIGHT = (0.0, 0.0, 0.0, 0.0)
OPTIONS = {"state": ("theta", "theta_dot"), "max_trials": 2, "stop_on_success": False, "seed": 5}
TRANSPORTS = ("unix", "tcp", "websocket")


@pytest.fixture(scope="module")
def short():
    return make_system("cartpole", duration=1.0)


def until(condition):
    """Wait until something holds that another thread does."""
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def server_of(hub, transport, folder, **options):
    if transport == "websocket":
        return WebSocketServer(hub, "127.0.0.1:0", **options)
    return SocketServer(hub, "127.0.0.1:0" if transport == "tcp" else f"unix:{folder}/s")


class Served:
    """A service, its hub and a server, to be closed together."""

    def __init__(self, service, transport, folder, **options):
        self.service = service
        self.hub = Hub(service, SECRET)
        self.server = server_of(self.hub, transport, folder, **options)
        self.address = self.server.address

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.close()
        self.hub.close()
        self.service.close()

    def client(self, **options):
        return RobotClient(self.address, SECRET, **options)


@pytest.fixture
def served(short, demonstrations, scripted, tmp_path):
    """Return a function that makes a service of scripted policies, served somewhere."""
    made = []

    def make(transport="unix", origins=None, **options):
        run = begin(short, demonstrations, "scripted", max_trials=50, stop_on_success=False)
        given_ = {} if origins is None else {"origins": origins}
        # Nothing here is a matter of time: the machine may be busy.
        options = {"safety": Safety(watchdog=30.0, deadline=30.0), **options}
        service = ExplorationService(run, system=short, **options)
        made.append(Served(service, transport, tmp_path, **given_))
        return made[-1]

    yield make
    for one in made:
        one.__exit__()


# Messages

NUMBERS = st.floats(allow_nan=False) | st.sampled_from(NASTY[1:])
ROWS = st.lists(NUMBERS, max_size=7).map(tuple)
WORDS = st.integers(-(2**63), 2**63 - 1)


@given(
    st.builds(
        State,
        WORDS,
        NUMBERS,
        ROWS,
        st.none() | NUMBERS,
        st.booleans(),
        st.booleans(),
        st.booleans(),
    )
)
def test_a_state_comes_out_as_it_went_in(state):
    message = encode_state(state)
    assert decode_state(message) == state
    assert kind_of(message) == Kind.STATE


@given(
    rows=st.integers(0, 5).flatmap(lambda m: st.tuples(*[st.tuples(*[NUMBERS] * m)] * 2)),
    reason=st.integers(0, 2**11 - 1),
    sequence=WORDS,
    number=st.integers(0, 2**64 - 1),
)
def test_a_command_comes_out_as_it_went_in(rows, reason, sequence, number):
    command = Command(*rows, reason, sequence, number)
    assert decode_command(encode_command(command)) == command


@given(st.builds(Observed, ROWS, NUMBERS, *[st.booleans()] * 5), ROWS)
def test_what_a_robot_observes_and_does_comes_out_as_it_went_in(observed, action):
    assert decode_observed(encode_observed(observed)) == observed
    assert decode_action(encode_action(action)) == action


@given(st.binary(max_size=80))
def test_garbage_is_read_or_refused_but_nothing_else(message):
    for read in (decode_state, decode_command, decode_action, decode_observed, decode):
        with suppress(MisstepError):
            read(message)
    assert -1 <= kind_of(message) < 256


NO_ADDRESSES = ["", "7106", "host:", "host:x", "host:99999", "unix:", ":1", "h:" + "1" * 5000]


@pytest.mark.parametrize("address", NO_ADDRESSES)
def test_addresses_that_are_none_are_refused(refused, address):
    with refused("neither host:port"):
        parse_address(address)


# A service and a robot


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_robot_elsewhere_makes_the_run_that_learn_makes(
    short, demonstrations, transport, tmp_path
):
    within = learn(short, demonstrations, "fall", **OPTIONS)
    run = begin(short, demonstrations, "fall", **OPTIONS).keep_in(tmp_path / "run")
    service = ExplorationService(run, system=short, simulated_time=True)
    with Served(service, transport, tmp_path) as served, served.client(patience=30.0) as client:
        drive(client, short)
        assert client.status()["phase"] == "finished"
    assert timeless(load_run(tmp_path / "run").trials) == timeless(within.trials)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_anybody_stops_and_the_robot_is_told_unasked(served, scripted, transport):
    one = served(transport)
    with one.client() as robot, one.client(role="watch", name="a person") as person:
        assert robot.start().number == 0
        scripted.answer = np.array([3.0])
        assert robot.ask(UPRIGHT).action == (3.0,)
        assert robot.poll() is None
        assert person.stop()["stopped"]
        told = []
        until(lambda: told.append(robot.poll()) or told[-1] is not None)
        assert told[-1].action == (0.0,)
        assert told[-1].reason & Reason.STOP
        assert robot.ask(UPRIGHT).reason & Reason.STOP
        with pytest.raises(MisstepError, match="emergency stop is latched"):
            robot.start()
        assert not person.clear()["stopped"]
        assert robot.start().number == 0
        robot.ask(UPRIGHT)
        robot.ask(UPRIGHT)
        person.mark(Outcome.FAILURE)
        assert not robot.ask(UPRIGHT).in_trial
        assert robot.start().number == 1
    assert one.service.run.trials[0].outcome is Outcome.FAILURE


def test_without_states_the_robot_is_told_to_be_safe_unasked(served, scripted, short):
    clock, limits = Clock(), Limits.of(short, rate=500.0)
    one = served(safety=Safety(watchdog=0.2), limits=limits, clock=clock)
    with one.client(patience=30.0) as robot:
        scripted.before = None
        robot.start()
        scripted.answer = np.array([20.0])
        for _ in range(3):
            clock.now += 0.02
            last = robot.ask(UPRIGHT, stamp=clock.now)
        assert last.action == (20.0,)
        clock.now += 0.1
        one.hub.tick()
        assert robot.poll() is None
        told = []

        def is_safe():
            clock.now += 0.02
            told.append(robot.poll())
            return told[-1] is not None and told[-1].action == (0.0,)

        until(is_safe)
        heard = [command for command in told if command is not None]
        assert all(command.number > last.number for command in heard)
        assert all(command.reason & (Reason.WATCHDOG | Reason.IDLE) for command in heard)
        assert one.service.phase is Phase.READY


def test_an_older_command_is_not_sent_after_a_newer_one(served):
    told = []
    session = served().hub.open(told.append)
    for number in (4, 6, 5, 6, 7):  # two threads, in whatever order they come
        session.tell(Command((0.0,), (0.0,), Reason.IDLE, 1, number))
    assert [decode_command(message).number for message in told] == [4, 6, 7]


def test_one_robot_drives_at_a_time(served):
    one = served()
    with one.client(name="first") as first:
        first.start()
        first.ask(UPRIGHT)
        with pytest.raises(MisstepError, match="first drives, and is in a trial"):
            one.client(name="second")
        first.ask(UPRIGHT, over=True)
        with one.client(name="second") as second:
            assert second.start().number == 1
            with pytest.raises(MisstepError, match="another client drives"):
                first.start()
            silent = first.ask(UPRIGHT)
            assert (silent.action, silent.reason) == ((0.0,), Reason.SILENT | Reason.WATCHDOG)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_who_does_not_know_the_token_is_told_nothing(served, transport):
    one = served(transport)
    for token in ("", "S3cret", "s3cret\0", "ß", "\ud800"):
        with pytest.raises(MisstepError, match="the token is not the right one"):
            RobotClient(one.address, token)
    link = open_link(one.address, 5.0)
    link.send(encode(Kind.STOP))
    assert "HELLO" in decode(link.receive(5.0))["error"]
    with pytest.raises(ConnectionError):
        link.receive(5.0)
    link.close()
    assert not one.service.stopped


def test_the_token_comes_from_the_environment(served, monkeypatch):
    one = served()
    monkeypatch.setenv(TOKEN, SECRET)
    with RobotClient(one.address) as client:
        assert client.description["dt"] == 0.02


def test_another_version_of_the_protocol_is_refused(served):
    link = open_link(served().address, 5.0)
    link.send(encode(Kind.HELLO, {"token": SECRET, "version": VERSION + 1}))
    assert f"version {VERSION}" in decode(link.receive(5.0))["error"]
    link.close()


def test_a_page_of_another_origin_is_refused(served):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    one = served("websocket", origins=["http://localhost:8000"])
    with (
        pytest.raises(InvalidStatus, match="403"),
        connect(one.address, origin="http://evil.example"),
    ):
        raise AssertionError("it was let in")
    with connect(one.address, origin="http://localhost:8000") as page:
        page.send(encode(Kind.HELLO, {"token": SECRET, "role": "watch", "version": VERSION}))
        assert kind_of(page.recv(5.0)) == Kind.WELCOME


def test_there_is_an_end_to_clients_and_to_messages(served, short):
    one = served()
    clients = [one.client(role="watch") for _ in range(MOST_CLIENTS)]
    with pytest.raises(MisstepError, match=f"{MOST_CLIENTS} clients already"):
        one.client()
    for client in clients:
        client.close()
    until(lambda: not one.hub._sessions)
    plain = socket.socket(socket.AF_UNIX)
    plain.connect(one.address.removeprefix("unix:"))
    plain.sendall(struct.pack("<I", LONGEST + 1))
    answer = plain.recv(1000)
    assert b"at most" in answer
    plain.close()


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_who_says_nothing_is_let_go(served, monkeypatch, transport):
    for module in ("socket_server", "websocket_server"):
        monkeypatch.setattr(f"misstep.robot.{module}.HELLO_TIMEOUT", 0.05)
    one = served(transport)
    link = open_link(one.address, 5.0)
    with pytest.raises(ConnectionError):
        link.receive(30.0)
    link.close()
    until(lambda: not one.hub._sessions)


def in_a_frame(message):
    """Return a short message as a frame of a stream."""
    return struct.pack("<I", len(message)) + message


def in_a_websocket_frame(message):
    """Return a short message as a binary frame of a browser."""
    return bytes([0x82, 0x80 | len(message), 0, 0, 0, 0]) + message


@pytest.mark.parametrize(
    ("transport", "frame"), [("tcp", in_a_frame), ("websocket", in_a_websocket_frame)]
)
def test_who_does_not_read_is_let_go_and_holds_nobody_up(served, transport, frame):
    one = served(transport)
    host, port = parse_address(one.address.removeprefix("ws://"))
    plain = socket.create_connection((host, port), timeout=30.0)
    if transport == "websocket":
        plain.sendall(
            b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        assert plain.recv(4096).startswith(b"HTTP/1.1 101")
    plain.sendall(frame(encode(Kind.HELLO, {"token": SECRET, "role": "drive", "version": VERSION})))
    with pytest.raises(ConnectionError):  # noqa: PT012
        while True:
            plain.sendall(1000 * frame(encode(Kind.STATUS)))
    plain.close()
    with one.client(role="watch") as person:
        assert person.stop()["stopped"]
    until(lambda: not one.hub._sessions)


def test_nothing_stands_between_a_robot_and_its_service(served, monkeypatch):
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    monkeypatch.delenv("no_proxy", raising=False)
    with served("websocket").client() as client:
        assert client.status()["trials"] == 0


def test_a_socket_of_somebody_else_stays(served, tmp_path, refused):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.bind(f"{tmp_path}/s")
        with refused("cannot listen at"):
            served()
        assert (tmp_path / "s").is_socket()


def test_a_socket_that_a_killed_service_left_is_used_again(served, tmp_path, refused):
    left = socket.socket(socket.AF_UNIX)
    left.bind(f"{tmp_path}/s")
    left.close()
    one = served()
    assert (tmp_path / "s").stat().st_mode & 0o777 == 0o600
    with refused("a service listens at"):
        SocketServer(one.hub, one.address)
    with one.client() as client:
        assert client.status()["phase"] in ("ready", "learning")


def test_nobody_at_an_address_is_one_line(refused, tmp_path):
    nowhere = ("127.0.0.1:1", "a..b:1", "ws://127.0.0.1:1", "ws://", "ws://a:b", "ws://a:99999")
    for address in (f"unix:{tmp_path}/none", *nowhere):
        with refused("nobody answers at"):
            RobotClient(address, SECRET)


def test_a_robot_is_safe_when_the_service_is_gone(served, scripted):
    one = served()
    robot = one.client()
    robot.start()
    scripted.answer = np.array([3.0])
    assert robot.ask(UPRIGHT).action == (3.0,)
    one.server.close()
    assert robot.poll().action == (0.0,)
    for _ in range(3):
        command = robot.ask(UPRIGHT)
        assert (command.action, command.in_trial) == ((0.0,), False)
    with pytest.raises(MisstepError, match="no answer"):
        robot.start()
    robot.close()
    until(lambda: one.service.phase is Phase.READY)


def test_an_answer_that_comes_too_late_is_not_taken_for_the_next(served, scripted):
    one = served()
    with one.client(patience=0.05) as robot:
        robot.start()
        gate = threading.Event()
        scripted.answer, scripted.before = np.array([3.0]), gate.wait
        late = robot.ask(UPRIGHT)
        assert (late.action, late.reason) == ((0.0,), Reason.SILENT | Reason.WATCHDOG)
        gate.set()
        robot._patience = 30.0
        scripted.answer = np.array([4.0])
        command = robot.ask((0.1, 0.0, 0.0, 0.0))
        assert (command.action, command.sequence) == ((4.0,), 2)


def test_a_client_for_whom_there_is_no_thread_is_let_go_and_the_next_one_let_in(
    served, monkeypatch
):
    one, start, refused = served("unix"), threading.Thread.start, []

    def start_or_refuse(thread):
        if threading.current_thread().name == "listener" and not refused:
            refused.append(thread)
            raise RuntimeError("can't start new thread")  # as without memory
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_or_refuse)
    with pytest.raises(MisstepError):
        one.client()
    assert len(refused) == 1
    one.client().close()


# A robot that learn drives


@pytest.fixture
def offered(short, tmp_path, monkeypatch):
    monkeypatch.setenv(TOKEN, SECRET)
    hub = SystemHub(short, SECRET, watchdog=60.0)
    server = SocketServer(hub, f"unix:{tmp_path}/robot")
    yield server.address
    server.close()
    hub.close()


def test_learn_drives_a_robot_as_it_drives_a_simulation(short, demonstrations, offered):
    within = learn(short, demonstrations, "fall", **OPTIONS)
    robot = RemoteSystem(address=offered)
    run = learn(robot, demonstrations, "fall", **OPTIONS)
    robot.close()
    for ours, theirs in zip(run.trials, within.trials, strict=True):
        same = replace(ours.provenance, system="cartpole", parameters=short.parameters, time="")
        assert timeless([replace(ours, provenance=same)]) == timeless([theirs])
    assert run.config.system == "remote"
    rebuilt = RemoteSystem(**run.config.system_parameters)
    assert rebuilt.parameters == run.config.system_parameters


def test_a_remote_system_is_described_by_the_robot_or_by_its_parameters(short, offered, refused):
    robot = RemoteSystem(address=offered)
    for name in ("observation_columns", "action_columns", "dt"):
        assert getattr(robot, name) == getattr(short, name)
    assert robot.observation_space == short.observation_space
    assert robot.action_space == short.action_space
    described = RemoteSystem(**describe_system(short))
    assert described.parameters == {**robot.parameters, "address": ""}
    assert described.observation_space == short.observation_space
    with refused("it has no address"):
        described.reset()
    with refused("give the address of the robot, or describe it"):
        RemoteSystem()
    robot.close()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"observations": "x m, x m"}, "list distinct columns"),
        ({"low": "a"}, "low is 'a': write numbers"),
        ({"high": "1,2"}, "high is '1,2': write 1 numbers"),
        ({"observation_low": "nan,0,0,0"}, "observation_low is"),
        ({"low": "3", "high": "-3"}, "low is '3' and high is '-3': write the smaller first"),
    ],
)
def test_a_description_that_is_none_is_refused(short, refused, wrong, message):
    with refused(message):
        RemoteSystem(**{**describe_system(short), **wrong})


class Watched:
    """A cart-pole that tells which actions it was given."""

    def __init__(self, system):
        self._system, self.actions = system, []

    def __getattr__(self, name):
        return getattr(self._system, name)

    def step(self, action):
        self.actions.append(float(action[0]))
        return self._system.step(action)


def test_a_robot_that_is_left_alone_goes_to_its_safe_action(monkeypatch, tmp_path):
    monkeypatch.setenv(TOKEN, SECRET)
    system = Watched(make_system("cartpole", stop_at_fall=False))
    limits = Limits.of(system, rate=100.0, safe=-1.0)
    clock = Clock()
    hub = SystemHub(system, SECRET, limits=limits, watchdog=0.3, clock=clock)
    server = SocketServer(hub, f"unix:{tmp_path}/robot")
    robot = RemoteSystem(address=server.address)
    robot.reset(seed=1)
    for _ in range(4):
        robot.step(np.array([9.0]))
    assert system.actions == pytest.approx([1.0, 3.0, 5.0, 7.0])
    clock.now += 0.4  # the watchdog
    until(lambda: system.actions[-1] == -1.0)
    assert system.actions[4:] == pytest.approx([5.0, 3.0, 1.0, -1.0])
    with pytest.raises(MisstepError, match="no episode is running"):
        robot.step(np.array([9.0]))
    robot.reset(seed=1)
    robot.step(np.array([9.0]))
    robot.close()  # the other side is gone
    until(lambda: len(system.actions) == 10)
    assert system.actions[8:] == pytest.approx([1.0, -1.0])
    robot.reset(seed=1)
    robot.step(np.array([9.0]))
    with pytest.raises(MisstepError, match="finite numbers are wanted"):
        robot.step(np.array([math.nan]))
    assert system.actions[-1] == pytest.approx(-1.0)
    server.close()
    hub.close()


class Fragile(Watched):
    """One that fails once."""

    def step(self, action):
        if len(self.actions) == 2:
            self.actions.append(math.nan)
            raise ZeroDivisionError("the motor")
        return super().step(action)


def test_a_robot_that_fails_on_its_way_is_watched_in_the_next_episode_too():
    system, clock = Fragile(make_system("cartpole", stop_at_fall=False)), Clock()
    hub = SystemHub(system, SECRET, watchdog=0.3, clock=clock)
    for n_steps in (2, 3):
        hub.reset(1)
        while len(system.actions) < n_steps:
            hub.step((9.0,))
        if n_steps == 3:
            hub.step((9.0,))
        clock.now += 0.4
        until(lambda: not hub._in_episode)
    hub.close()
    assert system.actions[-2:] == [9.0, 0.0]


def test_the_next_client_drives_as_soon_as_the_one_before_is_gone(offered):
    first = RemoteSystem(address=offered)
    with pytest.raises(MisstepError, match="another client drives"):
        RemoteSystem(address=offered)
    leaving = threading.Timer(0.2, first.close)
    leaving.start()
    second = RemoteSystem(address=offered)  # comes while the first is still there
    leaving.join()
    second.reset(seed=1)
    second.close()


def test_there_is_an_end_to_the_clients_of_a_robot(short, tmp_path):
    hub = SystemHub(short, SECRET)
    server = SocketServer(hub, f"unix:{tmp_path}/robot")
    links = [open_link(server.address, 5.0) for _ in range(MOST_CLIENTS)]
    until(lambda: len(hub._sessions) == MOST_CLIENTS)
    links.append(open_link(server.address, 5.0))
    assert f"{MOST_CLIENTS} clients already" in decode(links[-1].receive(5.0))["error"]
    for link in links:
        link.close()
    until(lambda: not hub._sessions)
    server.close()
    hub.close()


def test_a_robot_is_no_service_and_a_service_no_robot(served, offered, refused, monkeypatch):
    with refused("a robot answers, and no exploration service"):
        RobotClient(offered, SECRET)
    monkeypatch.setenv(TOKEN, SECRET)
    with refused("an exploration service answers, and no robot"):
        RemoteSystem(address=served("tcp").address)


class Babbler:
    """A robot that answers a HELLO, and then sends what nobody reads."""

    def __init__(self, description):
        self.description, self.send, self.n_clients = description, None, 0

    def open(self, send):
        self.send = send
        self.n_clients += 1
        return self

    def receive(self, message):
        is_hello = kind_of(message) == Kind.HELLO
        self.send(encode(Kind.WELCOME, self.description) if is_hello else bytes(LONGEST + 1))
        return True

    def close(self):
        pass


def test_a_robot_that_says_too_much_is_connected_to_anew(short, refused, tmp_path):
    babbler = Babbler(describe_system(short))
    server = SocketServer(babbler, f"unix:{tmp_path}/robot")
    robot = RemoteSystem(address=server.address)
    for n_clients in (1, 2):
        with refused("at most"):
            robot.reset(seed=1)
        assert babbler.n_clients == n_clients
    server.close()


# Commands


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("demonstrate", "cartpole", "--by", "weak", "-n", "3", "--set", "duration=1")
    assert main([*words, "--out", "D.h5"]) == 0
    return tmp_path


PROGRAM = "import sys; from misstep.cli import main; sys.exit(main())"
SERVE = ("serve", "RUN", "--from", "D.h5", "--system", "cartpole", "--learner", "mean")


def test_serve_and_drive_make_a_run_and_explain_reads_its_log(recorded, capfd, monkeypatch):
    monkeypatch.setenv(TOKEN, SECRET)
    serving = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *SERVE, "--state", "theta,theta_dot", "--max-trials", "2",
         "--socket", "unix:s", "--simulated-time", "--rate-limit", "500", "--json", "serve.json",
         "--watchdog-ms", "10000"],
    )  # fmt: skip
    until(lambda: (recorded / "s").exists() or serving.poll() is not None)
    words = ("drive", "cartpole", "--set", "duration=1", "--address", "unix:s")
    assert main([*words, "--json", "drive.json"]) == serving.wait(60.0)
    assert "listening at unix:s" in capfd.readouterr().out
    served = json.loads((recorded / "serve.json").read_text())
    run = load_run(recorded / "RUN")
    assert served["outcomes"] == [str(trial.outcome) for trial in run.trials]
    assert served["trials"] == len(run.trials) >= 1
    assert all(np.abs(np.diff(t.actions[:, 0])).max() <= 10.0 + 1e-9 for t in run.trials)
    log = recorded / "RUN" / "actions" / "0000.log"
    assert main(["explain", str(log), "--json", "explain.json"]) == 0
    explained = json.loads((recorded / "explain.json").read_text())
    assert explained["reasons"]["policy"] == sum(trial.n_steps for trial in run.trials)
    assert "sent" in capfd.readouterr().out
    assert not (recorded / "s").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("serve", "NONE"), "NONE is not a run folder"),
        (("serve", "NONE", "--state", "x"), "--state is for a new run"),
        (("serve", "RUN", "--from", "D.h5"), "give --system"),
        ((*SERVE, "--rate-limit", "a"), "--rate-limit 'a': write a number"),
        ((*SERVE, "--safe", "99"), "the safe action is 99"),
        ((*SERVE, "--range", "x=1"), "--range 'x=1': write name=low:high"),
        ((*SERVE, "--watchdog-ms", "0"), "watchdog is 0 s but must be greater than 0 s"),
        ((*SERVE, "--socket", "nowhere"), "neither host:port"),
        ((*SERVE, "--duration", "0.001"), "shorter than one control period"),
        (("explain", "D.h5"), "is not a log"),
    ],
)
def test_what_cannot_be_served_is_refused_and_leaves_nothing(recorded, capsys, words, message):
    before = sorted(recorded.rglob("*"))
    assert main(list(words)) == 2
    assert message in capsys.readouterr().err
    assert sorted(recorded.rglob("*")) == before


def test_remote_is_a_system_that_the_registry_can_be_told_of(
    tmp_path, monkeypatch, offered, short, demonstrations
):
    told = tmp_path / "told-1.dist-info"
    told.mkdir()
    (told / "METADATA").write_text("Metadata-Version: 2.1\nName: told\nVersion: 1\n")
    point = "remote = misstep.robot.remote_system:RemoteSystem"
    (told / "entry_points.txt").write_text(f"[misstep.systems]\n{point}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert SYSTEMS["remote"] is RemoteSystem
    robot = make_system("remote", address=offered)
    run = learn(robot, demonstrations, "mean", **OPTIONS, out=tmp_path / "run")
    robot.close()
    assert timeless(load_run(tmp_path / "run").trials) == timeless(run.trials)
