"""The testbed in a cell of a notebook."""

from __future__ import annotations

import contextlib
import html
import threading

from robot_ik.ports import Closing
from robot_ik.testbed.commands import Command, Start
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.gate import LOOPBACK_PAGES
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session


class NotebookPage(Closing):
    """The testbed as an object that a notebook shows as the page.

        page = NotebookPage(Start("puma560", count=4))
        page            # the last line of a cell: the page appears below it
        page.send(MoveGoal((-0.45, -0.10, 0.80)))
        page.close()

    The browser of the notebook must run on this machine: the page listens at loopback only. Pages
    of other servers on this machine may show it in a frame, so a session with an arm is not
    possible here.

    Args:
        start: What the session begins with.
        port: The next free port is taken if it is busy.
        height: Of the frame, px.

    Attributes:
        url: Address of the page.

    Raises:
        ViewerError: Another viser than 1.1, or the address cannot be used.
    """

    def __init__(self, start: Start | None = None, *, port: int = 8080, height: int = 640) -> None:
        self.height = height
        with contextlib.ExitStack() as stack:
            self._session = stack.enter_context(Session(start or Start()))
            server = PageServer(port=port, framed_by=LOOPBACK_PAGES)
            page = stack.enter_context(Page(self._session, server))
            self._opened = stack.pop_all()
        self.url = page.url
        self._stop = threading.Event()
        arguments = (self._session, page.draw, self._stop)
        self._loop = threading.Thread(target=run, args=arguments, daemon=True)
        self._loop.start()

    def send(self, command: Command) -> None:
        """Send a command, as a front end does."""
        self._session.send(command)

    def _repr_html_(self) -> str:
        """Return the frame with the page, for a notebook."""
        address = html.escape(self.url)
        return (
            f'<iframe src="{address}" width="100%" height="{self.height}" '
            'style="border: 0" title="robot_ik testbed"></iframe>'
        )

    def close(self) -> None:
        """End the session and stop the server."""
        self._stop.set()
        self._loop.join()
        self._opened.close()
