"""What a person has recorded of one system, in files; every change can be taken back.

::

    attempts.h5              what was kept, in the order in which it was
    pending.h5               an attempt that has ended, until it is kept or thrown away
    undo/0001-delete-3.h5    episode 3 before the first change, and so on

The copy in ``undo`` is written before the file, each in a single step. A process killed in between
leaves a copy of something that has not changed, which is recognised by that and passed over. An
attempt that is added is appended and changes the number of no other, so changes are taken back in
the reverse of their order, whatever was recorded since.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from misstep.errors import MisstepError
from misstep.formats import append_trajectory, load_dataset, save_dataset
from misstep.recordings.marking import Mark, marked
from misstep.storage import make_folder
from misstep.trajectory import Dataset, Trajectory

ATTEMPTS, PENDING, UNDO = "attempts.h5", "pending.h5", "undo"
_CHANGE = re.compile(r"(\d{4,})-(delete|mark)-(\d+)\.h5", re.ASCII)

MOST = 500
"""Attempts that are kept of one system: more than anybody makes by hand in a day."""


class Kept(NamedTuple):
    """An attempt that has been kept."""

    id: int
    """Its own for as long as the server runs; not its place in the file."""
    trajectory: Trajectory


class Attempts:
    """The attempts at one system.

    Parameters
    ----------
    folder : Path
        Made if there is none.

    Raises
    ------
    MisstepError
        If the folder cannot be made or a file in it is damaged.
    """

    def __init__(self, folder: Path) -> None:
        make_folder(folder / UNDO)
        self.folder = folder
        self.path = folder / ATTEMPTS
        self._last_id = 0
        held = load_dataset(self.path) if self.path.exists() else ()
        self._kept = [self._numbered(trajectory) for trajectory in held]
        pending = folder / PENDING
        self.pending = load_dataset(pending)[0] if pending.exists() else None
        # Killed between keeping it and taking it off the desk: it is kept.
        if self.pending is not None and self._kept and self._kept[-1].trajectory == self.pending:
            self._clear_pending()

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[Kept]:
        return iter(self._kept)

    def __getitem__(self, id: int) -> Trajectory:
        return self._kept[self._place(id)].trajectory

    @property
    def dataset(self) -> Dataset:
        """All that was kept.

        Raises
        ------
        MisstepError
            If that is nothing.
        """
        if not self._kept:
            raise MisstepError("nothing has been kept yet: fail a few times first, and press Enter")
        return Dataset(kept.trajectory for kept in self._kept)

    def put_aside(self, trajectory: Trajectory) -> None:
        """Hold an attempt that has ended until `keep` or `discard`; it is in a file by then.

        Raises
        ------
        MisstepError
            If the disk refuses it; it is held in memory then.
        """
        self.pending = trajectory  # also where the disk refuses it
        save_dataset(Dataset([trajectory]), self.folder / PENDING)

    def keep(self) -> int | None:
        """Keep the pending attempt, if there is one, and return its id."""
        if self.pending is None:
            return None
        id = self.add([self.pending])[0]
        self._clear_pending()
        return id

    def discard(self) -> None:
        """Throw the pending attempt away; `undo` brings it back."""
        if self.pending is None:
            return
        self._remember("delete", len(self._kept), self.pending)
        self._clear_pending()

    def add(self, trajectories: Sequence[Trajectory]) -> list[int]:
        """Append attempts, and return their ids.

        Raises
        ------
        MisstepError
            If they have other columns, or there would be too many.
        """
        if len(self) + len(trajectories) > MOST:
            raise MisstepError(
                f"there are {len(self)} attempts and at most {MOST} are kept here: download them "
                "and delete some first"
            )
        added = [self._numbered(trajectory) for trajectory in trajectories]
        if len(added) == 1:
            append_trajectory(self.path, trajectories[0])
            self._kept += added
        else:
            self._save([*self._kept, *added])
        return [kept.id for kept in added]

    def delete(self, id: int) -> None:
        """Delete an attempt; `undo` brings it back."""
        place = self._place(id)
        self._remember("delete", place, self._kept[place].trajectory)
        self._save(self._kept[:place] + self._kept[place + 1 :])

    def mark(self, id: int, mark: Mark) -> None:
        """Say what became of an attempt; `undo` takes it back.

        Raises
        ------
        MisstepError
            If the mark does not fit it.
        """
        place = self._place(id)
        before = self._kept[place].trajectory
        after = marked(before, mark)
        if after == before:
            return
        self._remember("mark", place, before)
        self._save([*self._kept[:place], Kept(id, after), *self._kept[place + 1 :]])

    @property
    def can_undo(self) -> bool:
        """Whether there is a change that can be taken back."""
        return bool(self._changes())

    def undo(self) -> str:
        """Take the last change back, and return what it was.

        Raises
        ------
        MisstepError
            If there is none.
        """
        for file, what, place in reversed(self._changes()):
            before = load_dataset(file)[0]
            changed = self._taken_back(what, min(place, len(self._kept)), before)
            if changed is not None:
                self._save(changed)
            file.unlink()
            if changed is not None:
                return "the attempt is back" if what == "delete" else "the mark is taken back"
        raise MisstepError("there is nothing to take back")

    def _taken_back(self, what: str, place: int, before: Trajectory) -> list[Kept] | None:
        """Return the attempts as they were; None if the change was never made, or all is gone."""
        kept = self._kept
        if place < len(kept) and kept[place].trajectory == before:
            return None
        if what == "delete":
            return [*kept[:place], self._numbered(before), *kept[place:]]
        if place == len(kept):
            return None
        return [*kept[:place], Kept(kept[place].id, before), *kept[place + 1 :]]

    def _numbered(self, trajectory: Trajectory) -> Kept:
        self._last_id += 1
        return Kept(self._last_id, trajectory)

    def _place(self, id: int) -> int:
        for place, kept in enumerate(self._kept):
            if kept.id == id:
                return place
        raise MisstepError("that attempt is not there any more")

    def _save(self, kept: list[Kept]) -> None:
        if kept:
            save_dataset(Dataset(k.trajectory for k in kept), self.path)
        elif self.path.exists():
            self.path.unlink()
        self._kept = kept

    def _remember(self, what: str, place: int, before: Trajectory) -> None:
        changes = self._changes()
        number = 1 + (int(changes[-1][0].name.partition("-")[0]) if changes else 0)
        file = self.folder / UNDO / f"{number:04d}-{what}-{place}.h5"
        save_dataset(Dataset([before]), file)

    def _changes(self) -> list[tuple[Path, str, int]]:
        """Return file, what and place of every change, first to last."""
        folder = self.folder / UNDO
        found = [m for path in folder.glob("*.h5") if (m := _CHANGE.fullmatch(path.name))]
        found.sort(key=lambda m: int(m[1]))
        return [(folder / m[0], m[2], int(m[3])) for m in found]

    def _clear_pending(self) -> None:
        (self.folder / PENDING).unlink(missing_ok=True)
        self.pending = None
