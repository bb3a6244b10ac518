"""How long the exploration service takes to answer, beside an empty service of the same transport.

    python studies/measure_service.py                     round trips, three transports
    python studies/measure_service.py --core 0            the same, all processes on one core
    python studies/measure_service.py --minutes 10 --transports unix
                                                          1 kHz: deadline misses and memory

The empty service reads a state and answers with a constant action: the same messages over the same
server, but no policy, no guard, no judge, no recording and no log. Both are asked in turns, in
short blocks, so that a busy machine disturbs both alike; on one core nothing hangs on where the
system puts a process either.
"""

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from pathlib import Path

import numpy as np

import misstep
from misstep.robot.client import RobotClient
from misstep.robot.guard import Command, Safety
from misstep.robot.limits import Limits, Reason
from misstep.robot.protocol import Kind, decode_state, encode, encode_command, kind_of
from misstep.robot.service import ExplorationService
from misstep.robot.session import Hub
from misstep.robot.socket_server import SocketServer
from misstep.robot.websocket_server import WebSocketServer

TOKEN = "measure"  # noqa: S105 - of a service that lives for a minute
STATES = [tuple(row) for row in np.random.default_rng(0).normal(0.0, 0.05, (1000, 4)).tolist()]
BLOCK = 20
TRANSPORTS = ("unix", "tcp", "websocket")


class EmptyHub:
    """Answers every state with the same action, and does nothing else."""

    def __init__(self, description):
        self._description = description

    def open(self, send):
        """Return the conversation of a client."""
        return EmptySession(self._description, send)


class EmptySession:
    """One client's conversation with an empty service."""

    def __init__(self, description, send):
        self._description, self._send, self._n = description, send, 0

    def receive(self, message):
        """Answer a message."""
        if kind_of(message) == Kind.STATE:
            self._n += 1
            sequence = decode_state(message).sequence
            self._send(encode_command(Command((0.0,), (0.0,), Reason.POLICY, sequence, self._n)))
        else:
            self._send(encode(Kind.WELCOME, self._description))
        return True

    def close(self):
        """End the conversation."""


def serve(pipe, transport, kind, folder, options):
    """Run a service in this process until told to end, and send its status."""
    rate = options.get("rate", 50.0)
    system = misstep.make_system(
        "cartpole", duration=options["duration"], control_rate=rate, physics_step=0.001
    )
    demonstrations = misstep.demonstrate(system, by="weak", n=3, seed=0)
    run = misstep.learn(
        system,
        demonstrations,
        "fall",
        state=("theta", "theta_dot"),
        max_trials=1,
        out=Path(folder) / "run",
    )
    limits = Limits.of(system, rate=1e4, jerk=1e7)
    # Without learning: what is learned from grows with every trial, and has to.
    service = ExplorationService(
        run, system=system, limits=limits, safety=Safety(watchdog=1.0), learning=False
    )
    service.wait()
    hub = Hub(service, TOKEN) if kind == "service" else EmptyHub(service.describe())
    if transport == "websocket":
        server = WebSocketServer(hub, "127.0.0.1:0")
    else:
        server = SocketServer(hub, "127.0.0.1:0" if transport == "tcp" else f"unix:{folder}/s")
    pipe.send(server.address)
    while pipe.recv() == "status":
        pipe.send({**service.status(), "rss_mb": resident_megabytes()})
    server.close()
    if kind == "service":
        hub.close()
    service.close()


class Served:
    """A service in another process, and a client connected to it."""

    def __init__(self, transport, kind, **options):
        self._folder = tempfile.TemporaryDirectory()
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        arguments = (other, transport, kind, self._folder.name, {"duration": 600.0, **options})
        self._process = context.Process(target=serve, args=arguments)
        self._process.start()
        self.client = RobotClient(self.pipe.recv(), TOKEN, patience=5.0)

    def status(self):
        """Return the service's status and its memory."""
        self.pipe.send("status")
        return self.pipe.recv()

    def close(self):
        """End the service."""
        self.client.close()
        self.pipe.send("end")
        self._process.join()
        self._folder.cleanup()


def block(client, first):
    """Return the round trips of a block of questions, s."""
    seconds = np.empty(BLOCK)
    for i in range(BLOCK):
        started = time.perf_counter()
        client.ask(STATES[(first + i) % len(STATES)], cost=0.5)
        seconds[i] = time.perf_counter() - started
    return seconds


def round_trips(transport, blocks):
    """Return what a transport measures, in µs."""
    service, empty = Served(transport, "service"), Served(transport, "empty")
    service.client.start()
    times = {"service": [], "empty": []}
    for turn in range(blocks + 1):
        for name, served in (("service", service), ("empty", empty)):
            measured = block(served.client, turn * BLOCK)
            if turn:  # the first block warms up
                times[name].append(measured)
    status = service.status()
    service.close()
    empty.close()
    row = {"transport": transport, "in_trial": status["phase"] == "running"}
    for name, measured in times.items():
        row |= {
            f"{name}_p{q}_us": round(float(np.percentile(measured, q)) * 1e6, 1) for q in (50, 99)
        }
    ratios = [
        np.median(a) / np.median(b) for a, b in zip(times["service"], times["empty"], strict=True)
    ]
    return row | {
        "ratio": round(float(np.median(ratios)), 3),
        "states": status["states"],
        "deadline_misses": status["deadline_misses"],
    }


def soak(transport, seconds, rate=1000.0):
    """Ask at a steady rate in trials of 5 s; return what was missed, and the memory.

    An answer is missed where it came later than the next state was due. Where already the state
    was sent that late, the machine was elsewhere, and it is counted apart.
    """
    served = Served(transport, "service", duration=5.0, rate=rate)
    client, period = served.client, 1.0 / rate
    asked = missed = sent_late = trials = 0
    memory, slowest = [], 0.0
    end = time.perf_counter() + seconds
    while time.perf_counter() < end and client.start() is not None:
        trials += 1
        memory.append(served.status()["rss_mb"])
        due = time.perf_counter()
        while True:
            due += period
            time.sleep(max(0.0, due - time.perf_counter()))
            started = time.perf_counter()
            command = client.ask(STATES[asked % len(STATES)], cost=0.5)
            now = time.perf_counter()
            asked, slowest = asked + 1, max(slowest, now - started)
            if started > due + period:
                sent_late += 1
                due = now
            elif now > due + period:
                missed += 1
            if not command.in_trial:
                break
    status = served.status()
    served.close()
    return {
        "transport": transport,
        "seconds": seconds,
        "trials": trials,
        "asked": asked,
        "missed": missed,
        "states_sent_late": sent_late,
        "slowest_ms": round(slowest * 1e3, 2),
        "rss_mb_start": memory[min(2, trials - 1)],
        "rss_mb_end": status["rss_mb"],
        "rss_mb_largest": max(memory),
        "service": status,
    }


def resident_megabytes():
    """Return the memory of this process that is resident."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return round(int(line.split()[1]) / 1024, 1)
    return None


def main():
    """Measure and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--transports", nargs="+", default=TRANSPORTS, choices=TRANSPORTS)
    parser.add_argument("--blocks", type=int, default=500, help=f"of {BLOCK} questions each")
    parser.add_argument("--minutes", type=float, default=0.0, help="at 1 kHz instead")
    parser.add_argument("--core", type=int, help="let all processes run on this core")
    options = parser.parse_args()
    if options.core is not None:
        os.sched_setaffinity(0, {options.core})
    for transport in options.transports:
        if options.minutes:
            result = soak(transport, 60.0 * options.minutes)
        else:
            result = round_trips(transport, options.blocks)
        print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
