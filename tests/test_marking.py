import json
import os
import pty
import select
import subprocess
import sys
import time

import numpy as np
import pytest

from misstep import Dataset, Outcome, load_dataset, save_dataset
from misstep.cli import main
from misstep.recordings.marking import (
    ORIGINAL,
    Mark,
    history,
    history_folder,
    mark_episode,
    marked,
    undo,
)


@pytest.fixture
def file(demonstrations, tmp_path):
    path = tmp_path / "D.h5"
    save_dataset(demonstrations, path)
    return path


def test_a_failure_time_is_a_failure_at_that_step(demonstrations):
    t = marked(demonstrations[0], Mark(failure_time=0.4))
    assert t.outcome is Outcome.FAILURE
    assert t.failure_step == round(0.4 / t.dt)
    assert t.provenance.notes == ("failure time: 0.4 s, marked by hand",)
    assert np.array_equal(t.observations, demonstrations[0].observations)


@pytest.mark.parametrize("outcome", [Outcome.SUCCESS, Outcome.UNKNOWN])
def test_what_did_not_fail_has_no_failure_time(demonstrations, outcome):
    t = marked(demonstrations[0], Mark(outcome=outcome))
    assert (t.outcome, t.failure_step) == (outcome, None)
    assert f"outcome: {outcome}, marked by hand" in t.provenance.notes


def test_a_usable_part_keeps_rows_costs_and_the_failure(demonstrations):
    before = demonstrations[0]
    first, last = 10, before.n_steps - 5
    t = marked(before, Mark(failure_time=(last - 3) * before.dt, usable=(0.2, last * before.dt)))
    assert np.array_equal(t.observations, before.observations[first : last + 1])
    assert np.array_equal(t.actions, before.actions[first:last])
    assert np.array_equal(t.costs, before.costs[first:last])
    assert t.failure_step == last - 3 - first
    assert any(note.startswith("usable part: 0.2 to ") for note in t.provenance.notes)


def test_a_failure_beyond_the_usable_part_is_gone_but_not_the_outcome(demonstrations):
    t = marked(demonstrations[0], Mark(usable=(0.0, 0.2)))
    assert (t.outcome, t.failure_step, t.n_steps) == (Outcome.FAILURE, None, 10)


def test_a_second_mark_replaces_the_note_of_the_first(demonstrations):
    t = marked(marked(demonstrations[0], Mark(failure_time=0.4)), Mark(failure_time=0.3))
    assert t.provenance.notes == ("failure time: 0.3 s, marked by hand",)


@pytest.mark.parametrize(
    ("mark", "match"),
    [
        ({"failure_time": 99.0}, "failure time is 99 s, but the recording goes from 0"),
        ({"failure_time": -1.0}, "failure time is -1 s"),
        ({"usable": (0.5, 0.2)}, "holds no action"),
        ({"usable": (0.0, 99.0)}, "usable part's end is 99 s"),
        ({"failure_time": 0.1, "usable": (0.2, 0.4)}, "failed at 0.1 s, before the usable part"),
    ],
)
def test_times_outside_the_recording_are_refused(demonstrations, refused, mark, match):
    with refused(match):
        marked(demonstrations[0], Mark(**mark))


def test_marks_that_contradict_or_say_nothing_are_refused(refused):
    with refused("contradict each other"):
        Mark(outcome=Outcome.SUCCESS, failure_time=1.0)
    with refused("nothing is marked"):
        Mark()


def test_marks_are_taken_back_one_by_one(file, demonstrations, refused):
    original = file.read_bytes()
    states = [load_dataset(file)]
    marks = [
        (1, Mark(outcome=Outcome.UNKNOWN)),
        (3, Mark(failure_time=0.3, usable=(0.1, 0.5))),
        (1, Mark(outcome=Outcome.SUCCESS)),
    ]
    for episode, mark in marks:
        mark_episode(file, episode, mark)
        states.append(load_dataset(file))
    assert [step.episode for step in history(file)] == [1, 3, 1]
    assert (history_folder(file) / ORIGINAL).read_bytes() == original
    for episode, state in zip((1, 3, 1), reversed(states[:-1]), strict=True):
        assert undo(file) == episode
        assert load_dataset(file) == state
    assert load_dataset(file) == demonstrations
    with refused("no marks to take back"):
        undo(file)


def test_a_mark_that_changes_nothing_is_no_step(file, demonstrations):
    mark_episode(file, 1, Mark(outcome=demonstrations[0].outcome))
    assert not history(file)
    assert not history_folder(file).exists()


def test_what_was_added_after_a_mark_stays_when_it_is_taken_back(file, demonstrations):
    mark_episode(file, 1, Mark(outcome=Outcome.UNKNOWN))
    save_dataset(load_dataset(file).append(demonstrations[2]), file)
    undo(file)
    assert load_dataset(file) == demonstrations.append(demonstrations[2])


def test_killed_between_the_copy_and_the_file_the_next_undo_takes_back_a_real_mark(
    file, demonstrations
):
    mark_episode(file, 2, Mark(outcome=Outcome.UNKNOWN))
    # What a mark of episode 1 leaves that was killed before it wrote the file.
    save_dataset(Dataset([load_dataset(file)[0]]), history_folder(file) / "0002-episode-1.h5")
    assert undo(file) == 2
    assert load_dataset(file) == demonstrations
    assert not history(file)


def test_a_refused_mark_leaves_everything_as_it_was(file, refused):
    before = file.read_bytes()
    with refused("the recording goes from"):
        mark_episode(file, 1, Mark(failure_time=99.0))
    with refused("there is no episode 4: they are numbered 1 to 3"):
        mark_episode(file, 4, Mark(outcome=Outcome.SUCCESS))
    assert file.read_bytes() == before
    assert os.listdir(file.parent) == [file.name]


def test_another_format_is_refused_with_what_would_be_right(tmp_path, refused):
    table = tmp_path / "D.csv"
    table.write_text("x,u\n0,1\n1,1\n")
    with refused("misstep convert .*D.csv .*D.h5"):
        mark_episode(table, 1, Mark(outcome=Outcome.SUCCESS))


def test_the_command_marks_and_takes_back(file, demonstrations, tmp_path, capsys):
    result = tmp_path / "mark.json"
    said = ["--outcome", "failure", "--failure-time", "0.3", "--usable", "0:0.5"]
    assert main(["mark", str(file), "--episode", "2", *said, "--json", str(result)]) == 0
    t = load_dataset(file)[1]
    assert (t.failure_time, t.n_steps) == (pytest.approx(0.3), 25)
    found = json.loads(result.read_text())
    assert found["marks"] == [2]
    assert found["failure_times"][1] == pytest.approx(0.3)
    assert "marked by hand" in capsys.readouterr().out
    assert main(["mark", str(file), "--undo"]) == 0
    assert load_dataset(file) == demonstrations


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--outcome", "success"], "give --episode N"),
        (["--episode", "1"], "give --outcome, --failure-time or --usable"),
        (["--episode", "9", "--outcome", "success"], "numbered 1 to 3"),
        (["--episode", "1", "--outcome", "good"], "there are: success, failure, unknown"),
        (["--episode", "1", "--usable", "3"], "write FROM:TO"),
        (["--episode", "1", "--failure-time", "nan"], "has to be a number of seconds"),
        (["--undo"], "no marks to take back"),
        (["--undo", "--episode", "1"], "leave the other options out"),
    ],
)
def test_bad_words_are_told_in_one_line(file, capsys, arguments, match):
    before = file.read_bytes()
    assert main(["mark", str(file), *arguments]) == 2
    error = capsys.readouterr().err
    assert match in error
    assert error.count("\n") == 1
    assert file.read_bytes() == before


def test_without_a_change_and_a_terminal_it_lists(file, capsys):
    before = file.read_bytes()
    assert main(["mark", str(file)]) == 0
    assert capsys.readouterr().out.count("failure") == 3
    assert file.read_bytes() == before


def test_a_person_marks_at_a_terminal(file):
    ours, theirs = pty.openpty()
    command = "import sys; from misstep.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen(
        [sys.executable, "-c", command, "mark", str(file)],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        close_fds=True,
    )
    os.close(theirs)
    seen = ""

    def until(text, deadline=60.0):
        nonlocal seen
        end = time.monotonic() + deadline
        while text not in seen:
            assert time.monotonic() < end, seen
            if select.select([ours], [], [], 1.0)[0]:
                seen += os.read(ours, 4096).decode(errors="replace")
        seen = seen.split(text, 1)[1]

    def answer(prompt, text):
        until(prompt)
        os.write(ours, f"{text}\n".encode())

    answer("episode:", "7")
    until("numbered 1 to 3")
    answer("episode:", "2")
    answer("outcome, now failure", "u")
    answer("usable part, now", "0:0.3")
    answer("episode:", "1")
    answer("outcome, now failure", "")
    answer("failed at, now", "0.2")
    answer("usable part, now", "")
    answer("episode:", "u")
    until("episode 1 is as it was before")
    answer("episode:", "q")
    assert process.wait(60) == 0
    os.close(ours)
    after = load_dataset(file)
    assert (after[1].outcome, after[1].n_steps) == (Outcome.UNKNOWN, 15)
    assert [step.episode for step in history(file)] == [2]


def test_a_file_of_another_make_is_never_rewritten(demonstrations, tmp_path, refused):
    path = tmp_path / "can.hdf5"
    save_dataset(demonstrations, path, format="robomimic")
    before = path.read_bytes()
    for change in (lambda: mark_episode(path, 1, Mark(failure_time=0.4)), lambda: undo(path)):
        with refused(r"robomimic HDF5, which cannot hold marks.*misstep convert .*can\.h5"):
            change()
    assert path.read_bytes() == before
    assert not history_folder(path).exists()
    other = path.rename(tmp_path / "can.h5")
    with refused(r"misstep convert .*can-marked\.h5"):
        mark_episode(other, 1, Mark(failure_time=0.4))
