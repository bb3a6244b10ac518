"""How long a key takes to change the screen of the live page, and how many frames a second it has.

    python scripts/measure_live.py [--speed 1] [--seconds 20]

It starts `misstep live`, opens the page in a headless Chromium (of Playwright or of the system),
puts 20 recordings on the plane, and presses keys at random moments while it drives. A key's time
runs from the browser's own time stamp of the event to the end of the drawing of the first frame
that shows a state computed with it: the way to the server, the wait for the next tick of its
physics, the way back, and the wait for the next frame of the screen are all in it.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

from misstep import demonstrate, make_system, save_dataset

_SPEEDS = [0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.5]
_START = "import sys; from misstep.cli import main; sys.exit(main())"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--speed", type=float, default=1.0, choices=_SPEEDS)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--recordings", type=int, default=20)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--size", default="1280x720")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "live.json"
        command = ["live", "--no-browser", "--port", "0", "--data", f"{folder}/data"]
        arguments = [sys.executable, "-c", _START, *command, "--json", str(told)]
        server = subprocess.Popen(arguments)  # noqa: S603 - our own command
        try:
            while not told.exists():
                if server.poll() is not None:
                    sys.exit(f"the page has ended with {server.returncode}")
                time.sleep(0.1)
            _measure(json.loads(told.read_text())["url"], Path(folder), asked)
        finally:
            server.terminate()
            server.wait()


def _measure(url: str, folder: Path, asked: argparse.Namespace) -> None:
    width, height = map(int, asked.size.split("x"))
    recordings = folder / "recordings.h5"
    save_dataset(demonstrate(make_system("cartpole"), by="weak", n=asked.recordings), recordings)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=asked.chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(url)
        page.set_input_files("#file", recordings)
        page.locator("#attempts li .n").nth(asked.recordings - 1).wait_for()
        for name, value in (("speed", _SPEEDS.index(asked.speed)), ("countdown", 0)):
            page.locator(f"#{name}").evaluate(
                f"e => {{ e.value = {value}; e.dispatchEvent(new Event('input')) }}"
            )
        page.wait_for_timeout(3000)
        page.evaluate("misstep.frames.length = 0")
        _drive(page, asked.seconds)
        found = page.evaluate("({latencies: misstep.latencies, frames: misstep.frames})")
        _tell("key down to changed state on screen", found["latencies"], "ms")
        _tell("frame to frame", found["frames"], "ms")
        print(page.locator("#late").inner_text())
        browser.close()


def _drive(page: Page, seconds: float) -> None:
    """Press keys at random moments, starting again after each fall."""
    rng = random.Random(0)  # noqa: S311 - when keys are pressed is no secret
    end = time.monotonic() + seconds
    side = 0
    while time.monotonic() < end:
        if page.locator("#keep, #begin").count():
            page.keyboard.press("r")
            page.wait_for_timeout(100)
        side = 1 - side
        key = ("ArrowLeft", "ArrowRight")[side]
        page.keyboard.down(key)
        page.wait_for_timeout(rng.uniform(60, 160))
        page.keyboard.up(key)
        page.wait_for_timeout(rng.uniform(20, 90))


def _tell(what: str, values: list[float], unit: str) -> None:
    median, most = np.quantile(values, [0.5, 0.95])
    print(f"{what}: median {median:.1f} {unit}, 95 % {most:.1f} {unit} ({len(values)} of them)")


if __name__ == "__main__":
    main()
