"""Work in other processes, some of which are killed.

The jobs live here because this module is quick to import, which every new process has to do.
"""

import os
import signal

import pytest

from misstep.errors import MisstepError
from misstep.workers import Lost, Tally, check_workers, process_pool, run_in_processes


def square(number):
    return number, number**2, os.getpid()


def refuse(number):
    raise MisstepError(f"no {number}")


def die_if_odd(number):
    return os.kill(os.getpid(), signal.SIGKILL) if number % 2 else number


def die_the_first_time(folder):
    """Kill the process, unless it has been done before."""
    try:
        folder.mkdir()
    except FileExistsError:
        return "survived"
    return os.kill(os.getpid(), signal.SIGKILL)


def test_every_job_is_done_once_in_other_processes():
    results = list(run_in_processes(square, range(20), 2))
    assert sorted((job, value) for job, (_, value, _) in results) == [(n, n**2) for n in range(20)]
    processes = {process for _, (_, _, process) in results}
    assert os.getpid() not in processes
    assert len(processes) <= 2
    assert list(run_in_processes(square, [], 2)) == []


def test_an_error_of_a_job_passes_through():
    with pytest.raises(MisstepError, match="no 3"):
        list(run_in_processes(refuse, [3], 1))


def test_a_job_whose_process_was_killed_is_tried_once_more(tmp_path):
    jobs = [tmp_path / name for name in "ab"]
    assert dict(run_in_processes(die_the_first_time, jobs, 2)) == dict.fromkeys(jobs, "survived")


def test_jobs_that_always_kill_are_lost_and_no_others():
    results = dict(run_in_processes(die_if_odd, [1, 2, 4], 2))
    assert isinstance(results[1], Lost)
    assert (results[2], results[4]) == (2, 4)


def test_a_tally_reports_what_is_done():
    seen = []
    tally = Tally(lambda *step: seen.append(step), total=3)
    with process_pool(1) as pool:
        for number in (1, 2):
            tally.expect(pool.submit(square, number), f"square of {number}")
        tally.wait()
    tally.count("all")
    assert seen == [(1, 3, "square of 1"), (2, 3, "square of 2"), (3, 3, "all")]


def test_workers_are_checked():
    assert check_workers(3) == 3
    assert check_workers(None) == len(os.sched_getaffinity(0))
    with pytest.raises(MisstepError, match="workers is 0"):
        check_workers(0)


def test_there_is_one_worker_for_each_core_that_the_process_may_use():
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        assert check_workers(None) == 1
    finally:
        os.sched_setaffinity(0, before)
