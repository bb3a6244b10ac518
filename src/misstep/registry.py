"""Names for things that can be added from outside: systems, demonstrators, learners, formats.

A registry knows what misstep brings along and what installed packages announce through an entry
point of the registry's group, so that a third-party learner is one file and one line of
registration, there as here.
"""

from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points
from typing import Generic, TypeVar

from misstep.errors import MisstepError, reason_of

T = TypeVar("T")


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
        """Return an entry; raise MisstepError if there is none or its package cannot be loaded."""
        if name in self._own:
            return self._own[name]
        for point in entry_points(group=self.group):
            if point.name == name:
                try:
                    entry: T = point.load()
                except (ImportError, AttributeError) as error:
                    raise MisstepError(
                        f"the {self.kind} {name!r} is {point.value} of an installed package, which "
                        f"cannot be loaded ({reason_of(error)}): mend or uninstall that package"
                    ) from error
                return entry
        raise MisstepError(f"no {self.kind} named {name!r}; there are: {', '.join(self)}")

    def __contains__(self, name: object) -> bool:
        return any(name == known for known in self)

    def __iter__(self) -> Iterator[str]:
        names = set(self._own) | {point.name for point in entry_points(group=self.group)}
        return iter(sorted(names))

    def __len__(self) -> int:
        return sum(1 for _ in self)
