"""Files with damage, for readers that have to refuse it or make something of it."""

import os
import shutil
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st

from misstep import MisstepError
from misstep.formats import read_episodes


def fuzzed(usual):
    """Return how many damaged inputs to try: `usual`, or what a nightly run asks for."""
    told = os.environ.get("MISSTEP_FUZZED_INPUTS")
    return int(told) if told else usual * settings().max_examples // 100


@st.composite
def mutations(draw):
    """Draw a function from bytes to damaged bytes, and which file of a folder it is for."""
    place = st.floats(0, 1, exclude_max=True)
    flips = draw(st.lists(st.tuples(place, st.integers(1, 255)), max_size=5))
    cut = draw(st.none() | st.tuples(place, st.integers(1, 30)))
    end = draw(st.none() | place)

    def mutate(whole):
        data = bytearray(whole)
        for where, change in flips:
            data[int(where * len(data))] ^= change
        if cut is not None:
            start = int(cut[0] * len(data))
            del data[start : start + cut[1]]
        if end is not None:
            del data[int(end * len(data)) :]
        return bytes(data)

    return mutate, draw(place)


def read_or_refused(path, **options):
    """Go through all episodes; anything raised but a MisstepError of one line passes through."""
    try:
        for episode in read_episodes(path, **options):
            for _ in episode.blocks:
                pass
            episode.ending()
    except MisstepError as error:
        message = str(error)
    else:
        return True
    assert message
    assert "\n" not in message
    return False


def survives(whole, copy, mutation, **options):
    """Damage one file of a copy of `whole`, a file or a folder, and read it."""
    mutate, place = mutation
    whole, copy = Path(whole), Path(copy)
    if whole.is_file():
        copy.write_bytes(mutate(whole.read_bytes()))
        return read_or_refused(copy, **options)
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(whole, copy)
    files = sorted(file for file in copy.rglob("*") if file.is_file())
    victim = files[int(place * len(files))]
    victim.write_bytes(mutate(victim.read_bytes()))
    return read_or_refused(copy, **options)
