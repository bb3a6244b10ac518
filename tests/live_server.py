"""A live server in a process of its own, as `misstep live` starts it."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

_START = "import sys; from misstep.cli import main; sys.exit(main())"
_PATIENCE = 120.0  # s; on a busy machine the physics alone take many to load


class LiveServer:
    """`misstep live` on a folder; can be stopped, killed and started again."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.folder = folder
        self.port = 0
        self.arguments = arguments
        self.process: subprocess.Popen[str] | None = None
        self.start()

    def start(self) -> None:
        told = self.folder.parent / "live.json"
        told.unlink(missing_ok=True)
        command = ["live", "--no-browser", "--port", str(self.port), "--data", str(self.folder)]
        self.process = subprocess.Popen(
            [sys.executable, "-c", _START, *command, "--json", str(told), *self.arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        deadline = time.monotonic() + _PATIENCE
        while not told.exists():
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"the server did not start: {self.process.communicate()[1]}")
            time.sleep(0.05)
        self.url = json.loads(told.read_text())["url"]
        self.port = int(self.url.split("/")[2].split(":")[1])

    @property
    def token(self) -> str:
        return self.url.split("/")[3]

    def stop(self, how: int = signal.SIGINT) -> tuple[int, str]:
        """Stop it, and return its exit code and what it said on stderr."""
        assert self.process is not None
        self.process.send_signal(how)
        _, said = self.process.communicate(timeout=_PATIENCE)
        return self.process.returncode, said

    def kill(self) -> None:
        self.stop(signal.SIGKILL)

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.kill()
