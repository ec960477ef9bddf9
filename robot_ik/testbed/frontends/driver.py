"""The driver rule: one page drives, all others watch."""

from __future__ import annotations

from collections.abc import Callable


class Driver:
    """Decides which page may change the session. Every page may send STOP.

    A page has two sockets: the one of viser and its channel. Both name the page by the same key.

    Attributes:
        page: Key of the page that drives. None: the next page that acts drives.
        on_change: Called when another page drives, or none.
        on_leave: Called when the driving page disconnects or hands over.
    """

    def __init__(self) -> None:
        self.page: str | None = None
        self.on_change: Callable[[], None] = lambda: None
        self.on_leave: Callable[[], None] = lambda: None

    def admits(self, page: str) -> bool:
        """Return whether a page may change the session. Without a driver, it becomes the driver."""
        if self.page is None:
            self.page = page
            self.on_change()
        return self.page == page

    def rename(self, old: str, new: str) -> None:
        """Give the page that drives another key."""
        if self.page == old:
            self.page = new

    def leave(self, page: str) -> None:
        """Remove a page that has disconnected. If it drove, no page drives."""
        if self.page == page:
            self.hand_over()

    def hand_over(self) -> None:
        """Let the next page that acts drive."""
        self.page = None
        self.on_leave()
        self.on_change()
