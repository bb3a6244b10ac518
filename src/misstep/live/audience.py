"""The pages that are connected: one of them drives, the others watch."""

from collections.abc import Iterator
from typing import Protocol


class Listener(Protocol):
    """A page that is connected."""

    def news(self, message: str) -> None:
        """Send a message; none is left out."""

    def frame(self, message: str) -> None:
        """Send a state, in place of one that has not been sent yet."""


class Audience:
    """The pages, in the order in which they came."""

    def __init__(self) -> None:
        self._listeners: list[Listener] = []
        self.driver: Listener | None = None

    def __iter__(self) -> Iterator[Listener]:
        return iter(self._listeners)

    def join(self, listener: Listener) -> bool:
        """Add a page; return whether it drives, as it does if none did."""
        self._listeners.append(listener)
        if self.driver is None:
            self.driver = listener
        return self.driver is listener

    def leave(self, listener: Listener) -> bool:
        """Take a page away; return whether it drove, which the one that came first then does."""
        self._listeners.remove(listener)
        if self.driver is not listener:
            return False
        self.driver = self._listeners[0] if self._listeners else None
        return True

    def news(self, message: str) -> None:
        """Send a message to all."""
        for listener in self._listeners:
            listener.news(message)

    def frame(self, message: str) -> None:
        """Send a state to all."""
        for listener in self._listeners:
            listener.frame(message)
