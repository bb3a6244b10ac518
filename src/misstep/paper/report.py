"""The report: one self-contained HTML file, pictures and videos inside."""

import base64
from collections import Counter
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from misstep.paper import synthetic
from misstep.paper.calibration import CALIBRATIONS
from misstep.paper.claims import Claim
from misstep.paper.printed import TABLE_1, TABLE_2
from misstep.paper.results import Results
from misstep.paper.videos import Video

_MIME = {".png": "image/png", ".mp4": "video/mp4"}


def render(
    document: dict[str, Any],
    claims: Sequence[Claim],
    results: Results,
    figures: Path,
    videos: Sequence[Video],
) -> str:
    """Return the page.

    Parameters
    ----------
    document : dict
        What ``tables.json`` holds.
    claims : sequence of Claim
    results : Results
    figures : Path
        Folder of the PNG files.
    videos : sequence of Video
    """
    template = files("misstep.paper").joinpath("report.html.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["verdict_class"] = lambda verdict: verdict.replace(" ", "-")
    shown = results.demonstration_costs("without-reward")
    explored = results.costs("without-reward")
    return environment.from_string(template).render(
        document=document,
        claims=claims,
        verdicts=Counter(claim.verdict for claim in claims).most_common(),
        figure=lambda name: _data_url(figures / f"{name}.png"),
        videos=[
            (_data_url(v.path), f"{v.title}: {v.trajectory.mean_cost:.0f}° over 30 s")
            for v in videos
        ],
        calibrations=CALIBRATIONS,
        synthetic=synthetic,
        headline={
            "demonstrations": shown[:, :, 0].mean(),
            "explorations": explored[:, :, 0].mean(),
            "paper_demonstrations": TABLE_1[:, 0].mean(),
            "paper_explorations": TABLE_2[:, 0].mean(),
            "trials": sum(row["explorations"] for row in document["tables"]["variants"]),
            "successes": sum(row["successes"] for row in document["tables"]["variants"]),
        },
    )


def _data_url(path: Path) -> Markup:
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    return Markup(f"data:{_MIME[path.suffix]};base64,{content}")  # noqa: S704 - base64 is inert
