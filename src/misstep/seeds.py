"""Streams of random numbers of one seed, each with a name, so that no two are the same by chance.

The trials of a run are numbered from 0; a stream for anything else has a key that no number of a
trial reaches.
"""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """What a stream of random numbers is for, beside the trials of a run."""

    TEST = int.from_bytes(b"test", "big")
    """Where the attempts of an evaluation start."""
    DRIVE = int.from_bytes(b"drive", "big")
    """The attempts in which a robot is driven by a policy that is not learned from."""


def stream_of(seed: int, stream: Stream, *index: int) -> np.random.SeedSequence:
    """Return a stream of a seed; `index` numbers several of one kind."""
    return np.random.SeedSequence(seed, spawn_key=(int(stream), *index))
