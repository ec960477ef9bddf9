"""Makes the pictures of the testbed, the README's first one too: `python docs/make/screenshots.py`.

Needs Chromium and the extras web and dev (playwright).  Each picture is the real page in a browser, without a
GPU, after the session has run for some seconds; the colours are reduced to keep the files small.
"""

from __future__ import annotations

import functools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from measure_page import CHROMIUM, DRAWN, find_chromium
from PIL import Image
from playwright.sync_api import sync_playwright

from robot_ik.jobs.testbed import CameraTab, arm_link
from robot_ik.testbed.commands import Command, MoveGoal, SetArm, SetFigure, ShowBranches, Start
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

IMAGES = Path(__file__).resolve().parents[1] / "images" / "testbed"
NOTICE = ".mantine-Notification-closeButton"  # of viser's remark on software rendering
PATIENCE = 180_000  # ms: a browser without a GPU on a busy machine
COLOURS = 256


@dataclass(frozen=True)
class Shot:
    """One picture: what is opened, what is pressed, how large it is."""

    name: str
    start: Start
    size: tuple[int, int] = (1440, 900)
    dark: bool = False
    tab: str = ""
    commands: tuple[Command, ...] = ()
    until: Callable[[View], object] = lambda view: view.instances[0].statistics.count > 120
    text: str = ""
    bus: str = ""
    camera: bool = False


SHOTS = (
    Shot("one", Start()),
    Shot("four_dark", Start(count=4), dark=True),
    Shot("humanoid", Start("humanoid"), tab="Goals"),
    Shot("branches", Start("ur5e"), tab="Goals", commands=(ShowBranches(True),)),
    Shot(
        "figure", Start("humanoid"), tab="Figure",
        commands=(SetFigure("active"), MoveGoal((0.5, -0.2, 1.3))),
        until=lambda view: view.figure and view.instances[0].error < 0.01,
    ),
    Shot(
        "camera", Start("tabletop_puma"), tab="Camera", camera=True, text="marker seen",
    ),
    Shot(
        "arm", Start("tabletop_puma"), tab="Arm", bus="sim",
        commands=(MoveGoal((0.2, 0.05, 0.1)), SetArm("follow")),
        until=lambda view: view.arm and view.arm.servos and view.arm.mode == "follow" and view.arm.apart < 0.1
    ),
    Shot("record_dark", Start("panda"), tab="Record", dark=True),
    Shot("phone", Start(), size=(390, 844)),
    Shot("phone_dark", Start("srs_arm"), size=(390, 844), dark=True, tab="Goals"),
    Shot(
        "phone_arm", Start("tabletop_puma"), size=(390, 844), tab="Arm", bus="sim",
        until=lambda view: view.arm and view.arm.servos,
    ),
)  # fmt: skip


@contextmanager
def served(shot: Shot) -> Iterator[tuple[Session, Page, threading.Event]]:
    """The page of a picture, running until the event is set."""
    link = arm_link(shot.start.robot, None, shot.bus) if shot.bus else None
    stop = threading.Event()
    with Session(shot.start, arm=link) as session:
        camera = functools.partial(CameraTab, session) if shot.camera else None
        with Page(session, PageServer(port=8650, dark=shot.dark), camera=camera) as page:
            loop = threading.Thread(target=run, args=(session, page.draw, stop), kwargs={"every": 6})
            loop.start()
            try:
                yield session, page, stop
            finally:
                stop.set()
                loop.join()


def wait(holds: Callable[[], Any]) -> None:
    """Returns when it holds."""
    while not holds():
        time.sleep(0.05)


def take(browser: Any, shot: Shot) -> None:
    """Takes one picture."""
    with served(shot) as (session, page, stop):
        wait(lambda: session.ready and not session.busy)
        width, height = shot.size
        window = browser.new_page(viewport={"width": width, "height": height})
        window.set_default_timeout(PATIENCE)
        window.goto(page.url)
        window.wait_for_function(DRAWN, timeout=PATIENCE)
        window.locator(NOTICE).first.wait_for(timeout=PATIENCE)
        window.evaluate("found => document.querySelectorAll(found).forEach(one => one.click())", NOTICE)
        window.locator(NOTICE).first.wait_for(state="detached", timeout=PATIENCE)
        if page._camera is not None:
            page._camera.switch(True)
        for command in shot.commands:
            session.send(command)
        if shot.tab:
            window.get_by_role("tab", name=shot.tab, exact=True).click(force=True)
        wait(lambda: not session.busy and shot.until(page._view))
        if shot.text:
            window.get_by_text(shot.text).first.wait_for()
        for client in page.server.get_clients().values():
            client.scene.configure_default_lights(cast_shadow=True)  # now, and not after a while
        window.wait_for_timeout(1500)  # tables are renewed once a second
        stop.set()
        window.wait_for_timeout(2500)  # a browser without a GPU draws parts of a frame late
        raw = window.screenshot(timeout=PATIENCE)
        window.close()
    picture: Image.Image = Image.open(BytesIO(raw)).convert("RGB")
    picture = picture.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE)
    file = IMAGES / f"{shot.name}.png"
    picture.save(file, optimize=True)
    print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB", flush=True)


def main() -> None:
    """All of them, or those that are named."""
    path = find_chromium()
    if path is None:
        sys.exit("Chromium is needed: apt-get install chromium")
    IMAGES.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(CHROMIUM))
        for shot in SHOTS:
            if len(sys.argv) == 1 or shot.name in sys.argv[1:]:
                take(browser, shot)
        browser.close()


if __name__ == "__main__":
    main()
