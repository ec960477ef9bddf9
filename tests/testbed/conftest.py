"""A page in this process, and browsers that look at it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from robot_ik.testbed.commands import Command, Start
from robot_ik.testbed.session import Session, View, run

PATIENCE = 90.0
"""A safety limit for what a browser without a GPU does on a busy machine, seconds."""


@dataclass
class Bed:
    """A session with its page, running in real time on a thread."""

    session: Session
    page: Any
    sent: list[Command] = field(default_factory=list)

    @property
    def view(self) -> View:
        return self.page._view

    def until(self, holds: Callable[[View], Any], what: str = "", limit: float = PATIENCE) -> View:
        """Waits until the session is so; fails with what it was waiting for."""
        deadline = time.monotonic() + limit
        while not holds(self.view):
            assert time.monotonic() < deadline, what or "the session never came to that"
            time.sleep(0.02)
        return self.view

    def count(self, kind: type[Command]) -> int:
        return sum(isinstance(command, kind) for command in self.sent)


def serve(start: Start, **options: Any) -> Iterator[Bed]:
    pytest.importorskip("viser", reason="needs the extra web")
    from robot_ik.testbed.frontends.browser import Page

    stop = threading.Event()
    with Session(start) as session:
        bed = Bed(session, None)
        real = session.send

        def send(command: Command) -> None:
            bed.sent.append(command)
            real(command)

        session.send = send  # type: ignore[method-assign]
        with Page(session, port=8610, shadows=False, **options) as page:
            bed.page = page
            loop = threading.Thread(  # drawn at 15 Hz: a browser without a GPU is no quicker
                target=run, args=(session, page.draw, stop), kwargs={"every": 4}, name="testbed-loop"
            )
            loop.start()
            try:
                yield bed
            finally:
                stop.set()
                loop.join(PATIENCE)


@pytest.fixture(scope="module")
def bed() -> Iterator[Bed]:
    yield from serve(Start())
