"""Sessions with their page in this process, a browser, and a screen for windows."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot_ik.testbed.arm import ArmLink
from robot_ik.testbed.commands import Command, Start
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View
from tests.testbed.browser_window import SMOOTHING_OFF, measure_page
from tests.waiting import LONG

VIEWS = 900
"""Views that a test waits for a condition: 60 s of a loop that draws at 15 Hz."""


@dataclass
class Bed:
    """A session with its page, running in real time on a thread."""

    session: Session
    page: Any
    sent: list[Command] = field(default_factory=list)

    @property
    def view(self) -> View:
        return self.page._view

    def until(
        self, holds: Callable[[View], Any], failure: str = "the condition never held"
    ) -> View:
        """Return the first view for which ``holds(view)``.

        Fail with ``failure`` after ``VIEWS`` others. Views during a preparation do not count, and
        a loop that compiles draws none.
        """
        end = time.monotonic() + LONG
        count = 0
        last = None
        while not holds(view := self.view):
            count += view is not last and not view.busy
            last = view
            assert count < VIEWS and time.monotonic() < end, failure
            time.sleep(0.005)
        return view

    def apply(self, *commands: Command) -> View:
        """Send commands and return the first view in which all of them have taken effect.

        The next view may be older than the commands. The view after it is not.
        """
        for command in commands:
            self.session.send(command)
        for _ in range(2):
            before = self.view
            self.until(lambda view, before=before: view is not before, "the loop does not draw")
        return self.until(lambda view: not view.busy, "the commands were never prepared")

    def count(self, kind: type[Command]) -> int:
        return sum(isinstance(command, kind) for command in self.sent)


@contextlib.contextmanager
def looped(session: Session, page: Any) -> Iterator[None]:
    """Run the loop of a session on a thread during the block.

    It draws at 15 Hz: a browser without a GPU is not faster.
    """
    stop = threading.Event()
    loop = threading.Thread(
        target=run, args=(session, page.draw, stop), kwargs={"every": 4}, name="testbed-loop"
    )
    loop.start()
    try:
        yield
    finally:
        stop.set()
        loop.join()


def plain_server(port: int, *, token: bool = False) -> Any:
    """Return a server whose page software draws fast: no shadows, no reflected surroundings.

    A browser without a GPU takes 4 s of a core for the surroundings of each page that it loads.
    The test of the notebook loads a page with them.
    """
    from robot_ik.testbed.frontends.page_server import PageServer

    page_server = PageServer(port=port, shadows=False, token=token)
    page_server.server.scene.configure_environment_map(None)
    return page_server


@contextlib.contextmanager
def running_bed(start: Start, port: int, arm: ArmLink | None = None) -> Iterator[Bed]:
    """Yield a session with its page and its loop, after the first tick."""
    from robot_ik.testbed.frontends.browser import Page

    with (
        Session(start, arm=arm) as session,
        Page(session, plain_server(port)) as page,
        looped(session, page),
    ):
        bed = Bed(session, page)
        bed.until(lambda view: view.tick > 0, "the kernels were never ready")
        yield bed


@pytest.fixture
def session() -> Session:
    """A session without a window or a thread."""
    return Session(Start(), beside=False)


@pytest.fixture(scope="session")
def _opened() -> Iterator[Bed]:
    """A session with its page, whose loop does not run yet."""
    pytest.importorskip("viser", reason="needs the extra web")
    from robot_ik.testbed.frontends.browser import Page

    with Session(Start()) as session:
        bed = Bed(session, None)
        real = session.send

        def send(command: Command) -> None:
            bed.sent.append(command)
            real(command)

        session.send = send  # type: ignore[method-assign]
        with Page(session, plain_server(8610)) as page:
            bed.page = page
            yield bed


@pytest.fixture(scope="module")
def bed(_opened: Bed) -> Iterator[Bed]:
    """The page with its loop, which stops at the end of a file to free the processor."""
    with looped(_opened.session, _opened.page):
        yield _opened


@pytest.fixture(scope="session")
def guarded(_opened: Bed) -> Iterator[Any]:
    """Another page of the same session, which asks for its token."""
    from robot_ik.testbed.frontends.browser import Page

    with Page(_opened.session, plain_server(8611, token=True)) as page:
        yield page


@pytest.fixture(scope="module")
def chromium(require: Callable[..., str]) -> Iterator[Any]:
    """A headless Chromium, driven by Playwright."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright (the extra dev)")
    path = require("browser", "opens the page")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=path, args=[*measure_page.CHROMIUM, SMOOTHING_OFF]
        )
        yield browser
        browser.close()


@dataclass(frozen=True)
class Screen:
    """An X server whose frame buffer is a file."""

    display: str
    file: Path

    def shot(self) -> Any:
        """The whole screen, (h, w, 3) uint8; the file is in XWD format, version 7."""
        raw = self.file.read_bytes()
        header = np.frombuffer(raw[:100], ">u4")
        size, width, height, stride, colours = (int(header[k]) for k in (0, 4, 5, 12, 19))
        pixels = np.frombuffer(raw, np.uint8, stride * height, size + 12 * colours)
        return pixels.reshape(height, stride // 4, 4)[:, :width, :3].copy()

    def settled(self, differs_from: Any = None) -> Any:
        """Return a picture that no longer changes.

        It differs from the picture ``differs_from``. Without one, it shows a window.
        """
        end = time.monotonic() + LONG
        last = self.shot()
        while time.monotonic() < end:
            time.sleep(0.25 if differs_from is None else 0.1)
            now = self.shot()
            if differs_from is None:
                fresh = len(np.unique(now.reshape(-1, 3), axis=0)) > 50
            else:
                fresh = changed(now, differs_from) > 0
            if fresh and changed(now, last) == 0:
                return now
            last = now
        pytest.fail("the picture did not change, or never came to rest")


def changed(a: Any, b: Any) -> int:
    """Number of pixels that differ."""
    return int((a != b).any(axis=-1).sum())


@pytest.fixture(scope="session")
def screen(
    require: Callable[..., str], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Screen]:
    """A separate display, on a free number that the server chooses."""
    xvfb = require("xvfb", "opens the viewer window")
    reading, writing = os.pipe()
    folder = tmp_path_factory.mktemp("screen")
    # -noreset: it stays when its last window closes.
    command = [
        xvfb,
        "-displayfd",
        str(writing),
        "-screen",
        "0",
        "480x360x24",
        "-nolisten",
        "tcp",
        "-noreset",
    ]
    server = subprocess.Popen(
        [*command, "-fbdir", str(folder)], pass_fds=[writing], stderr=subprocess.DEVNULL
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as pipe:
            number = pipe.readline().strip()
        assert number, "Xvfb did not start"
        yield Screen(f":{number}", folder / "Xvfb_screen0")
    finally:
        server.terminate()
        server.wait()


# Runs one program after the other, each in its own namespace, and prints how each ended.
OPENER = """
import sys, traceback
print("ready", flush=True)
while line := sys.stdin.readline():
    try:
        exec(compile(open(line.strip()).read(), line.strip(), "exec"), {"__name__": "program"})
        print("=== done", flush=True)
    except BaseException:
        traceback.print_exc()
        print("=== failed", flush=True)
"""


class Windows:
    """A process that opens windows on the screen. The process of the tests must not open any.

    All tests share the process, because its start takes longer than the tests.
    """

    def __init__(self, screen: Screen, folder: Path) -> None:
        environment = {
            **os.environ,
            "DISPLAY": screen.display,
            "LIBGL_ALWAYS_SOFTWARE": "1",
            "LP_NUM_THREADS": "1",
        }
        environment.pop("MUJOCO_GL", None)
        self._folder = folder
        self._count = 0
        self._errors = folder / "stderr"
        with self._errors.open("w") as errors:
            self.process = subprocess.Popen(
                [sys.executable, "-c", OPENER],
                env=environment,
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
            )
        self.busy = False  # with a program
        assert self.line() == "ready"

    def start(self, program: str) -> None:
        """Runs a program; what it prints comes by ``line``."""
        self._count = self._count + 1
        self.busy = True
        file = self._folder / f"program{self._count}.py"
        file.write_text(program)
        self.say(str(file))

    def say(self, text: str = "") -> None:
        """A line for its standard input."""
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def line(self) -> str:
        """The next line that it prints; fails where the program did."""
        assert self.process.stdout is not None
        text = self.process.stdout.readline().strip()
        self.busy = not text.startswith("===")
        assert text not in ("", "=== failed"), self._errors.read_text()[-3000:]
        return text

    def run(self, program: str) -> list[str]:
        """All lines that a program prints."""
        self.start(program)
        lines = []
        while (text := self.line()) != "=== done":
            lines.append(text)
        return lines


@pytest.fixture(scope="session")
def opener(screen: Screen, tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Windows]]:
    opened: list[Windows] = []
    yield opened
    for windows in opened:
        windows.process.kill()
        windows.process.communicate()


@pytest.fixture
def windows(
    screen: Screen, opener: list[Windows], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Windows]:
    """The process; a new one if the last has died or hangs in a failed test."""
    if not opener or opener[-1].process.poll() is not None:
        opener.append(Windows(screen, tmp_path_factory.mktemp("windows")))
    yield opener[-1]
    if opener[-1].busy:
        opener[-1].process.kill()
        opener[-1].process.wait()
