"""The page of a bench: one self-contained HTML file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from misstep.bench.markdown import introduction
from misstep.bench.tables import tables_of
from misstep.pages import data_url, render_page


def render(document: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    """Return the page.

    Parameters
    ----------
    document : mapping
        As in ``bench.json``.
    pictures : mapping of str to Path
        By name of the table that they belong to.
    """
    targets = document["targets"]
    return render_page(
        "bench/bench.html.j2",
        introduction=introduction(document).replace("`", ""),
        tables=tables_of(document),
        pictures={name: data_url(path) for name, path in pictures.items()},
        reached=sum(target["reached"] is True for target in targets),
        targets=len(targets),
        cards=_cards(document),
    )


def _cards(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what stands at the top: the largest scan, the smallest query, the right K."""
    ours = [row for row in document["rows"] if row["contender"] == "misstep"]
    cards = []
    scans = [row for row in ours if row["task"] == "em-scan" and row["ratio_to_sklearn"]]
    for row in sorted(scans, key=lambda row: row["n"])[-1:]:
        cards.append(
            (
                f"{row['ratio_to_sklearn']:.0f}×",
                f"scikit-learn, EM and BIC, N = {row['n']:,}, d = {row['d']}",
            )
        )
    for row in [row for row in ours if row["task"] == "query" and row["p50_us"]][:1]:
        cards.append((f"{row['p50_us']:.1f} µs", f"one action, d = {row['d']}, K = {row['k']}"))
    for row in [row for row in ours if row["right"] is not None]:
        cards.append((f"{row['right']} of {row['tried']}", "random mixtures: the right K"))
    return cards
