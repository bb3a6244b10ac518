"""The report: one self-contained HTML file, pictures and videos inside."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from misstep.pages import data_url, render_page
from misstep.paper import synthetic
from misstep.paper.calibration import CALIBRATIONS
from misstep.paper.claims import Claim
from misstep.paper.experiments import PHYSICS
from misstep.paper.printed import TABLE_1, TABLE_2
from misstep.paper.results import Results
from misstep.paper.videos import Video


def render(
    document: dict[str, Any],
    claims: Sequence[Claim],
    results: Results,
    figures: Path,
    videos: Sequence[Video],
    sequel_video: Path,
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
    sequel_video : Path
    """
    shown = results.demonstration_costs("without-reward")
    explored = results.costs("without-reward")
    return render_page(
        "paper/report.html.j2",
        document=document,
        claims=claims,
        verdicts=Counter(claim.verdict for claim in claims).most_common(),
        figure=lambda name: data_url(figures / f"{name}.png"),
        sequel_video=data_url(sequel_video),
        videos=[
            (data_url(v.path), f"{v.title}: {v.trajectory.mean_cost:.0f}° over 30 s")
            for v in videos
        ],
        calibrations=CALIBRATIONS,
        synthetic=synthetic,
        engine=PHYSICS[results.physics].title,
        headline={
            "demonstrations": shown[:, :, 0].mean(),
            "explorations": explored[:, :, 0].mean(),
            "paper_demonstrations": TABLE_1[:, 0].mean(),
            "paper_explorations": TABLE_2[:, 0].mean(),
            "trials": sum(row["explorations"] for row in document["tables"]["variants"]),
            "successes": sum(row["successes"] for row in document["tables"]["variants"]),
        },
    )
