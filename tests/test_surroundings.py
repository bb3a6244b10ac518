"""What a command is started in: devices, pipes, closed streams, no home, narrow terminals."""

import json
import os
import pty
import re
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import misstep
from misstep.cli import main
from misstep.cli.output import check_output_file
from misstep.storage import write_text

MISSTEP = [sys.executable, "-m", "misstep"]
LONG = 300  # s, after which a command is taken to hang


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "D.h5"
    shown = misstep.demonstrate(misstep.make_system("cartpole"), by="weak", n=2, seed=0)
    misstep.save_dataset(shown, path)
    return path


@pytest.fixture
def here(recording, tmp_path, monkeypatch):
    shutil.copy(recording, tmp_path / "D.h5")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*words, **options):
    return subprocess.run([*MISSTEP, *words], capture_output=True, timeout=LONG, **options)


def listening(path):
    """Read a pipe to its end in a thread; what it heard is in the list."""
    heard = []
    thread = threading.Thread(target=lambda: heard.append(Path(path).read_bytes()))
    thread.start()
    return thread, heard


# Devices and pipes


def test_a_pipe_is_written_to_and_stays(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    thread, heard = listening(pipe)
    write_text(pipe, "told\n")
    thread.join()
    assert heard == [b"told\n"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_device_is_written_to_and_stays(tmp_path):
    ours, theirs = pty.openpty()  # a device that anybody can make
    link = tmp_path / "result.json"
    link.symlink_to(os.ttyname(theirs))
    check_output_file(link, "--json")
    write_text(link, "told")
    assert os.read(ours, 100) == b"told"
    assert stat.S_ISCHR(os.stat(os.ttyname(theirs)).st_mode)
    os.close(ours)
    os.close(theirs)


@pytest.mark.skipif(os.geteuid() != 0, reason="only the administrator can make a node")
def test_a_node_of_a_device_is_never_replaced(here, tmp_path):
    node = tmp_path / "null.csv"
    try:
        os.mknod(node, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("not in this container")
    assert main(["inspect", "D.h5", "--out", str(node), "--json", str(node)]) == 0
    assert main(["convert", "D.h5", str(node), "--force"]) == 0
    assert main(["demonstrate", "cartpole", "-n", "1", "--out", str(node), "--force"]) == 0
    assert stat.S_ISCHR(node.stat().st_mode)


@pytest.mark.parametrize("kind", ["folder", "socket"])
def test_what_is_no_file_is_refused_before_the_work(here, kind, capsys):
    import socket

    with socket.socket(socket.AF_UNIX) as server:
        if kind == "folder":
            Path("r").mkdir()
        else:
            server.bind("r")
        for words in (("inspect", "D.h5", "--json", "r"), ("inspect", "D.h5", "--out", "r")):
            assert main(list(words)) == 2
            assert capsys.readouterr().out == ""
        assert not Path("r").is_file()


def test_json_to_stdout_is_there_beside_what_is_printed(here):
    words = [*MISSTEP, "inspect", "D.h5", "--json", "/dev/stdout"]
    piped = subprocess.run(words, capture_output=True, timeout=LONG)
    assert (piped.returncode, piped.stderr) == (0, b"")
    with open("both.txt", "wb") as file:
        subprocess.run(words, stdout=file, timeout=LONG)
    assert Path("both.txt").read_bytes() == piped.stdout
    end = piped.stdout.index(b"\n}\n") + 3
    assert json.loads(piped.stdout[piped.stdout.index(b"{") : end])["file"] == "D.h5"
    assert b"theta_dot" in piped.stdout[end:]


@pytest.mark.parametrize("name", ["q.h5", "q.bag", "q.mcap", "q.db3", "q.csv", "q.parquet"])
def test_a_pipe_is_no_recording(here, name):
    os.mkfifo(name)
    for words in (
        ("inspect", name),
        ("mark", name),
        ("learn", "cartpole", "--from", name),
    ):
        done = run(*words)
        assert done.returncode == 2
        assert re.search(rb"^misstep: error: [^\n]*\n$", done.stderr)


def test_a_pipe_in_the_folder_of_a_data_set_is_refused(here, refused):
    assert main(["convert", "D.h5", "D.minari"]) == 0
    metadata = Path("D.minari/data/metadata.json")
    metadata.unlink()
    os.mkfifo(metadata)
    assert run("inspect", "D.minari").returncode == 2
    assert run("inspect", "D.minari", "--format", "minari").returncode == 2


@pytest.mark.parametrize("name", ["z.bag", "z.mcap", "z.db3"])
def test_a_bag_is_known_by_its_beginning(tmp_path, name, refused):
    path = tmp_path / name
    path.touch()
    os.truncate(path, 2**31)
    with refused(f"does not begin as a {path.suffix} file does"):
        misstep.load_dataset(path)


def test_a_result_takes_no_recordings_place(here, capsys):
    before = Path("D.h5").read_bytes()
    shutil.copy("D.h5", "E.h5")
    for option in ("--out", "--json"):
        assert main(["inspect", "D.h5", option, "E.h5"]) == 2
        assert "is a recording" in capsys.readouterr().err
    assert Path("E.h5").read_bytes() == before


# Streams


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_closed_streams_are_none_that_a_file_can_become(here, closed):
    shell = " ".join(f"{n}>&-" for n in closed)
    words = " ".join([*MISSTEP, "inspect", "D.h5", "--out", "P.html"])
    done = subprocess.run(["sh", "-c", f"{words} {shell}"], capture_output=True, timeout=LONG)
    assert done.returncode == 0
    assert Path("P.html").read_text().rstrip().endswith("</html>")


def test_a_reader_that_leaves_is_nothing_that_happened(here):
    with subprocess.Popen(
        [*MISSTEP, "inspect", "D.h5", "--out", "P.html"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as command:
        command.stdout.close()  # before a word is printed
        assert command.stderr.read() == b""
    assert command.returncode == 0
    assert Path("P.html").exists()


def test_names_need_not_be_texts(here):
    name = os.fsdecode(b"caf\xe9")
    shutil.copy("D.h5", f"{name}.h5")
    done = run("inspect", f"{name}.h5", "--out", f"{name}.html", "--json", f"{name}.json")
    assert (done.returncode, done.stderr) == (0, b"")
    assert Path(f"{name}.html").exists()
    done = run("convert", f"{name}.h5", f"{name}2.h5")
    assert (done.returncode, done.stderr) == (0, b"")
    done = run("convert", f"{name}.h5", f"{name}.parquet")
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)


def test_the_package_is_the_command(here):
    assert run("--version").stdout.split() == [b"misstep", misstep.__version__.encode()]
    run("inspect", "D.h5", "--json", "J.json")
    assert misstep.storage.read_json(Path("J.json"))["command"][:2] == ["misstep", "inspect"]


def test_an_interrupt_finds_somebody_from_the_first_import_on(here):
    """The command asks for it itself as soon as its own code runs: later is easier."""
    program = (
        "import os, signal, sys, threading\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == sys.argv[1]: os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        "from misstep.cli import main\n"
        "words = ['inspect', 'D.h5']\n"
        "sys.exit(main(words))\n"
    )
    for module in ("misstep.cli.app", "typer", "misstep.formats", "numpy", "h5py", "scipy"):
        done = subprocess.run(
            [sys.executable, "-c", program, module], capture_output=True, timeout=LONG
        )
        assert (done.returncode, done.stderr) == (130, b"misstep: interrupted\n"), module


def test_an_interrupt_at_any_time_leaves_no_traceback(here):
    for delay in (0.05, 0.1, 0.2, 0.4, 0.8):
        with subprocess.Popen([*MISSTEP, "inspect", "D.h5"], stderr=subprocess.PIPE) as command:
            time.sleep(delay)
            command.send_signal(signal.SIGINT)
            said = command.stderr.read()
        # Killed by the signal: before Python itself has begun.
        assert command.returncode in (0, 130, -signal.SIGINT)
        assert b"misstep/" not in said


# Compiled loops


@pytest.fixture
def fixed(tmp_path):
    """The package in a folder that cannot be written to, and how to run it as somebody else."""
    site = tmp_path / "site"
    shutil.copytree(
        Path(misstep.__file__).parent,
        site / "misstep",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    for path in sorted(site.rglob("*"), reverse=True):
        path.chmod(0o555 if path.is_dir() else 0o444)
    tmp_path.chmod(0o777)
    capability = "+dac_read_search"  # Python itself may be the administrator's
    other = ["setpriv", "--reuid=12345", "--regid=12345", "--clear-groups"]
    other += [f"--inh-caps={capability}", f"--ambient-caps={capability}"]
    yield site, other if os.geteuid() == 0 else []
    for path in site.rglob("*"):
        path.chmod(0o755)


@pytest.mark.parametrize("home", ["/nonexistent", None])
def test_without_a_home_what_is_compiled_is_kept_for_the_process(fixed, here, home):
    site, other = fixed
    if other and shutil.which("setpriv") is None:
        pytest.skip("there is no setpriv to become somebody else with")
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(site), "TMPDIR": str(here)}
    if home is not None:
        environment["HOME"] = home
    program = (
        "import misstep, numpy as np, os; from misstep.mixture import compiled; "
        "assert misstep.__file__.startswith(os.environ['PYTHONPATH']); "
        "X = np.random.default_rng(0).normal(size=(50, 2)); "
        "misstep.GaussianMixture(2, random_state=0).fit(X); "
        "print(compiled.cholesky_whitener.stats.cache_path)"
    )
    done = subprocess.run(
        [*other, sys.executable, "-B", "-c", program],
        env=environment,
        cwd=here,
        capture_output=True,
        text=True,
        timeout=LONG,
    )
    assert (done.returncode, done.stderr) == (0, "")
    kept = Path(done.stdout.strip())
    assert kept.is_relative_to(here)
    assert not kept.exists()
    assert not (here / "~").exists()


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_what_was_kept_and_is_damaged_is_compiled_anew(tmp_path, share):
    program = (
        "from misstep.compiling import njit\n"
        "@njit(cache=True)\n"
        "def double(x):\n    return 2 * x\n"
        "print(double(21), sum(double.stats.cache_hits.values()))\n"
    )
    script = tmp_path / "script.py"
    script.write_text(program)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def answer():
        done = subprocess.run(
            [sys.executable, script], env=environment, capture_output=True, timeout=LONG
        )
        assert (done.returncode, done.stderr) == (0, b"")
        return done.stdout.split()

    assert [answer(), answer()] == [[b"42", b"0"], [b"42", b"1"]]
    for suffix in ("*.nbi", "*.nbc"):
        for file in (tmp_path / "cache").rglob(suffix):
            os.truncate(file, int(share * file.stat().st_size))
        assert [answer(), answer()] == [[b"42", b"0"], [b"42", b"1"]]


# Tables


@pytest.mark.parametrize("width", [80, 40, 20])
def test_no_word_of_a_table_is_broken(monkeypatch, capsys, width):
    from misstep.cli import table

    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(width))
    columns = ("column", "kind", ">smallest", ">largest [m/s]", ">no return after [s]", "recorded")
    rows = [
        ("theta_dot", "observation", "-0.5406", "1.234e-05", "0.88", "2026-12-01T14:55:36+00:00"),
        ("force", "an action", "-7.604", "12.69", "-", "-"),
    ]
    table.print_table(columns, rows)
    printed = re.sub(r"\x1b\[\d*m", "", capsys.readouterr().out)
    words = set(printed.split())
    for cell in (*columns, *rows[0], *rows[1]):
        assert set(cell.lstrip(">").split()) <= words
    assert max(map(len, printed.splitlines())) <= max(width, len("theta_dot  ") + 28)
