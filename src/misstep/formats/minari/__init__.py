"""Data sets of Farama's Minari, through its own library: https://minari.farama.org.

A data set is a folder with ``data/metadata.json``, and the episodes beside that in HDF5, Arrow or
Parquet. Its name, such as ``cartpole/failed-v0``, is its place under Minari's folder of data sets
(``MINARI_DATASETS_PATH``, or ``~/.minari/datasets``): ``minari:cartpole/failed-v0`` stands for
that place. Nothing is ever downloaded.

Reading: the numbers of the observation space, however nested, are the observations, those of the
action space the actions; images and texts are left out, and noted. Costs are the rewards with the
sign turned. An episode whose infos hold ``success`` succeeded if that is ever true, and failed if
not. Minari does not know how much time passes between observations: for data sets of others that
has to be said.

Writing: one `Box` of observations and one of actions, both float64. Infos hold ``success`` (true
at the end of a success) and ``failure`` (true from the failure step on), T + 1 each; what Minari
has no place for stands in the metadata of each episode under ``misstep``. Rewards are the costs
with the sign turned, zero where none were recorded.

The library handles an episode whole, so here one has to fit into memory. It also imports whatever
a data set names as its environment if that lacks spaces; such a data set is refused.
"""

from functools import partial

from misstep.formats.format import Format
from misstep.formats.minari.names import SCHEME, located, recognise
from misstep.formats.minari.reading import read
from misstep.formats.minari.writing import write

__all__ = ["ARROW", "FORMAT", "SCHEME", "located"]

FORMAT = Format(
    "Minari data set, HDF5 inside",
    (".minari",),
    read,
    write,
    is_folder=True,
    recognise=recognise,
    extra="minari",
)
ARROW = Format(
    "Minari data set, Arrow inside",
    (),
    read,
    partial(write, storage="arrow"),
    is_folder=True,
    extra="minari",
)
