import json
import os
import signal
import subprocess
import sys
import time

import pytest

from misstep.errors import MisstepError
from misstep.storage import atomic_write, read_json, write_json, write_text

SLOW_WRITER = """
import sys
from misstep.storage import atomic_write

def write(temporary):
    with open(temporary, "w") as file:
        file.write("ne")
        file.flush()
        print("halfway", flush=True)
        sys.stdin.read()

atomic_write(sys.argv[1], write)
"""


def test_writes_and_replaces(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "one\n")
    write_text(path, "zwölf\n")
    assert path.read_bytes() == "zwölf\n".encode()
    assert os.listdir(tmp_path) == ["a.txt"]


def test_the_writer_sees_the_final_name_but_the_folder_does_not(tmp_path):
    def write(temporary):
        assert temporary.name == "picture.png"
        temporary.write_text("x")
        assert list(tmp_path.glob("*.png")) == []

    atomic_write(tmp_path / "picture.png", write)
    assert [p.name for p in tmp_path.iterdir()] == ["picture.png"]


@pytest.mark.parametrize("stop", [ZeroDivisionError, KeyboardInterrupt, SystemExit])
def test_a_writer_that_stops_leaves_the_old_file(tmp_path, stop):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write(temporary):
        temporary.write_text("ne")
        raise stop

    with pytest.raises(stop):
        atomic_write(path, write)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT])
def test_a_process_that_is_stopped_leaves_the_old_file(tmp_path, stop):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with subprocess.Popen(
        [sys.executable, "-c", SLOW_WRITER, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:
        assert process.stdout.readline() == b"halfway\n"
        process.send_signal(stop)
        assert process.wait(10) != 0
    assert path.read_text() == "old"
    assert list(tmp_path.glob("*.txt")) == [path]
    if stop is signal.SIGINT:
        assert os.listdir(tmp_path) == ["a.txt"]


def test_readers_see_the_old_file_or_the_new_one(tmp_path):
    path = tmp_path / "a.txt"
    sizes = 10, 100_000
    write_text(path, "x" * sizes[0])
    writer = (
        "import sys\nfrom misstep.storage import write_text\n"
        f"for i in range(200): write_text(sys.argv[1], 'x' * {sizes}[i % 2])"
    )
    seen = set()
    with subprocess.Popen([sys.executable, "-c", writer, str(path)]) as process:
        end = time.monotonic() + 15
        while process.poll() is None and time.monotonic() < end:
            seen.add(len(path.read_text()))
        assert process.wait(1) == 0
    assert seen <= set(sizes)


def test_unwritable_places_are_told_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "no" / "a.txt", tmp_path / "file" / "a.txt"):
        with pytest.raises(MisstepError, match=r"cannot write .*a\.txt: .*; choose a folder"):
            write_text(path, "x")
    with pytest.raises(MisstepError, match="it is a folder; name a file"):
        write_text(tmp_path, "x")
    assert os.listdir(tmp_path) == ["file"]


def test_a_writer_that_makes_no_file_is_told(tmp_path):
    with pytest.raises(MisstepError, match="No such file"):
        atomic_write(tmp_path / "a.txt", lambda temporary: None)
    assert os.listdir(tmp_path) == []


def test_permissions_of_the_old_file_are_kept_and_new_ones_follow_the_umask(tmp_path):
    plain, old, new = tmp_path / "plain", tmp_path / "old", tmp_path / "new"
    plain.write_text("")
    old.write_text("")
    old.chmod(0o640)
    write_text(old, "x")
    write_text(new, "x")
    assert old.stat().st_mode & 0o777 == 0o640
    assert new.stat().st_mode == plain.stat().st_mode


def test_a_link_stays_a_link(tmp_path):
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    link.symlink_to(target)
    write_text(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_json(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"b": [1, None], "a": 0.1}, sort_keys=True)
    assert list(json.loads(path.read_text())) == ["a", "b"]
    write_json(path, {"b": [1, None], "a": 0.1})
    assert json.loads(path.read_text()) == read_json(path) == {"b": [1, None], "a": 0.1}
    assert list(json.loads(path.read_text())) == ["b", "a"]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), object(), {1: {2, 3}}])
def test_json_refuses_what_it_cannot_say(tmp_path, value):
    path = tmp_path / "a.json"
    path.write_text("old")
    with pytest.raises(MisstepError, match=r"a\.json as JSON"):
        write_json(path, value)
    assert path.read_text() == "old"


def test_json_that_is_damaged_or_endless_is_refused(tmp_path, refused):
    path = tmp_path / "a.json"
    with refused(r"cannot read .*a\.json"):
        read_json(path)
    path.write_text('{"a": [1,')
    with refused(r"a\.json is not valid JSON"):
        read_json(path)
    with path.open("ab") as file:
        file.truncate(65 * 2**20)  # takes no room on the disk
    with refused(r"a\.json is too large"):
        read_json(path)
