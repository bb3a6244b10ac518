"""Hostile input for everything that misstep reads: drawn, handed in, judged, counted.

A *target* is one place where input of others comes in: a reader, a configuration, a protocol, an
estimator. A *case* is one hostile input, determined by the target's name, a seed and a number, so
that any finding can be had again. Each case has to end with an answer or with a `MisstepError` of
one line; anything else is a *finding*: another exception, a crash of the process, too much time or
too much memory.

::

    damage, structures    draw hostile bytes, texts, JSON, tables, HDF5 members
    readers, settings,    the targets; each opens its place once and tries many cases there
    messages, estimators
    cases                 one case: its generator, and what became of it
    workers               forked processes with limits that try slices of a target's cases
    campaign              all slices of all targets in turn, within a budget; counts on disk
"""

import os

for _library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
    # Before any of them is loaded: workers are forked, which is safe where there is one thread.
    os.environ[f"{_library}_NUM_THREADS"] = "1"
