"""Commands that start in a millisecond: a process that has everything loaded forks one for each.

A command of misstep loads for one to three seconds and works for less on a tiny job. The nursery
loads once; a child of it calls the real command line. The signals, the disk and the limits are
real. What a fork leaves out, the start of the interpreter, the imports and the taking apart of all
modules in the end, is had with ``cold``: then the child runs Python anew.

Run as a program it is the nursery; `Nursery` is the other end. One command at a time.
"""

import atexit
import gc
import json
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from misstep.robot.addresses import TOKEN

_PROGRAM = "import sys; from misstep.cli import main; sys.exit(main())"
_LOADED = (
    "misstep.bench.run",
    "misstep.cli.app",
    "misstep.formats.lerobot",
    "misstep.learning",
    "misstep.live.jobs",
    "misstep.live.server",
    "misstep.recordings.pipeline",
    "misstep.robot.socket_server",
    "misstep.robot.websocket_server",
    "misstep.study.run",
    "matplotlib.pyplot",
    "pyarrow.parquet",
    "rich.console",
    "rich.table",
)
SECRET = "crash"  # noqa: S105 - of a service that lives for a second
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH, _PR_CAPBSET_DROP = 1, 2, 24


class Nursery:
    """A nursery in a process of its own."""

    def __init__(self) -> None:
        # One thread, or a fork would be of one that holds locks of others.
        self._process = subprocess.Popen(  # noqa: S603 - our own program
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD, TOKEN: SECRET},
            start_new_session=True,
        )
        self._read()

    def start(self, words: Sequence[str], folder: Path, said: Path, *, cold: bool) -> "Child":
        """Start a command in a folder; what it prints goes to the files ``said.out``, ``.err``."""
        for stream in ("out", "err"):
            Path(f"{said}.{stream}").write_bytes(b"")  # a child can be killed before it opens them
        request = {"words": list(words), "folder": str(folder), "said": str(said), "cold": cold}
        assert self._process.stdin is not None  # noqa: S101 - it is a pipe
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        return Child(self, int(self._read()["pid"]), said)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()

    def _read(self, timeout: float | None = None) -> dict[str, Any]:
        assert self._process.stdout is not None  # noqa: S101 - it is a pipe
        if not select.select([self._process.stdout], [], [], timeout)[0]:
            return {}
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the nursery has ended")
        answer: dict[str, Any] = json.loads(line)
        return answer


class Child:
    """A command that was started."""

    def __init__(self, nursery: Nursery, pid: int, said: Path) -> None:
        self._nursery, self.pid, self._said = nursery, pid, said
        self.code: int | None = None
        """How it ended: its exit code, or a signal's number with a minus."""

    def wait(self, timeout: float) -> bool:
        """Wait for its end; return whether it has ended after so many seconds at the most."""
        if self.code is None:
            answer = self._nursery._read(max(0.0, timeout))
            self.code = answer.get("code")
        return self.code is not None

    @property
    def out(self) -> str:
        """What it has printed."""
        return Path(f"{self._said}.out").read_text(errors="replace")

    @property
    def err(self) -> str:
        """What it has printed on stderr."""
        return Path(f"{self._said}.err").read_text(errors="replace")

    def has_begun(self) -> bool:
        """Return whether misstep is at work: before, Python is still starting and importing it."""
        if self.code is not None:
            return True
        status = Path(f"/proc/{self.pid}/status").read_text()
        caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
        return bool(int(caught.split()[1], 16) >> signal.SIGTERM - 1 & 1)

    def processes(self) -> list[int]:
        """Return the command's own process and those that it has started."""
        found = []
        for entry in os.scandir("/proc"):
            if entry.name.isdigit():
                try:
                    if os.getpgid(int(entry.name)) == self.pid and _is_alive(int(entry.name)):
                        found.append(int(entry.name))
                except (ProcessLookupError, FileNotFoundError):
                    continue
        return found

    def bury(self) -> None:
        """End whatever is left of it."""
        for pid in self.processes():
            os.kill(pid, signal.SIGKILL)
        self.wait(60.0)


def _is_alive(pid: int) -> bool:
    """Return whether a process has not just ended, unnoticed by whoever started it."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


def _serve() -> list[str]:
    """Fork a child for each request; return in the child alone, with its words."""
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    requests = os.fdopen(os.dup(0), "rb", buffering=0)
    answers.write(b"{}\n")
    while line := requests.readline():
        request = json.loads(line)
        pid = os.fork()
        if pid == 0:
            answers.close()
            requests.close()
            return _begin(request)
        os.setpgid(pid, pid)
        answers.write(json.dumps({"pid": pid}).encode() + b"\n")
        _, status = os.waitpid(pid, 0)
        answers.write(json.dumps({"code": os.waitstatus_to_exitcode(status)}).encode() + b"\n")
    os._exit(0)


def _begin(request: dict[str, Any]) -> list[str]:
    """Make the child what a command is that a shell has started."""
    os.chdir(request["folder"])
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    for number, path in enumerate((os.devnull, f"{request['said']}.out", f"{request['said']}.err")):
        file = os.open(path, flags if number else os.O_RDONLY, 0o644)
        os.dup2(file, number)
        os.close(file)
    if request["cold"]:
        os.execv(sys.executable, [sys.executable, "-c", _PROGRAM, *request["words"]])  # noqa: S606
    return ["misstep", *request["words"]]


def _exit(code: int) -> NoReturn:
    """End as Python does, but for taking apart all modules, which takes half a second."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _load() -> None:
    """Import what commands import, and learn a little, so that compiled code is there."""
    from importlib import import_module

    for name in _LOADED:
        import_module(name)
    import misstep

    system = misstep.make_system("cartpole", duration=0.5)
    shown = misstep.demonstrate(system, by="weak", n=3)
    for learner in ("donut", "random-linear", "fall"):
        misstep.learn(system, shown, learner, state=("theta", "theta_dot"), max_trials=2)


def _give_up_overriding() -> None:
    """Have the rights of a file hold for root too; for anybody else they hold anyway."""
    if os.geteuid() != 0:
        return
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    data = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable; low and high 32 bits
    given_up = 1 << _CAP_DAC_OVERRIDE | 1 << _CAP_DAC_READ_SEARCH
    for capability in (_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH):
        libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)
    libc.capget(header, data)
    for place in range(3):
        data[place] &= ~given_up
    if libc.capset(header, data) != 0:
        raise OSError(ctypes.get_errno(), "capset")


if __name__ == "__main__":
    # As on a terminal, however the harness itself was started.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _give_up_overriding()
    _load()
    gc.collect()
    gc.freeze()  # or the first collection in a child would copy every page
    sys.argv = _serve()
    from misstep.cli import main

    _exit(main())
