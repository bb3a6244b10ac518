"""Blocks of one episode, joined and cut anew."""

from collections.abc import Iterable, Iterator

import numpy as np

from misstep.formats.format import Block, FloatArray


def aligned(blocks: Iterable[Block], *, has_actions: bool) -> Iterator[Block]:
    """Yield blocks of as many actions as observations, but for the last, with one action less.

    Where there are no actions, every block has none, and the last one is a single observation.

    Parameters
    ----------
    blocks : iterable of Block
        Of one episode.
    has_actions : bool
    """
    kept: Block | None = None
    for block in blocks:
        whole = block if kept is None else followed(kept, block)
        count = max(0, len(whole.observations) - 1)
        if has_actions:
            count = min(count, len(whole.actions))
        if whole.costs is not None:
            count = min(count, len(whole.costs))
        kept = _cut(whole, slice(count, None))
        if count > 0:
            yield _cut(whole, slice(count))
    if kept is not None:
        yield kept


def followed(a: Block, b: Block) -> Block:
    """Return two blocks, one after the other, as one."""

    def both(x: FloatArray | None, y: FloatArray | None) -> FloatArray | None:
        return None if x is None or y is None else np.concatenate([x, y])

    return Block(
        np.concatenate([a.observations, b.observations]),
        np.concatenate([a.actions, b.actions]),
        both(a.costs, b.costs),
        both(a.times, b.times),
    )


def _cut(block: Block, rows: slice) -> Block:
    return Block(
        block.observations[rows],
        block.actions[rows],
        None if block.costs is None else block.costs[rows],
        None if block.times is None else block.times[rows],
    )
