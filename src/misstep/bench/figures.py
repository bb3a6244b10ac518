"""The plots of a bench, from the document that is kept as ``bench.json``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from misstep.plots import FAINT, INK, MODEL, SERIES, style
from misstep.storage import atomic_write

_COLOURS = {
    "misstep": MODEL,
    "plain NumPy": FAINT,
    "scikit-learn": SERIES[0],
    "gmr": SERIES[4],
    "PyPR": SERIES[3],
    "pomegranate": SERIES[2],
}
_WIDTH = 9.6

Rows = Sequence[Mapping[str, Any]]


def draw_all(folder: Path, document: Mapping[str, Any]) -> dict[str, Path]:
    """Draw all plots for which there are rows; return their files by name."""
    rows: Rows = document["rows"]
    figures = {
        "em": _draw_em([r for r in rows if r["task"] == "em" and r["seconds"]]),
        "scan": _draw_scans([r for r in rows if r["task"] == "em-scan" and r["seconds"]]),
        "query": _draw_query([r for r in rows if r["task"] == "query" and r["p50_us"]]),
        "growth": _draw_growth(
            [r for r in rows if r["task"].startswith("growth") and r["seconds"]],
            document["slopes"],
        ),
        "right-k": _draw_right_k([r for r in rows if r["right"] is not None]),
        "memory": _draw_memory([r for r in rows if r["n_bytes"]]),
    }
    paths = {}
    for name, figure in figures.items():
        if figure is not None:
            paths[name] = folder / f"{name}.png"
            _save(figure, paths[name])
    return paths


def _draw_em(rows: Rows) -> Figure | None:
    """Seconds of one fit over samples: a panel for each number of columns, most threads."""
    rows = [r for r in rows if r["threads"] == max(r["threads"] for r in rows)]
    if not rows:
        return None
    columns = sorted({r["d"] for r in rows})
    with style():
        figure = Figure(figsize=(_WIDTH, 3.4))
        axes = figure.subplots(1, len(columns), squeeze=False, sharex=True, sharey=True)[0]
        for ax, d in zip(axes, columns, strict=True):
            chosen = [r for r in rows if r["d"] == d]
            for contender in _contenders(chosen):
                mine = [r for r in chosen if r["contender"] == contender]
                _line(ax, mine, "n", "seconds", contender)
            bare = [r for r in chosen if r["contender"] == "misstep"]
            _line(ax, bare, "n", "bare_seconds", "bare hardware")
            ax.set_title(f"{d} columns")
            _tick_sizes(ax, chosen, "n")
            ax.set_xlabel("samples")
        axes[0].set_ylabel("one fit [s]")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=7)
    return figure


def _draw_scans(rows: Rows) -> Figure | None:
    """Seconds of a scan, a row of dots for each size."""
    return _dots(rows, _size, lambda r: (r["seconds"], r["seconds"]), "K = 1 … 10 [s]")


def _draw_query(rows: Rows) -> Figure | None:
    """Median to 99th percentile of a query, a row for each mixture."""
    return _dots(
        rows,
        lambda r: f"d = {r['d']}, K = {r['k']}",
        lambda r: (r["p50_us"], r["p99_us"]),
        "one mode, median to 99th percentile [µs]",
    )


def _dots(rows: Rows, label: Any, span: Any, title: str) -> Figure | None:
    if not rows:
        return None
    labels = list(dict.fromkeys(map(label, rows)))
    contenders = _contenders(rows)
    with style():
        figure = Figure(figsize=(_WIDTH, 0.55 * len(labels) + 1.2))
        ax = figure.subplots()
        for i, contender in enumerate(contenders):
            mine = [r for r in rows if r["contender"] == contender]
            places = [
                labels.index(label(r)) + 0.6 * (i / max(1, len(contenders) - 1) - 0.5) for r in mine
            ]
            low, high = zip(*map(span, mine), strict=True)
            ax.hlines(places, low, high, color=_COLOURS[contender], lw=2)
            ax.plot(low, places, "o", ms=5, color=_COLOURS[contender], label=contender)
        bare = [r for r in rows if r["contender"] == "misstep" and r["bare_seconds"]]
        unit = 1e6 if bare and bare[0]["p50_us"] else 1.0
        for r in bare:
            place = labels.index(label(r))
            handle = ax.vlines(
                unit * r["bare_seconds"], place - 0.4, place + 0.4, color=INK, lw=1.2, ls=":"
            )
        if bare:
            handle.set_label("bare hardware")
        ax.set_xscale("log")
        ax.set_yticks(range(len(labels)), labels)
        ax.invert_yaxis()
        ax.grid(axis="y", visible=False)
        ax.set_xlabel(title)
        figure.legend(loc="outside lower center", ncols=7)
    return figure


def _draw_growth(rows: Rows, slopes: Sequence[Mapping[str, Any]]) -> Figure | None:
    """Seconds of one fit over samples, components and columns, with the slopes."""
    if not rows:
        return None
    slope = {(s["contender"], s["along"]): s["slope"] for s in slopes}
    every = {"n": "samples", "k": "components", "d": "columns"}
    names = {a: name for a, name in every.items() if any(r["task"] == f"growth-{a}" for r in rows)}
    with style():
        figure = Figure(figsize=(_WIDTH, 3.2))
        axes = figure.subplots(1, len(names), squeeze=False)[0]
        for ax, (along, name) in zip(axes, names.items(), strict=True):
            chosen = [r for r in rows if r["task"] == f"growth-{along}"]
            for contender in _contenders(chosen):
                mine = [r for r in chosen if r["contender"] == contender]
                power = slope.get((contender, along))
                told = contender if power is None else f"{contender}: power {power:.2f}"
                _line(ax, mine, along, "seconds", contender, told)
            _tick_sizes(ax, chosen, along)
            ax.set_xlabel(name)
            ax.legend()
        axes[0].set_ylabel("one fit [s]")
    return figure


def _draw_right_k(rows: Rows) -> Figure | None:
    """Share of random mixtures whose number of components was found."""
    if not rows:
        return None
    with style():
        figure = Figure(figsize=(_WIDTH, 0.4 * len(rows) + 0.9))
        ax = figure.subplots()
        for i, r in enumerate(rows):
            rate, (low, high) = r["right"] / r["tried"], r["interval_95"]
            ax.barh(i, 100 * rate, color=_COLOURS[r["contender"]], height=0.6)
            ax.hlines(i, 100 * low, 100 * high, color=INK, lw=1.2)
        ax.set_yticks(
            range(len(rows)), [f"{r['contender']} ({r['right']} of {r['tried']})" for r in rows]
        )
        ax.invert_yaxis()
        ax.set_xlim(0, 100)
        ax.grid(axis="y", visible=False)
        ax.set_xlabel("right number of components [%], with the 95 % interval")
    return figure


def _draw_memory(rows: Rows) -> Figure | None:
    """Peak memory of one fit beyond the data."""
    if not rows:
        return None
    with style():
        figure = Figure(figsize=(_WIDTH, 0.4 * len(rows) + 0.9))
        ax = figure.subplots()
        for i, r in enumerate(rows):
            ax.barh(i, r["n_bytes"] / 2**20, color=_COLOURS[r["contender"]], height=0.6)
        ax.set_yticks(range(len(rows)), [r["contender"] for r in rows])
        ax.invert_yaxis()
        ax.grid(axis="y", visible=False)
        ax.set_xlabel(f"peak memory of a fit beyond the data, {_size(rows[0])} [MiB]")
    return figure


def _line(ax: Axes, rows: Rows, x: str, y: str, contender: str, label: str | None = None) -> None:
    is_bare = contender not in _COLOURS
    ax.plot(
        [r[x] for r in rows],
        [r[y] for r in rows],
        ":" if is_bare else "o-",
        color=INK if is_bare else _COLOURS[contender],
        ms=4,
        lw=1.6,
        label=label or contender,
    )
    ax.set_xscale("log")
    ax.set_yscale("log")


def _tick_sizes(ax: Axes, rows: Rows, x: str) -> None:
    """Mark the sizes that were measured, and no others."""
    sizes = sorted({r[x] for r in rows})
    ax.set_xticks(sizes, [f"{size:,}" for size in sizes])
    ax.xaxis.set_minor_formatter(NullFormatter())


def _contenders(rows: Rows) -> list[str]:
    return list(dict.fromkeys(r["contender"] for r in rows))


def _size(row: Mapping[str, Any]) -> str:
    return f"N = {row['n']:,}, d = {row['d']}"


def _save(figure: Figure, path: Path) -> None:
    atomic_write(path, lambda temporary: figure.savefig(temporary, metadata={"Software": None}))
