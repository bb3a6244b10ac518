"""`misstep reproduce`: run every experiment of the paper, and write its figures, tables and report.

    reproduce.json            version, command, seeds: all that rebuilds the rest
    cells/VARIANT/000.json    the measures of one variant with one seed
    runs/VARIANT/             the run of the first seed, whole: a run folder like any other
    figures/  videos/         as in the paper, PNG and PDF, MP4
    tables.json  report.html  the results

Runs of the other seeds live in ``work/`` until they are measured; the same command makes any of
them again. Whatever is interrupted, at whatever moment, the same command or `misstep resume` goes
on.
"""

import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from misstep.errors import MisstepError
from misstep.locks import driven
from misstep.paper import figures, report, tables
from misstep.paper.claims import Sample, judge_all
from misstep.paper.experiments import PHYSICS, VARIANTS, Variant, build_system, run_cell
from misstep.paper.measures import CellMeasures, measure
from misstep.paper.results import SHOWN_RUNS, Results, collect_calibration
from misstep.paper.sequel import keep_sequel, summary, write_sequel_video
from misstep.paper.synthetic import SyntheticMeasures, run_synthetic, synthetic_measures
from misstep.paper.videos import VIDEOS, Video, choose_videos, write_video_once
from misstep.runs import load_run
from misstep.storage import make_folder, read_json, write_json, write_text
from misstep.version import __version__, command_line
from misstep.workers import Progress, Tally, check_workers, process_pool, silent

Array = NDArray[np.float64]

CONFIG = "reproduce.json"
SEQUEL = "sequel"
SEEDS = 30
QUICK_SEEDS = 5


@dataclass(frozen=True)
class ReproductionConfig:
    """What was asked for."""

    seeds: int
    seed: int
    quick: bool
    physics: str = "mujoco"
    version: str = __version__

    @property
    def variants(self) -> dict[str, Variant]:
        """The variants to run: all, or with `quick` those that the paper itself shows."""
        return {name: v for name, v in VARIANTS.items() if v.core or not self.quick}

    @property
    def cells(self) -> list[tuple[str, int]]:
        """Every variant with every repetition."""
        return [(name, index) for name in self.variants for index in range(self.seeds)]

    @property
    def command(self) -> str:
        """The command that gives the same results, wherever they are put."""
        quick = " --quick" if self.quick else ""
        physics = f" --physics {self.physics}" if self.physics != "mujoco" else ""
        return f"misstep reproduce --seeds {self.seeds} --seed {self.seed}{quick}{physics}"


def reproduce(
    out: Path,
    *,
    seeds: int | None = None,
    seed: int = 0,
    quick: bool = False,
    physics: str = "mujoco",
    workers: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Reproduce the paper.

    Parameters
    ----------
    out : Path
        Folder for everything; if it holds the same reproduction already, that one goes on.
    seeds : int, optional
        Repetitions, each with its own demonstrations: 30, or 5 with `quick`.
    seed : int
        Of the whole; same seed, same tables.
    quick : bool
        Only what the paper itself shows, on one calibration.
    physics : str
        The engine that the cart-pole moves in, ``mujoco`` or ``gazebo``.
    workers : int, optional
        Processes; one a core if left out. The results do not depend on it.
    progress : callable, optional
        Called with how much is done, how much there is, and what was done last.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    MisstepError
        If a number is out of range, there is no such engine or it is not installed, the folder
        cannot be used, or it holds another reproduction.
    """
    seeds = (QUICK_SEEDS if quick else SEEDS) if seeds is None else seeds
    if seeds < 1 or seed < 0:
        raise MisstepError(f"seeds must be at least 1 and seed at least 0, got {seeds} and {seed}")
    if physics not in PHYSICS:
        raise MisstepError(f"no physics {physics}: there are {', '.join(PHYSICS)}")
    build_system("A", physics).close()  # an engine that is not there is told before anything is run
    processes = check_workers(workers)
    config = ReproductionConfig(seeds=int(seeds), seed=int(seed), quick=quick, physics=physics)
    path = out / CONFIG
    if path.exists():
        _check_same(path, config)
    else:
        make_folder(out)
        if any(out.glob("[!.]*")):
            raise MisstepError(f"{out} is not empty: choose a new or an empty folder")
        write_json(path, {**asdict(config), "command": list(command_line())})
    with driven(out):
        return _run(out, config, processes, progress or silent)


def resume(out: Path, *, workers: int | None = None, progress: Progress | None = None) -> Path:
    """Go on with the reproduction in a folder; see `reproduce`."""
    values = _read_config(out / CONFIG)
    return reproduce(
        out,
        seeds=values["seeds"],
        seed=values["seed"],
        quick=values["quick"],
        physics=values["physics"],
        workers=workers,
        progress=progress,
    )


def _run(out: Path, config: ReproductionConfig, workers: int, progress: Progress) -> Path:
    missing = [cell for cell in config.cells if not _cell_file(out, *cell).exists()]
    total = len(config.cells) + len(figures.FIGURES) + VIDEOS + 2
    tally = Tally(progress, total, done=len(config.cells) - len(missing))
    with process_pool(workers) as pool:
        calibrations, synthetic = _measure_apart(config, pool)
        sequel = pool.submit(keep_sequel, out / "runs" / SEQUEL, config.seed)
        run = partial(_run_and_measure, out, config)
        for name, index in missing:
            tally.expect(pool.submit(run, name, index), f"{VARIANTS[name].title}, seed {index + 1}")
        tally.wait()
        sequel.result()
        results = _gather(out, config, calibrations.result(), synthetic.result())
        make_folder(out / "figures")
        make_folder(out / "videos")
        # Videos take longest, so they go first.
        videos = choose_videos(out / "videos", results)
        for video in videos:
            tally.expect(pool.submit(write_video_once, video), video.title)
        path = out / "videos" / f"{SEQUEL}.mp4"
        tally.expect(pool.submit(write_sequel_video, path, results.sequel), "the sequel's video")
        for name in figures.FIGURES:
            tally.expect(pool.submit(figures.draw, name, out / "figures", results), name)
        tally.wait()
    _write_results(out, config, results, videos)
    tally.count("report")
    return out / "report.html"


def _measure_apart(
    config: ReproductionConfig, pool: ProcessPoolExecutor
) -> tuple[Future[dict[str, Array]], Future[list[SyntheticMeasures]]]:
    """Start what needs no run: the calibration's demonstrations, and the synthetic data."""
    return (
        pool.submit(collect_calibration, config.seed, quick=config.quick, physics=config.physics),
        pool.submit(synthetic_measures, config.seed, config.seeds),
    )


def _write_results(
    out: Path, config: ReproductionConfig, results: Results, videos: Sequence[Video]
) -> None:
    claims = judge_all(_samples(results))
    document = {
        "version": config.version,
        "command": config.command,
        "parameters": {
            "seeds": config.seeds,
            "seed": config.seed,
            "quick": config.quick,
            "physics": config.physics,
        },
        "calibrations": tables.calibrations(results),
        "tables": tables.all_tables(results),
        "claims": [claim.to_json() for claim in claims],
        "sequel": summary(results.sequel),
    }
    write_json(out / "tables.json", document)
    page = report.render(
        document, claims, results, out / "figures", videos, out / "videos" / f"{SEQUEL}.mp4"
    )
    write_text(out / "report.html", page)
    shutil.rmtree(out / "work", ignore_errors=True)


def _run_and_measure(out: Path, config: ReproductionConfig, name: str, index: int) -> None:
    """Run one cell and write its measures; runs in a worker."""
    keep = index == 0
    folder = out / "runs" / name if keep else out / "work" / f"{name}-{index:03d}"
    run = run_cell(folder, VARIANTS[name], config.seed, index, physics=config.physics)
    measures = measure(run)
    target = _cell_file(out, name, index)
    make_folder(target.parent)
    write_json(target, measures.to_json())
    if not keep:
        shutil.rmtree(folder)


def _cell_file(out: Path, name: str, index: int) -> Path:
    return out / "cells" / name / f"{index:03d}.json"


def _gather(
    out: Path,
    config: ReproductionConfig,
    calibrations: dict[str, Array],
    synthetic: list[SyntheticMeasures],
) -> Results:
    return Results(
        seed=config.seed,
        seeds=config.seeds,
        physics=config.physics,
        cells={
            name: [
                CellMeasures.from_json(read_json(_cell_file(out, name, index)))
                for index in range(config.seeds)
            ]
            for name in config.variants
        },
        runs={name: load_run(out / "runs" / name) for name in SHOWN_RUNS},
        synthetic=run_synthetic(config.seed),
        synthetic_measures=synthetic,
        calibrations=calibrations,
        sequel=load_run(out / "runs" / SEQUEL),
    )


def _samples(results: Results) -> Mapping[str, list[Sample]]:
    """Return the samples of both calibrations, one a seed, by the name of the calibration."""
    by_physics: dict[str, dict[str, list[CellMeasures]]] = {"A": {}, "B": {}}
    for name, cells in results.cells.items():
        by_physics[VARIANTS[name].calibration][name.removeprefix("B-")] = cells
    return {
        physics: [
            Sample(
                {name: cells[index] for name, cells in variants.items()},
                results.synthetic_measures[index] if physics == "A" else None,
            )
            for index in range(results.seeds)
        ]
        for physics, variants in by_physics.items()
        if variants
    }


def _read_config(path: Path) -> dict[str, Any]:
    values = read_json(path)
    kinds = {"seeds": int, "seed": int, "quick": bool, "physics": str, "version": str}
    if not isinstance(values, dict) or not all(
        isinstance(values.get(name), kind) for name, kind in kinds.items()
    ):
        raise MisstepError(f"{path} is not a reproduction's configuration: delete its folder")
    return values


def _check_same(path: Path, config: ReproductionConfig) -> None:
    values = _read_config(path)
    for name, wanted in asdict(config).items():
        if values[name] != wanted:
            raise MisstepError(
                f"{path.parent} holds a reproduction with {name} {values[name]}, not {wanted}: "
                f"choose another folder"
            )
