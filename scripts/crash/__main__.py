"""Kill misstep at random instants, and see whether anything is lost.

    python scripts/crash --kills 1000 --seed 0 --json crashes.json

The exit code is 0 only if nothing was lost, broken, left behind, badly told or different after
going on. Who may not mount a file system cannot fill one: then no command dies of a full disk.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

import numpy as np
from campaign import Campaign, Kill
from deaths import MEMORY, small_disk
from jobs import CONVERSIONS, LEARNERS, ConvertJob, Job, LearnJob, StudyJob, make_sources
from nursery import Nursery
from served import LiveJob, ServeJob

from misstep.cli.interruption import interruptible
from misstep.cli.output import print_table, write_result
from misstep.cli.progress import progress

SHARES = {"learn": 10, "convert": 9, "serve": 4, "live": 1, "study": 1}
"""How often each command is killed: the quick ones more often."""

_SAVED = 25
"""Kills after which all are written to the file."""

_COLD, _COLD_MEMORY = 0.05, 0.25
"""Share of commands that start as a program does, imports included. Where memory is to run out more
of them: a child of the nursery has most of what it needs already."""


def main() -> int:
    """Kill, count and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop after so many")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", default=",".join(SHARES), help="separated by commas")
    parser.add_argument("--json", type=Path, help="write every kill to this file")
    asked = parser.parse_args()
    with ExitStack() as closing:
        ground = Path(closing.enter_context(tempfile.TemporaryDirectory(prefix="misstep-crash-")))
        disk = closing.enter_context(small_disk(ground / "disk"))
        nursery = Nursery()
        closing.callback(nursery.close)
        source = ground / "source"
        source.mkdir()
        make_sources(source)
        campaign = Campaign(nursery, disk, ground, asked.seed)
        done = _kill_all(campaign, _jobs(source, asked.commands.split(",")), asked)
    _print(done, campaign.ways)
    return 1 if any(kill.flaws for kill in done) else 0


def _jobs(source: Path, commands: Sequence[str]) -> dict[str, list[Job]]:
    made: dict[str, list[Job]] = {
        "learn": [LearnJob(learner, source) for learner in LEARNERS],
        "convert": [ConvertJob(name, source) for name in CONVERSIONS],
        "serve": [ServeJob("", source)],
        "live": [LiveJob("", source)],
        "study": [StudyJob("", source)],
    }
    return {command: made[command] for command in commands}


def _kill_all(
    campaign: Campaign, jobs: dict[str, list[Job]], asked: argparse.Namespace
) -> list[Kill]:
    """Return all kills, and write them to a file as they come."""
    done: list[Kill] = []
    seconds = {}
    with progress("killing") as report:
        for job in chain.from_iterable(jobs.values()):
            usual = campaign.rehearse(job, cold=True).seconds
            seconds[job.name] = {"warm": usual[False], "cold": usual[True]}
            report(0, asked.kills, f"{job.name} takes {usual[False]:.2f} s, {usual[True]:.2f} cold")
        plan = [command for command in jobs for _ in range(SHARES[command])]
        rounds = -(-asked.kills // len(plan))
        started = time.monotonic()
        order = np.random.default_rng([asked.seed, asked.kills]).permuted(plan * rounds)
        turns = dict.fromkeys(jobs, 0)
        for number, command in enumerate(order[: asked.kills].tolist()):
            if time.monotonic() - started > asked.minutes * 60.0:
                break
            turn = turns[command]
            turns[command] += 1
            # Every job meets every way.
            way = campaign.ways[turn % len(campaign.ways)]
            job = jobs[command][turn // len(campaign.ways) % len(jobs[command])]
            share = _COLD_MEMORY if way == MEMORY else _COLD
            cold = bool(np.random.default_rng([asked.seed, number, 1]).random() < share)
            done.append(campaign.kill(number, job, way, cold=cold))
            report(number + 1, asked.kills, _line(done[-1]))
            if len(done) % _SAVED == 0:
                _save(done, seconds, asked)
    _save(done, seconds, asked)
    return done


def _save(
    done: list[Kill], seconds: dict[str, dict[str, float]], asked: argparse.Namespace
) -> None:
    flawed = sum(bool(kill.flaws) for kill in done)
    kills = [kill.to_json() for kill in done]
    result = {"seed": asked.seed, "flawed": flawed, "seconds": seconds, "kills": kills}
    write_result(asked.json, result)


def _line(kill: Kill) -> str:
    where = f"{kill.job}{' (cold)' if kill.cold else ''}, {kill.way} at {kill.instant:.2f} s"
    return f"{where}: {'; '.join(kill.flaws) or 'nothing lost'}"


def _print(done: list[Kill], ways: list[str]) -> None:
    """Print a row a command: kills of each kind, what was lost, and what going on gave."""
    rows = []
    for command in [c for c in SHARES if any(kill.command == c for kill in done)]:
        mine = [kill for kill in done if kill.command == command]
        counts = [str(sum(kill.way == way for kill in mine)) for way in ways]
        told = sum(sum(kill.told.values()) for kill in mine)
        lost = sum(bool(kill.lost or kill.broken) for kill in mine)
        said = sum(bool(kill.goodbye or kill.left) for kill in mine)
        differs = sum(bool(kill.differs) for kill in mine)
        rows.append([command, *counts, *map(str, (told, lost, said, len(mine) - differs, differs))])
    columns = ["command", *(f">{way}" for way in ways)]
    columns += [">told finished", ">lost", ">ended badly", ">same after", ">different"]
    print_table(columns, rows)
    for kill in done:
        if kill.flaws:
            print(f"kill {kill.number}: {_line(kill)}")


if __name__ == "__main__":
    os.umask(0o022)
    with interruptible():  # or its disk would stay mounted
        sys.exit(main())
