"""``misstep mark``: say by hand what became of each attempt."""

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from misstep.cli.options import JsonFile
from misstep.cli.output import check_output_file, formatted, write_result
from misstep.cli.table import print_table
from misstep.errors import MisstepError
from misstep.trajectory import Dataset, Outcome

if TYPE_CHECKING:
    from misstep.recordings.marking import Mark

_HELP = (
    "episode to mark, or u: undo, l: list, q: quit; then outcome, failure time and usable part, "
    "each of which Enter leaves as it is"
)
_SHORT = {"s": Outcome.SUCCESS, "f": Outcome.FAILURE, "u": Outcome.UNKNOWN}


def mark(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="One of misstep's own files.")],
    episode: Annotated[
        int | None, typer.Option(metavar="N", help="Which episode to mark, from 1.")
    ] = None,
    outcome: Annotated[
        str | None, typer.Option(metavar="OUTCOME", help="success, failure or unknown.")
    ] = None,
    failure_time: Annotated[
        float | None, typer.Option(metavar="T", help="When it failed, s from its start.")
    ] = None,
    usable: Annotated[
        str | None,
        typer.Option(metavar="FROM:TO", help="Keep this part alone, s: 0:2.5, or 1: to the end."),
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Take back the last mark.")] = False,
    json: JsonFile = None,
) -> int:
    """Say what became of an attempt, when it failed, and which part is usable.

    Without a change it lists the episodes, and on a terminal asks for changes. What the file was
    is kept in the folder FILE.history beside it; every mark can be taken back.
    """
    import misstep
    from misstep.recordings import marking

    check_output_file(json, "--json", file)
    said = (outcome, failure_time, usable)
    if undo:
        if episode is not None or any(value is not None for value in said):
            raise MisstepError("--undo takes back the last mark: leave the other options out")
        number = marking.undo(file)
        print(f"episode {number} is as it was before")
    elif any(value is not None for value in said):
        if episode is None:
            raise MisstepError("which episode is to be marked? give --episode N")
        dataset = misstep.load_dataset(file)
        marking.mark_episode(file, episode, _mark(dataset, episode, outcome, failure_time, usable))
    elif episode is not None:
        raise MisstepError(
            f"what is to be marked of episode {episode}? give --outcome, --failure-time or --usable"
        )
    elif sys.stdin.isatty() and sys.stdout.isatty():
        _list(misstep.load_dataset(file))
        _ask(file)
    dataset = misstep.load_dataset(file)
    _list(dataset)
    write_result(
        json,
        {
            "file": str(file),
            "episodes": len(dataset),
            "outcomes": [str(attempt.outcome) for attempt in dataset],
            "failure_times": [attempt.failure_time for attempt in dataset],
            "durations": [attempt.duration for attempt in dataset],
            "marks": [step.episode for step in marking.history(file)],
        },
    )
    return 0


def _mark(
    dataset: Dataset,
    episode: int,
    outcome: str | None,
    failure_time: float | None,
    usable: str | None,
) -> "Mark":
    from misstep.recordings import marking

    if not 1 <= episode <= len(dataset):
        raise MisstepError(f"there is no episode {episode}: they are numbered 1 to {len(dataset)}")
    if failure_time is not None and not math.isfinite(failure_time):
        raise MisstepError(f"the failure time is {failure_time}: it has to be a number of seconds")
    part = None if usable is None else _part(usable, dataset[episode - 1].duration)
    return marking.Mark(_outcome(outcome), failure_time, part)


def _outcome(text: str | None) -> Outcome | None:
    if text is None:
        return None
    if text not in set(Outcome):
        raise MisstepError(f"the outcome is {text!r}; there are: {', '.join(Outcome)}")
    return Outcome(text)


def _part(text: str, duration: float) -> tuple[float, float]:
    """Read ``FROM:TO``, either of which may be left out."""
    start, colon, end = (part.strip() for part in text.partition(":"))
    try:
        if not colon:
            raise ValueError
        times = (float(start or 0.0), float(end or duration))
        if not all(map(math.isfinite, times)):
            raise ValueError
    except ValueError:
        raise MisstepError(
            f"the usable part is {text!r}: write FROM:TO in seconds, such as 0:2.5"
        ) from None
    return times


def _list(dataset: Dataset) -> None:
    rows = [
        (
            str(number),
            f"{t.duration:.2f}",
            str(t.outcome),
            formatted(t.failure_time, ".2f"),
            t.provenance.demonstrator or "-",
            "; ".join(t.provenance.notes),
        )
        for number, t in enumerate(dataset, start=1)
    ]
    columns = ("episode", ">duration [s]", "outcome", ">failed at [s]", "by", "notes")
    print_table(columns, rows)


def _ask(file: Path) -> None:
    """Ask for marks until there are no more."""
    import misstep
    from misstep.recordings import marking

    print(_HELP)
    while True:
        try:
            answer = input("episode: ").strip().lower()
            if answer in ("q", ""):
                return
            if answer == "u":
                print(f"episode {marking.undo(file)} is as it was before")
            elif answer == "l":
                _list(misstep.load_dataset(file))
            else:
                _ask_episode(file, answer)
        except MisstepError as error:
            print(error)  # asked again
        except EOFError:
            print()
            return


def _ask_episode(file: Path, answer: str) -> None:
    import misstep
    from misstep.recordings import marking

    dataset = misstep.load_dataset(file)
    if not answer.isdecimal() or not 1 <= int(answer) <= len(dataset):
        raise MisstepError(f"{answer!r} is not an episode: they are numbered 1 to {len(dataset)}")
    before = dataset[int(answer) - 1]
    said = input(f"  outcome, now {before.outcome} (s, f, u): ").strip().lower()
    outcome = str(_SHORT[said]) if said in _SHORT else said or None
    time = None
    if outcome == Outcome.FAILURE or (outcome is None and before.outcome is Outcome.FAILURE):
        now = "not known" if before.failure_time is None else f"{before.failure_time:.2f} s"
        time = _seconds(input(f"  failed at, now {now}: ").strip())
    part = input(f"  usable part, now 0:{before.duration:.2f} s: ").strip() or None
    if outcome is None and time is None and part is None:
        return
    after = marking.mark_episode(
        file, int(answer), _mark(dataset, int(answer), outcome, time, part)
    )
    print("  " + "; ".join(after.provenance.notes))


def _seconds(text: str) -> float | None:
    if not text:
        return None
    try:
        return float(text.removesuffix("s"))
    except ValueError:
        raise MisstepError(f"{text!r} is no number of seconds") from None


COMMANDS = [
    (
        "mark",
        mark,
        "misstep mark D.h5 --episode 3 --outcome failure --failure-time 2.1 --usable 0:2.5",
    )
]
