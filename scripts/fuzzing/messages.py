"""Messages: what robots and pages say to the services, handed to the decoders and through sockets.

A case of a conversation is a few messages, most of them damaged. The service behind it stays up
for many cases; after each one it has to answer a plain question.
"""

import json
import math
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.random import Generator
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from fuzzing.cases import Attempt, Case, Target
from fuzzing.damage import (
    a_few,
    damaged,
    damaged_json,
    damaged_text,
    damaged_value,
    hostile_value,
    one_of,
)
from fuzzing.workers import die_with_parent
from misstep import demonstrate, learn, make_system
from misstep.errors import MisstepError
from misstep.live.protocol import KINDS, parse
from misstep.robot import protocol
from misstep.robot.frames import FrameStream
from misstep.robot.guard import Command, Guard, Safety, State
from misstep.robot.limits import Limits
from misstep.robot.protocol import Kind, Observed
from misstep.robot.service import ExplorationService
from misstep.robot.session import Hub
from misstep.robot.socket_server import SocketServer
from misstep.robot.websocket_server import WebSocketServer

_TOKEN = "a secret of this test"  # noqa: S105
_HELLO = {"token": _TOKEN, "role": "drive", "name": "a robot", "version": protocol.VERSION}
_NASTY = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0, -0.0, 1.0)
_LEAVING = 0.2  # s, that a client which has not read everything waits for a goodbye
_ROOM = 2**16  # bytes that a socket takes before anybody reads
_PATIENCE = 300.0  # s; the machine may do other things, too

# What a robot says


def _number(rng: Generator) -> float:
    return one_of(rng, _NASTY) if rng.random() < 0.2 else float(rng.normal())


def _state(rng: Generator, sequence: int) -> State:
    count = 4 if rng.random() < 0.8 else int(rng.integers(9))
    return State(
        sequence if rng.random() < 0.8 else one_of(rng, (0, -1, 2**63 - 1, -(2**63))),
        0.02 * sequence if rng.random() < 0.8 else _number(rng),
        tuple(_number(rng) if rng.random() < 0.3 else 0.01 for _ in range(count)),
        None if rng.random() < 0.5 else _number(rng),
        bool(rng.random() < 0.05),
        bool(rng.random() < 0.05),
        bool(rng.random() < 0.05),
    )


def robot_message(rng: Generator, sequence: int) -> bytes:
    """Return a message as a robot or a service sends it, damaged or not."""
    makers: tuple[Callable[[], bytes], ...] = (
        lambda: protocol.encode_state(_state(rng, sequence)),
        lambda: protocol.encode_state(_state(rng, sequence)),
        lambda: protocol.encode_state(_state(rng, sequence)),
        lambda: protocol.encode(Kind.START),
        lambda: _json_message(rng, Kind.HELLO, _HELLO),
        lambda: _json_message(rng, Kind.MARK, {"outcome": "failure"}),
        lambda: _json_message(rng, Kind.RESET, {"seed": 7}),
        lambda: protocol.encode(one_of(rng, (Kind.STOP, Kind.CLEAR, Kind.STATUS))),
        lambda: protocol.encode_action((_number(rng),)),
        lambda: protocol.encode_command(Command((1.0,), (2.0,), 3, sequence, 5)),
        lambda: protocol.encode_observed(
            Observed((_number(rng),), _number(rng), False, True, False, True, False)
        ),
    )
    message = one_of(rng, makers)()
    return damaged(rng, message) if rng.random() < 0.5 else message


def _json_message(rng: Generator, kind: Kind, body: dict[str, Any]) -> bytes:
    text = damaged_json(rng, json.dumps(body)) if rng.random() < 0.7 else json.dumps(body)
    return bytes([kind]) + text.encode("utf-8", "replace")


_DECODERS: dict[int, Callable[[bytes], Any]] = {
    Kind.STATE: protocol.decode_state,
    Kind.COMMAND: protocol.decode_command,
    Kind.STEP: protocol.decode_action,
    Kind.OBSERVED: protocol.decode_observed,
}


def _limits() -> Limits:
    return Limits.of(make_system("cartpole"), rate=100.0, jerk=1000.0)


def _check_command(command: Command, limits: Limits) -> None:
    """Whatever came, what leaves is finite and within the limits."""
    for row in (command.action, command.intended):
        if not all(a <= x <= b for x, a, b in zip(row, limits.low, limits.high, strict=True)):
            raise ArithmeticError(f"{row} is sent")


def _open_codec(folder: Path) -> Attempt:
    limits = _limits()

    def attempt(case: Case) -> bool:
        rng = case.rng
        guard, now, refused = Guard(limits, Safety()), 0.0, 0
        guard.begin(now)
        for number in range(a_few(rng)):
            message = robot_message(rng, number)
            case.given[f"{number}.message"] = message
            now += one_of(rng, (0.02, 0.02, 0.0, -1.0, 1e6))
            try:
                decode = _DECODERS.get(protocol.kind_of(message), protocol.decode)
                decoded = decode(message)
            except MisstepError:
                refused += 1
                continue
            if isinstance(decoded, State) and guard.check(decoded, now) is None:
                _check_command(guard.send((_finite(rng),), now, now), limits)
            _check_command(guard.keep_on(now), limits)
        return refused == 0

    return attempt


def _finite(rng: Generator) -> float:
    value = _number(rng)
    return value if math.isfinite(value) else 0.0


def _open_frames(folder: Path) -> Attempt:
    """Open a pair of sockets for each case: frames arrive in pieces, and lie about their length."""

    def attempt(case: Case) -> bool:
        rng = case.rng
        messages = [robot_message(rng, number) for number in range(a_few(rng))]
        data = b"".join(struct.pack("<I", len(each)) + each for each in messages)
        if rng.random() < 0.8:
            data = damaged(rng, data)[:_ROOM]
        case.given = {"stream": data}
        here, there = socket.socketpair()
        with here, there:
            stream = FrameStream(there)
            for start in range(0, len(data), 700):
                here.sendall(data[start : start + 700])
            here.shutdown(socket.SHUT_WR)
            while (message := stream.receive()) is not None:
                if len(message) > protocol.LONGEST:
                    raise ArithmeticError("a message is too long")
        return True

    return attempt


class _Service:
    """A service that drives with a policy that was learned, and learns no more."""

    def __init__(self) -> None:
        system = make_system("cartpole", duration=2.0)
        shown = demonstrate(make_system("cartpole"), by="weak", n=2, seed=0)
        run = learn(system, shown, "mean", state=("theta", "theta_dot"), max_trials=1)
        safety = Safety(watchdog=30.0, deadline=30.0)
        self.service = ExplorationService(run, system=system, safety=safety, learning=False)
        self.hub = Hub(self.service, _TOKEN)

    def ready(self) -> None:
        self.service.clear("the test")
        if not self.service.wait(_PATIENCE):
            raise TimeoutError("the service does not get ready")


def _open_session(folder: Path) -> Attempt:
    served = _Service()
    limits = served.service.limits

    def attempt(case: Case) -> bool:
        rng = case.rng
        served.ready()
        said: list[bytes] = []
        session = served.hub.open(said.append)
        messages = [protocol.encode(Kind.HELLO, _HELLO)] if rng.random() < 0.8 else []
        messages += [protocol.encode(Kind.START)] if rng.random() < 0.5 else []
        messages += [robot_message(rng, number) for number in range(2 * a_few(rng))]
        case.given = {f"{i}.message": message for i, message in enumerate(messages)}
        for message in messages:
            if not session.receive(message):
                break
        session.close()
        for answer in said:
            if protocol.kind_of(answer) == Kind.COMMAND:
                _check_command(protocol.decode_command(answer), limits)
            else:
                protocol.decode(answer)
        return all(protocol.kind_of(answer) != Kind.REFUSED for answer in said)

    return attempt


def _open_sockets(folder: Path) -> Attempt:
    served = _Service()
    unix = SocketServer(served.hub, f"unix:{folder}/s")
    web = WebSocketServer(served.hub, "127.0.0.1:0")
    place = str(folder / "s")

    def attempt(case: Case) -> bool:
        rng = case.rng
        served.ready()
        messages = [protocol.encode(Kind.HELLO, _HELLO)] if rng.random() < 0.8 else []
        messages += [robot_message(rng, number) for number in range(2 * a_few(rng))]
        data = b"".join(struct.pack("<I", len(each)) + each for each in messages)
        case.given = {"stream": data}
        if rng.random() < 0.3:
            _talk_web(rng, web.address, messages)
        else:
            _send_all(place, damaged(rng, data) if rng.random() < 0.4 else data)
        return _is_welcome(place)

    attempt.servers = (unix, web)  # type: ignore[attr-defined] # for as long as it is in use
    return attempt


def _send_all(place: str, data: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(_PATIENCE)
        client.connect(place)
        try:
            client.sendall(data)
            client.shutdown(socket.SHUT_WR)
            while client.recv(4096):
                pass
        except ConnectionError:
            return  # it does not listen to that any longer


def _talk_web(rng: Generator, address: str, messages: list[bytes]) -> None:
    try:
        with connect(address, open_timeout=_PATIENCE, close_timeout=_LEAVING) as client:
            for message in messages:
                client.send(message if rng.random() < 0.95 else message.decode("latin-1"))
            if rng.random() < 0.3:
                client.socket.sendall(rng.bytes(40))  # frames that are none
    except (WebSocketException, OSError):
        return


def _is_welcome(place: str) -> bool:
    """Whether a plain client is answered, as it has to be whatever others said."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(_PATIENCE)
        client.connect(place)
        stream = FrameStream(client)
        stream.send(protocol.encode(Kind.HELLO, {**_HELLO, "role": "watch"}))
        answer = stream.receive()
    if answer is None or protocol.kind_of(answer) != Kind.WELCOME:
        raise ConnectionError(f"a plain client is answered {answer!r}")
    return True


# What a page says

_PAGE_MESSAGES: tuple[dict[str, Any], ...] = (
    {"t": "input", "v": [0.5, -1.0], "n": 7},
    {
        "t": "settings",
        "strength": 0.5,
        "speed": 1.0,
        "start_angle": 3.0,
        "countdown": 0,
    },
    {"t": "system", "name": "cartpole"},
    {"t": "mark", "id": 0, "outcome": "failure", "failure_time": 0.5, "usable": [0.0, 0.4]},
    {"t": "delete", "id": 0},
    {"t": "learn", "learner": "x", "state": ["theta"], "max_trials": 3, "seed": 1},
    {"t": "open_run", "name": "../../etc"},
    {"t": "resume_run", "name": "x"},
    {"t": "next", "trial": 1},
    {"t": "push", "x": None},
    {"t": "poke", "side": 1.0},
    {"t": "hidden", "hidden": False},
    {"t": "pace", "watch": True},
    *({"t": kind} for kind in KINDS if not KINDS[kind]),
)
_PAGE_WORDS = (*KINDS, "theta", "cartpole", "failure", "t", "name", "id")


def page_message(rng: Generator) -> str:
    """Return a message as the page sends it, damaged or not."""
    message = one_of(rng, _PAGE_MESSAGES)
    what = rng.random()
    if what < 0.25:
        return json.dumps(message)
    if what < 0.75:
        return json.dumps(damaged_value(rng, message, _PAGE_WORDS))
    return damaged_text(rng, json.dumps(message), _PAGE_WORDS)


def _open_page(folder: Path) -> Attempt:
    def attempt(case: Case) -> bool:
        rng = case.rng
        raw: str | bytes = page_message(rng)
        if rng.random() < 0.2:
            raw = damaged(rng, raw.encode("utf-8", "replace"))
        case.given = {"message": raw}
        parse(raw)
        return True

    return attempt


class _LiveServer:
    """`misstep live` in a process of its own that ends with this one."""

    def __init__(self, folder: Path) -> None:
        told = folder / "live.json"
        arguments = ["live", "--no-browser", "--port", "0", "--data", str(folder / "data")]
        start = "import sys; from misstep.cli import main; sys.exit(main())"
        self.process = subprocess.Popen(  # noqa: S603 - our own words
            [sys.executable, "-c", start, *arguments, "--json", str(told)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=die_with_parent,
        )
        deadline = time.monotonic() + 4 * _PATIENCE
        while not told.exists():
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError("the live server does not start")
            time.sleep(0.05)
        url = json.loads(told.read_text())["url"]
        self.host, self.token = url.split("/")[2:4]
        self.address = self.host.split(":")[0], int(self.host.split(":")[1])

    def page(self) -> Any:
        """Connect as the page does."""
        return connect(
            f"ws://{self.host}/{self.token}/socket",
            origin=f"http://{self.host}",  # type: ignore[arg-type]
            open_timeout=_PATIENCE,
            close_timeout=_LEAVING,
            max_size=2**24,
        )

    def ask(self, request: bytes) -> bytes:
        """Send bytes as a request, and return the answer's first kilobytes."""
        with socket.create_connection(self.address, timeout=_PATIENCE) as client:
            try:
                client.sendall(request)
                client.shutdown(socket.SHUT_WR)
                return client.recv(4096)
            except ConnectionError:
                return b""

    def check(self) -> None:
        """Make sure that it is there, and small."""
        path = f"/{self.token}/api/formats"
        answer = self.ask(self.request("GET", path))
        if not answer.startswith(b"HTTP/1.1 200"):
            raise ConnectionError(f"the server answers a plain request with {answer[:80]!r}")
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        (peak,) = (int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
        if peak > 2**21:  # KiB
            raise MemoryError(f"the server takes {peak} KiB")

    def request(self, method: str, path: str, body: bytes = b"") -> bytes:
        """Return a request as a browser sends it."""
        head = f"{method} {path} HTTP/1.1\r\nHost: {self.host}\r\nOrigin: http://{self.host}\r\n"
        head += f"Connection: close\r\nContent-Length: {len(body)}\r\n\r\n"
        return head.encode("utf-8", "replace") + body


_PATHS = (
    "",
    "page/app.js",
    "page/../../../etc/passwd",
    "page/%2e%2e%2f%2e%2e%2fetc/passwd",
    "api/attempt/0",
    "api/attempt/-1",
    "api/attempt/99999999999999999999999",
    "api/run/0/demonstrations",
    "api/run/0/1",
    "api/download/csv",
    "api/download/csv?id=0",
    "api/download/..%2f..%2fetc",
    "api/download-run/..",
    "api/download-run/%2e%2e%2f%2e%2e",
    "api/replay",
    "socket",
)


def _open_live(folder: Path) -> Attempt:
    server = _LiveServer(folder)

    def attempt(case: Case) -> bool:
        rng = case.rng
        answered = _browse(case, server) if rng.random() < 0.5 else _converse(case, server)
        server.check()
        return answered

    return attempt


def _browse(case: Case, server: _LiveServer) -> bool:
    rng = case.rng
    path = f"/{server.token}/{one_of(rng, _PATHS)}"
    if rng.random() < 0.15:
        name = one_of(rng, ("a.csv", "../a.csv", "/etc/passwd", "a.csv\0.h5", "x" * 500 + ".csv"))
        body = damaged(rng, b"x,F\n1,2\n3,4\n" * 3)
        request = server.request("PUT", f"/{server.token}/api/upload?name={name}", body)
    else:
        path = (
            damaged_text(rng, path, ("..", "/", "%2f", "%00", "?", "&"))
            if rng.random() < 0.5
            else path
        )
        request = server.request(one_of(rng, ("GET", "GET", "PUT", "POST", "HEAD")), path)
    if rng.random() < 0.3:
        request = damaged(rng, request)
    case.given = {"request": request}
    answer = server.ask(request)
    if answer.startswith(b"HTTP/1.1 5") or b"Traceback" in answer or b"root:x:" in answer:
        raise ConnectionError(f"the server answers {answer[:300]!r}")
    return answer.startswith(b"HTTP/1.1 2")


def _converse(case: Case, server: _LiveServer) -> bool:
    rng = case.rng
    messages = [page_message(rng) for _ in range(2 * a_few(rng))]
    # Learning and driving take their time; how they go is for other tests.
    messages = [m for m in messages if '"learn"' not in m or hostile_value(rng) is None]
    case.given = {f"{i}.message": message for i, message in enumerate(messages)}
    try:
        with server.page() as page:
            for message in ['{"t": "take"}', *messages]:
                page.send(message.encode("utf-8", "replace").decode())
            page.send('{"t": "take"}')
            return "hello" in page.recv(timeout=_PATIENCE)
    except WebSocketException:
        return False  # it does not listen to that any longer


TARGETS = (
    Target("robot-codec", 100_000, _open_codec),
    Target("robot-frames", 50_000, _open_frames),
    Target("robot-session", 30_000, _open_session),
    Target("robot-sockets", 5_000, _open_sockets),
    Target("live-messages", 100_000, _open_page),
    Target("live-server", 5_000, _open_live),
)
