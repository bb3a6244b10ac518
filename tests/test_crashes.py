"""Killed in every way: a few kills of each kind, and whether the harness would see a loss.

`scripts/crash` makes a thousand; docs/reliability.md says what came of them.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from misstep import MisstepError
from misstep.cli.app import _explain
from misstep.cli.interruption import Terminated, interruptible
from misstep.formats.folders import exchange, write_folder
from misstep.workers import process_pool

sys.path.append(str(Path(__file__).parents[1] / "scripts" / "crash"))
from campaign import Campaign
from deaths import KILL, small_disk
from jobs import ConvertJob, LearnJob, make_sources
from nursery import Nursery
from served import ServeJob
from traces import trace


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    ground = tmp_path_factory.mktemp("crash")
    (ground / "source").mkdir()
    make_sources(ground / "source")
    return ground


@pytest.fixture(scope="module")
def campaign(ground):
    nursery = Nursery()
    with small_disk(ground / "disk") as disk:
        yield Campaign(nursery, disk, ground, seed=5)
    nursery.close()


JOBS = [(LearnJob, "random-linear"), (ConvertJob, "to a new folder"), (ServeJob, "")]


@pytest.mark.parametrize(("kind", "name"), JOBS)
def test_killed_in_every_way_nothing_is_lost_and_going_on_gives_the_same(
    campaign, ground, kind, name
):
    job = kind(name, ground / "source")
    campaign.rehearse(job, cold=False)
    for number, way in enumerate(campaign.ways):
        kill = campaign.kill(number, job, way, cold=False)
        assert kill.flaws == []


class Forgetful(ConvertJob):
    """A command that has told of more than there is."""

    def told(self, child):
        return {"conversions": 2}


class Fickle(ConvertJob):
    """A command that leaves another file than it should."""

    def comparable(self, held):
        return {**held, "more": time.monotonic()}


def test_the_harness_sees_what_is_lost(campaign, ground):
    job = Forgetful("csv to a new file", ground / "source")
    campaign.rehearse(job, cold=False)
    kill = campaign.kill(0, job, KILL, cold=False)
    assert kill.lost == [f"2 conversions were reported, {kill.kept['conversions']} are there"]


def test_the_harness_sees_what_is_not_the_same(campaign, ground):
    job = Fickle("csv to a new file", ground / "source")
    with pytest.raises(MisstepError, match="is not the same every time"):
        campaign.rehearse(job, cold=False)


def test_a_file_that_is_cut_has_no_trace(ground, tmp_path):
    whole = (ground / "source" / "D.h5").read_bytes()
    (tmp_path / "D.h5").write_bytes(whole)
    assert len(trace(tmp_path)["D.h5"]) == 3
    (tmp_path / "D.h5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(MisstepError, match=r"D\.h5 is damaged"):
        trace(tmp_path)


# What the kills have brought to light, each by itself


@pytest.mark.parametrize(
    ("number", "raised"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_a_signal_while_something_is_collected_is_not_lost(number, raised):
    class Collected:
        """Python ignores what is raised in `__del__`."""

        def __del__(self):
            os.kill(os.getpid(), number)
            time.sleep(0)

    with pytest.raises(KeyboardInterrupt) as caught, interruptible():  # noqa: PT012
        Collected()
        time.sleep(60)
    assert caught.type is raised


def test_an_interrupt_of_which_a_library_makes_an_import_error_is_one_all_the_same():
    for raised, told in ((KeyboardInterrupt(), "interrupted"), (Terminated("a"), "terminated; a")):
        error = ImportError("initialization failed")
        error.__cause__ = raised
        assert _explain(error) == (told, 130 if told == "interrupted" else 143)
    assert _explain(ImportError("no such module")) is None


INTERRUPTED = """
import os, signal, sys, threading
from pathlib import Path
from misstep.storage import hidden_folder

signal.signal(signal.SIGINT, signal.default_int_handler)

def interrupt(files):
    while all(file.exists() for file in files):
        pass
    os.kill(os.getpid(), signal.SIGINT)

try:
    with hidden_folder(Path("target")) as folder:
        files = [folder / str(number) for number in range(5000)]
        for file in files:
            file.touch()
        threading.Thread(target=interrupt, args=(files,), daemon=True).start()
except KeyboardInterrupt:
    print("left", len(list(Path().glob(".target.*/*"))))
"""


def test_what_is_interrupted_while_it_takes_its_temporary_folder_away_does_so_in_the_end(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stderr == ""
    assert list(tmp_path.iterdir()) == []


def test_where_there_is_no_memory_one_line_says_so():
    program = (
        "import resource, sys; from misstep.cli import main; "
        "pages = int(open('/proc/self/statm').read().split()[0]); "
        "limit = pages * resource.getpagesize() + 2**22; "
        "resource.setrlimit(resource.RLIMIT_AS, (limit, limit)); "
        "sys.exit(main(['list', 'systems']))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("misstep: error: out of memory: ")
    assert done.stderr.count("\n") == 1


def test_who_interrupts_does_not_wait_for_what_a_worker_is_at():
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), process_pool(1) as pool:  # noqa: PT012
        worker = pool.submit(os.getpid).result()
        pool.submit(time.sleep, 3600.0)
        raise KeyboardInterrupt
    while Path(f"/proc/{worker}").exists():
        assert time.monotonic() - started < 60.0
        time.sleep(0.01)


STARTING = """
import os, signal, time
from misstep.workers import process_pool

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.setpgid(0, 0)
    try:
        with process_pool(1) as pool:
            pool.submit(os.getpid)
            os.killpg(0, signal.SIGINT)
            time.sleep(60)
    except KeyboardInterrupt:
        print("interrupted")
"""


def test_a_ctrl_c_while_a_worker_starts_is_no_traceback(tmp_path):
    (tmp_path / "starting.py").write_text(STARTING)
    words = [sys.executable, str(tmp_path / "starting.py")]
    done = subprocess.run(words, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


def test_parquet_on_a_full_disk_says_so_once(ground, tmp_path):
    program = (
        "import resource, sys, signal; from misstep.cli import main; "
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, resource.RLIM_INFINITY)); "
        "sys.exit(main(sys.argv[1:]))"
    )
    given = str(ground / "source" / "large" / "D.h5")
    for wanted in (["OUT.parquet"], ["OUT", "--format", "lerobot"]):
        words = ["convert", given, *wanted, "--allow-loss"]
        done = subprocess.run(
            [sys.executable, "-c", program, *words], capture_output=True, text=True, cwd=tmp_path
        )
        assert done.returncode == 2
        assert done.stderr.startswith(f"misstep: error: cannot write {wanted[0]}: ")
        assert done.stderr.count("\n") == 1
        assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux exchanges two names")
def test_two_folders_change_places_in_a_single_step(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "said").write_text(name)
    assert exchange(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a" / "said").read_text() == "b"
    assert (tmp_path / "b" / "said").read_text() == "a"
    assert not exchange(tmp_path / "a", tmp_path / "nothing")
    number = (tmp_path / "a").stat().st_ino
    write_folder(tmp_path / "a", lambda path: path.mkdir(), lambda path: True)
    assert (tmp_path / "a").stat().st_ino != number
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
