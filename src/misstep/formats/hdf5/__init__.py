"""misstep's own files: HDF5 in Minari's episode layout, with what Minari does not say beside it.

::

    /            attributes misstep_format, dt, observation_columns, action_columns (JSON lists
                 of [name, unit]), total_episodes, total_steps
    /episode_0   attributes id, total_steps, seed (if any), system, parameters (JSON),
                 demonstrator, time, notes (JSON list, if any), outcome, failure_step (if
                 any), costs_recorded
      observations (T + 1, n) float64    terminations (T,) bool
      actions      (T, m)     float64    truncations  (T,) bool
      rewards      (T,)       float64    infos        an empty group
    /episode_1   ...

Rewards are the costs with the sign turned, or zeros where no costs were recorded. The last step
of an episode is a termination if it failed there, and otherwise a truncation. How arrays are
stored says `misstep.formats.hdf5.arrays`. Equal data sets give equal files.

A file may come from anywhere, so reading takes nothing on trust: no size that is declared is
believed before as much is there, and episodes pass in blocks, whatever their length. Nothing is
written in place: a file is made beside the old one and takes its place when it is whole.
"""

from misstep.formats.format import Format
from misstep.formats.hdf5.reading import read, recognise
from misstep.formats.hdf5.writing import append, write

FORMAT = Format(
    description="misstep's own: HDF5 in Minari's episode layout; loses nothing",
    suffixes=(".h5", ".hdf5"),
    read=read,
    write=write,
    append=append,
    recognise=recognise,
)
