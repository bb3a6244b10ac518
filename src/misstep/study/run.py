"""`misstep study`: run every cell, and write the tables and the page.

    study.json            version, command, the whole specification
    cells/CASE/DEMONSTRATOR/LEARNER/000.json    the result of one cell
    cells.csv             one row a cell; summary.csv, summary.json: one row a combination
    summary.md            all demonstrators together, as a table for a README
    figures/  videos/     PNG and MP4
    report.html           all of it on one page

A cell's file appears in one step when the cell is done. Whatever is interrupted, at whatever
moment, the same command goes on, and so does `misstep resume`. Cells that were lost are tried
again.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from misstep.errors import MisstepError
from misstep.locks import driven
from misstep.storage import make_folder, read_json, write_json, write_text
from misstep.study import figures, markdown, page, table
from misstep.study.cells import CellResult, Video, cell_file, run_cell, write_first_success
from misstep.study.ray_engine import check_ray, run_on_ray
from misstep.study.spec import Cell, Study
from misstep.version import __version__, command_line
from misstep.workers import Lost, Progress, Tally, check_workers, run_in_processes, silent

CONFIG = "study.json"
ENGINES = ("processes", "ray")
MAX_VIDEOS = 40

_SHORT = 60

Engine = Callable[[Sequence[Cell]], Iterator[tuple[Cell, CellResult | Lost]]]
"""Runs cells, anywhere and in any order."""


@dataclass(frozen=True)
class Report:
    """What a study left behind."""

    page: Path
    rows: list[table.Summary]
    cells: int
    errors: int
    """Cells in which something raised an error."""
    lost: int
    """Cells whose processes died."""


def run_study(
    study: Study,
    out: Path,
    *,
    engine: str = "processes",
    workers: int | None = None,
    address: str | None = None,
    progress: Progress | None = None,
) -> Report:
    """Run a study, or go on with it.

    Parameters
    ----------
    study : Study
    out : Path
        Folder for everything; if it holds the same study already, that one goes on.
    engine : {"processes", "ray"}
        Where cells run. The results do not depend on it, apart from the times.
    workers : int, optional
        Cells at a time; one a core if left out.
    address : str, optional
        Of a Ray cluster.
    progress : callable, optional
        Called with how much is done, how much there is, and what was done last.

    Returns
    -------
    Report

    Raises
    ------
    MisstepError
        If `workers` is below 1, the folder cannot be used or holds another study, there is no
        such engine, or Ray is not installed or not reached.
    """
    processes = check_workers(workers)
    run = _engine(engine, workers, address)
    _claim(out, study)
    with driven(out):
        missing = [cell for cell in study.cells if not _is_done(out, cell)]
        total = len(study.cells)
        tally = Tally(progress or silent, total, done=total - len(missing))
        for cell, result in run(missing) if missing else ():
            if isinstance(result, Lost):
                result = CellResult("lost", f"lost: {result.reason}", tests=cell.tests)
            _save(out, cell, result)
            tally.count(f"{cell.title}: {result.summary}")
        measured = [
            table.Measured(cell, CellResult.load(cell_file(out, cell))) for cell in study.cells
        ]
        return _write(out, study, measured, processes, tally)


def held_study(out: Path) -> Study:
    """Return the study that a folder holds, finished or not.

    Raises
    ------
    MisstepError
        If it holds none, a damaged one, or one of another version.
    """
    values = read_json(out / CONFIG)
    if not isinstance(values, dict) or "study" not in values:
        raise MisstepError(f"{out / CONFIG} is damaged: it describes no study")
    if values.get("version") != __version__:
        raise MisstepError(
            f"{out} holds a study of misstep {values.get('version')}, but this is {__version__}: "
            "go on with that one, or choose another folder"
        )
    try:
        return Study.from_json(values["study"])
    except MisstepError as error:
        raise MisstepError(f"{out / CONFIG} is damaged: {error}") from error


def _engine(name: str, workers: int | None, address: str | None) -> Engine:
    if name == "processes":
        if address is not None:
            raise MisstepError("address is for the engine ray; processes run on this machine")
        return partial(run_in_processes, run_cell, workers=check_workers(workers))
    if name == "ray":
        check_ray(address)
        return partial(run_on_ray, run_cell, workers=workers, address=address)
    raise MisstepError(f"no engine named {name!r}; there are: {', '.join(ENGINES)}")


def _claim(out: Path, study: Study) -> None:
    """Make the folder the study's own, or make sure that it is.

    Raises
    ------
    MisstepError
        If it holds something else.
    """
    path = out / CONFIG
    wanted = json.loads(json.dumps({"version": __version__, "study": study.to_json()}))
    if path.exists():
        values = read_json(path)
        held = values if isinstance(values, dict) else {}
        for name in wanted:
            if held.get(name) != wanted[name]:
                where = _difference(name, held.get(name), wanted[name])
                raise MisstepError(f"{out} holds another study ({where}): choose another folder")
        return
    make_folder(out)
    if any(out.glob("[!.]*")):
        raise MisstepError(f"{out} is not empty: choose a new or an empty folder")
    write_json(path, {**wanted, "command": list(command_line())})


def _difference(name: str, held: object, wanted: object) -> str:
    """Return where two values first differ."""
    if isinstance(held, dict) and isinstance(wanted, dict):
        for key in [*wanted, *held]:
            if held.get(key) != wanted.get(key):
                return _difference(f"{name}.{key}", held.get(key), wanted.get(key))
    if isinstance(held, list) and isinstance(wanted, list) and len(held) == len(wanted):
        for index, (old, new) in enumerate(zip(held, wanted, strict=True)):
            if old != new:
                return _difference(f"{name}[{index}]", old, new)
    return f"{name} is {_short(held)} there, not {_short(wanted)}"


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= _SHORT else f"{text[:_SHORT]}…"


def _is_done(out: Path, cell: Cell) -> bool:
    path = cell_file(out, cell)
    return path.exists() and CellResult.load(path).status != "lost"


def _save(out: Path, cell: Cell, result: CellResult) -> None:
    path = cell_file(out, cell)
    make_folder(path.parent)
    names = ("case", "demonstrator", "learner", "repetition")
    write_json(path, {"cell": dict(zip(names, cell.key, strict=True)), **result.to_json()})


def _write(
    out: Path, study: Study, measured: list[table.Measured], workers: int, tally: Tally
) -> Report:
    rows = table.summarise(measured)
    table.write_tables(out, measured, rows)
    write_text(out / "summary.md", markdown.short_table(measured))
    pictures = figures.draw_all(out / "figures", measured)
    films = _film(out / "videos", measured, workers, tally) if study.videos else []
    target = out / "report.html"
    write_text(target, page.render(study, measured, rows, pictures, films))
    count = Counter(entry.result.status for entry in measured)
    return Report(target, rows, len(measured), count["error"], count["lost"])


def _film(
    folder: Path, measured: list[table.Measured], workers: int, tally: Tally
) -> list[page.Film]:
    """Write a video of the first success of every learner in every case, up to a number.

    Variants of a case share one. A video bears the number of its cell, so that it is still the
    right one when a cell before it, that was lost, has been made after all.
    """
    make_folder(folder)
    first: dict[tuple[str, str], Video] = {}
    for number, (cell, result) in enumerate(measured, start=1):
        if result.trials_to_success is not None:
            video = Video(cell, folder / f"{number:04d}.mp4")
            first.setdefault((cell.case.group, cell.learner.label), video)
    videos = list(first.values())[:MAX_VIDEOS]
    missing = [video for video in videos if not video.path.exists()]
    tally.total += len(missing)
    reasons: dict[Path, str] = {}
    for video, reason in run_in_processes(write_first_success, missing, workers):
        reasons[video.path] = reason.reason if isinstance(reason, Lost) else reason
        tally.count(f"video of {video.cell.title}")
    return [page.Film(video, reasons.get(video.path, "")) for video in videos]
