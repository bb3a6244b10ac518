"""A clock that does not drift: ticks are due at multiples of a period, however late one comes."""

import asyncio
import time

LATE = 0.5
"""A tick is late that comes later than this share of its period."""

_FORGIVEN = 10  # periods; who has slept for longer does not catch up


class Clock:
    """Waits for ticks and counts those that come late.

    Parameters
    ----------
    period : float, s
        Of wall-clock time.
    """

    def __init__(self, period: float) -> None:
        self.late = 0
        self.ticks = 0
        self.period = period
        self.restart()

    def restart(self) -> None:
        """Have the next tick be due one period from now."""
        self._due = time.monotonic()

    async def tick(self) -> None:
        """Wait for the next tick."""
        self._due += self.period
        # Also when it is late: others have to have their turn.
        await asyncio.sleep(max(0.0, self._due - time.monotonic()))
        self.ticks += 1
        behind = time.monotonic() - self._due
        if behind > LATE * self.period:
            self.late += 1
        if behind > _FORGIVEN * self.period:
            self.restart()
