"""Folders of LeRobot's data sets, v2.1 and v3.0, through pyarrow alone.

::

    meta/info.json                         fps, features: dtype, shape and names of each column
    meta/tasks.jsonl, tasks.parquet        what was to be done (v2.1, v3.0)
    meta/episodes.jsonl, episodes_stats.jsonl                       (v2.1)
    meta/episodes/chunk-000/file-000.parquet, meta/stats.json       (v3.0)
    data/chunk-000/episode_000000.parquet  one episode a file       (v2.1)
    data/chunk-000/file-000.parquet        many episodes a file     (v3.0)
    videos/...                             left alone

A row is what was seen and what was done then; the observation after the last action is missing.
So reading drops the last action of an episode: T rows make T observations and T - 1 actions.
Writing does the opposite: the final observation is a row of its own, in which the last action
stands a second time. Going out and back is therefore whole.

Reading: all numbers of ``observation.*`` are the observations, with the names that the features
give them. Costs are ``next.reward`` with the sign turned. An episode succeeded if ``next.success``
is ever true, and failed if it is there and never true. The task is kept as a parameter of the
provenance. Images and videos are left out, and noted.

Writing: single precision, as LeRobot expects, and a whole number of rows a second. What LeRobot
has no place for stands in ``meta/misstep.jsonl``, a line for each episode.
"""

from functools import partial

from misstep.formats.format import Format, Header
from misstep.formats.lerobot.files import recognise
from misstep.formats.lerobot.reading import read
from misstep.formats.lerobot.writing import write


def losses(header: Header) -> tuple[str, ...]:
    """Return what a data set of LeRobot's cannot hold."""
    return ("digits beyond single precision (about 7): LeRobot's numbers are float32",)


FORMAT = Format(
    "LeRobot data set, v3.0 (reads v2.x too)",
    (".lerobot",),
    read,
    write,
    losses=losses,
    is_folder=True,
    recognise=recognise,
    extra="lerobot",
)
V21 = Format(
    "LeRobot data set, v2.1",
    (),
    read,
    partial(write, version="v2.1"),
    losses=losses,
    is_folder=True,
    extra="lerobot",
)
