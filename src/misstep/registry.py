"""Names for things that can be added from outside: systems, demonstrators, learners, formats.

A registry knows what misstep brings along and what installed packages announce through an entry
point of the registry's group, so that a third-party learner is one file and one line of
registration, there as here.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from misstep.errors import MisstepError, reason_of

T = TypeVar("T")


class UnknownNameError(MisstepError, KeyError):
    """There is no entry of that name."""

    __str__ = ValueError.__str__  # a KeyError would quote its message


class Registry(Mapping[str, T], Generic[T]):
    """A mapping from names to things of one kind.

    Parameters
    ----------
    kind : str
        What an entry is, in the singular, for error messages: ``"learner"``.
    group : str
        Entry-point group under which other packages announce theirs: ``"misstep.learners"``.
    """

    def __init__(self, kind: str, group: str) -> None:
        self.kind = kind
        self.group = group
        self._own: dict[str, T] = {}

    def register(self, name: str) -> Callable[[T], T]:
        """Return a decorator that enters what it decorates under `name`.

        Raises
        ------
        MisstepError
            If `name` is taken.
        """

        def enter(entry: T) -> T:
            if name in self._own:
                raise MisstepError(f"there is a {self.kind} named {name!r} already")
            self._own[name] = entry
            return entry

        return enter

    def __getitem__(self, name: str) -> T:
        """Return an entry.

        Raises
        ------
        UnknownNameError
            If there is none; it is a MisstepError and a KeyError.
        MisstepError
            If the package that announces it cannot be loaded.
        """
        if name in self._own:
            return self._own[name]
        if name in (announced := _announced(self.group, tuple(sys.path))):
            return self._load(announced[name])
        raise UnknownNameError(f"no {self.kind} named {name!r}; there are: {', '.join(self)}")

    def _load(self, point: EntryPoint) -> T:
        try:
            entry: T = point.load()
        except Exception as error:  # whatever somebody else's module raises on being imported
            raise MisstepError(
                f"the {self.kind} {point.name!r} is {point.value} of an installed package, which "
                f"cannot be loaded ({reason_of(error)}): mend or uninstall that package"
            ) from error
        return entry

    def __contains__(self, name: object) -> bool:
        return any(name == known for known in self)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._own, *_announced(self.group, tuple(sys.path))}))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def loaded(self) -> tuple[dict[str, T], dict[str, str]]:
        """Return the entries that can be loaded, and what is wrong with each that cannot."""
        entries: dict[str, T] = {}
        broken: dict[str, str] = {}
        for name in self:
            try:
                entries[name] = self[name]
            except MisstepError as error:
                broken[name] = str(error)
        return entries, broken


@cache  # looking through the installed packages takes longer than writing a trajectory
def _announced(group: str, places: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Return what the packages in those places announce, by name."""
    return {point.name: point for point in entry_points(group=group)}
