"""How long each exchange took, in memory that does not grow."""

import math

_PER_OCTAVE = 8
_SHORTEST = 1e-7  # s
_BINS = _PER_OCTAVE * 30  # up to 107 s


class Cadence:
    """Counts durations in bins that are 9 % wide.

    Attributes
    ----------
    n : int
        Durations so far.
    longest : float, s
    """

    def __init__(self) -> None:
        self.n = 0
        self.longest = 0.0
        self._counts = [0] * _BINS

    def add(self, seconds: float) -> None:
        """Count a duration."""
        self.n += 1
        if seconds > self.longest:
            self.longest = seconds
        octaves = math.log2(seconds / _SHORTEST) if seconds > _SHORTEST else 0.0
        index = int(octaves * _PER_OCTAVE)
        self._counts[index if index < _BINS else -1] += 1

    def quantile(self, q: float) -> float | None:
        """Return a duration [s] that the share `q` did not exceed, to a bin; None before any."""
        if self.n == 0:
            return None
        rest = q * self.n
        for index, count in enumerate(self._counts):
            rest -= count
            if rest <= 0:
                bound = _SHORTEST * 2.0 ** ((index + 1) / _PER_OCTAVE)
                return min(bound, self.longest)
        return self.longest
