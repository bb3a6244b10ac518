"""The mixture of what was recorded, which the page draws on its plane.

The worker fits it whenever the recordings change. Changes that come while it does are taken
together, so that a hundred of them are two fits.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from misstep.errors import MisstepError
from misstep.live.worker import StoppedError, Worker


class Description:
    """The mixture of a file of recordings.

    Parameters
    ----------
    worker : Worker
    path : Path
        Of the recordings; nothing is described while there is no such file.
    changed : callable
        Called when there is another mixture.
    **job
        What else the worker's job ``describe`` takes.
    """

    def __init__(self, worker: Worker, path: Path, changed: Callable[[], None], **job: Any) -> None:
        self._worker = worker
        self._path = path
        self._job = {"attempts": str(path), **job}
        self._changed = changed
        self._stale = False
        self._cut_short = False
        self._fitting: asyncio.Task[None] | None = None
        self.model = "null"
        """As JSON; ``null`` where there is none."""

    def renew(self) -> None:
        """Have it fitted to what is recorded now; to be called in an event loop."""
        self._stale = True
        if self._fitting is None or self._fitting.done():
            self._fitting = asyncio.get_running_loop().create_task(self._fit())

    def catch_up(self) -> None:
        """Have it fitted if the worker was stopped while it did that."""
        if self._cut_short:
            self.renew()

    async def _fit(self) -> None:
        while self._stale:
            self._stale = self._cut_short = False
            model = "null"
            if self._path.exists():
                try:
                    model = await self._worker.do("describe", **self._job)
                except StoppedError:
                    self._cut_short = True
                except MisstepError:
                    pass  # a mixture that cannot be fitted is not shown, and learning will say why
            if not self._stale and model != self.model:
                self.model = model
                self._changed()
