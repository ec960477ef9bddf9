"""Makes the pictures of the testbed, the README's first one too: `python docs/make/screenshots.py`.

Needs Chromium and the extras web and dev (playwright). Each picture is the real page in a browser
without a GPU, after the session has run for some seconds. The colours are reduced to keep the files
small.
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

from robot_ik.testbed.commands import (
    AddObstacle,
    Command,
    MoveGoal,
    MoveObstacle,
    PlanMotion,
    RecordPose,
    ResizeObstacle,
    Scrub,
    SetArm,
    SetCourse,
    SetFigure,
    SetGoalKind,
    SetJoint,
    SetLimits,
    SetMotion,
    SetPace,
    SetRestarts,
    ShowBranches,
    Start,
)
from robot_ik.testbed.filming import SceneCamera, arm_link, film_in_process
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer
from robot_ik.testbed.loop import run
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

IMAGES = Path(__file__).resolve().parents[1] / "images" / "testbed"
PATIENCE = 300_000
"""ms: a browser without a GPU on a busy machine."""

COLOURS = 256
"""Of the palette."""

STATISTICS = 120
"""Solves after which the figures of a card are worth showing."""

PHONE = (390, 844)
"""Width and height of a phone, pixels."""


def _has_run(view: View) -> bool:
    return view.instances[0].statistics.count > STATISTICS


@dataclass(frozen=True)
class Shot:
    """One picture.

    Attributes:
        name: Name of the file.
        start: Start of the session.
        size: Width and height of the window, pixels.
        dark: Whether colours are dark.
        tab: The tab that is open. Empty: the first.
        press: Names of buttons that are pressed, in order.
        switches: Names of switches that are pressed.
        scroll: Text that the side panel is scrolled to.
        commands: What the session gets.
        until: Whether the view is as wanted.
        text: Text that must be on the page.
        bus: Bus of a servo arm. Empty: none.
        camera: Whether the camera's picture is shown.
        first_visit: Whether the page shows its first steps.
        ar: Whether robot and ball are drawn into the picture of the synthetic camera.
    """

    name: str
    start: Start
    size: tuple[int, int] = (1280, 800)
    dark: bool = False
    tab: str = ""
    press: tuple[str, ...] = ()
    switches: tuple[str, ...] = ()
    scroll: str = ""
    commands: tuple[Command, ...] = ()
    until: Callable[[View], object] = _has_run
    text: str = ""
    bus: str = ""
    camera: bool = False
    first_visit: bool = False
    ar: bool = False


POSES = (
    SetJoint("right_shoulder_roll", 1.2),
    SetJoint("right_elbow_pitch", 1.0),
    RecordPose(),
    SetJoint("right_shoulder_pitch", -1.5),
    SetJoint("right_elbow_pitch", 0.3),
    RecordPose(),
    SetJoint("left_shoulder_roll", 1.3),
    SetJoint("head_yaw", 0.6),
    RecordPose(),
    SetJoint("right_shoulder_pitch", -0.2),
    RecordPose(),
    Scrub(1.6),
)

SHOTS = (
    Shot("first_screen", Start(), first_visit=True),
    Shot("four_dark", Start(count=4), dark=True),
    Shot(
        "four_methods",
        Start("seven_segment", count=4, methods=("ccd", "transpose", "pseudoinverse", "dls")),
        commands=(
            SetLimits(True),
            SetGoalKind("position"),
            SetPace(0.0),
            SetRestarts(False),
            SetMotion("random"),
        ),
    ),
    Shot(
        "table_4_1",
        Start("seven_segment"),
        press=("Run the four cases",),
        text="Thesis S12, table 4.1: the thesis and this page",
    ),
    Shot(
        "course",
        Start(methods=("dls",)),
        commands=(SetCourse(7),),
        until=lambda view: view.course and view.course.frame > STATISTICS,
        scroll="failed sooner than 6",
    ),
    Shot(
        "paw",
        Start("lion", tool="front_right_paw"),
        tab="Goals",
    ),
    Shot(
        "regions",
        Start("humanoid"),
        tab="Scene",
        switches=("Regions of the figure",),
        commands=(SetMotion("hand"),),
        until=lambda view: view.motion == "hand",
    ),
    Shot("gallery", Start(), press=("robot",)),
    Shot("parameters", Start(count=2), press=("parameters of robot 2",)),
    Shot("humanoid", Start("humanoid"), tab="Goals"),
    Shot(
        "branches",
        Start("ur5e"),
        tab="Goals",
        commands=(ShowBranches(True),),
        until=lambda view: view.branches,
    ),
    Shot(
        "figure",
        Start("humanoid"),
        commands=(SetFigure("active"), MoveGoal((0.5, -0.2, 1.3))),
        until=lambda view: view.figure and view.instances[0].error < 0.01,
    ),
    Shot(
        "ar",
        Start("humanoid"),
        tab="AR",
        commands=(SetFigure("active"), MoveGoal((0.45, -0.25, 1.6))),
        until=lambda view: view.figure and view.instances[0].error < 0.01,
        text="pictures/s ·",
        ar=True,
    ),
    Shot(
        "timeline",
        Start("humanoid"),
        tab="Joints",
        commands=POSES,
        until=lambda view: view.motion == "timeline",
    ),
    Shot(
        "obstacles",
        Start(),
        tab="Scene",
        commands=(
            AddObstacle("box"),
            AddObstacle("sphere"),
            MoveObstacle(0, (-0.55, -0.55, 0.2)),
            MoveObstacle(1, (0.35, -0.1, 1.2)),
        ),
        until=lambda view: len(view.obstacles) == 2 and view.obstacles[1].part,
    ),
    Shot(
        "contacts",
        Start(),
        tab="Scene",
        commands=(
            AddObstacle("box"),
            ResizeObstacle(0, (0.5, 0.4, 0.15)),
            MoveObstacle(0, (-0.5, -0.3, 0.88)),
            MoveGoal((-0.45, -0.3, 0.9), (0.258819, 0.0, -0.965926, 0.0)),
        ),
        until=lambda view: view.contacts,
    ),
    Shot(
        "plan",
        Start("panda"),
        tab="Scene",
        commands=(
            MoveGoal((0.35, 0.45, 0.35), (0.0, 1.0, 0.0, 0.0)),
            AddObstacle("box"),
            ResizeObstacle(0, (0.06, 0.06, 0.7)),
            MoveObstacle(0, (0.4, 0.2, 0.35)),
            PlanMotion(),
        ),
        until=lambda view: view.plan.state == "found",
    ),
    Shot("reach_cloud", Start(), tab="Scene", press=("Cloud",), text="% of directions"),
    Shot("reach_shell", Start(), tab="Scene", press=("Shell",), text="% of directions"),
    Shot("camera", Start("tabletop_puma"), camera=True, text="away, m"),
    Shot(
        "arm",
        Start("tabletop_puma"),
        tab="Arm",
        bus="sim",
        commands=(MoveGoal((0.2, 0.05, 0.1)), SetArm("follow")),
        until=lambda view: (
            view.arm and view.arm.servos and view.arm.mode == "follow" and view.arm.apart < 0.1
        ),
    ),
    Shot("wide", Start("lion"), size=(1920, 1080)),
    Shot("narrow_dark", Start("panda"), size=(1000, 700), dark=True, tab="Record"),
    Shot("phone", Start("srs_arm"), size=PHONE),
    Shot("phone_dark", Start("tabletop_puma"), size=PHONE, dark=True, tab="Arm", bus="sim"),
)


@contextmanager
def served(shot: Shot) -> Iterator[tuple[Session, Page, threading.Event]]:
    """Serve the page of a picture, running until the event is set."""
    link = arm_link(shot.start.robot, None, shot.bus) if shot.bus else None
    stop = threading.Event()
    with Session(shot.start, arm=link) as session:
        camera = functools.partial(SceneCamera, session) if shot.camera else None
        server = PageServer(port=8650, dark=shot.dark)
        with Page(session, server, camera=camera, film=film_in_process) as page:
            keywords = {"every": 6}
            loop = threading.Thread(target=run, args=(session, page.draw, stop), kwargs=keywords)
            loop.start()
            try:
                yield session, page, stop
            finally:
                stop.set()
                loop.join()


def wait(holds: Callable[[], Any]) -> None:
    """Wait until a condition is true."""
    while not holds():
        time.sleep(0.05)


def take(browser: Any, shot: Shot) -> None:
    """Take one picture."""
    with served(shot) as (session, page, stop):
        wait(lambda: session.ready and not session.busy)
        width, height = shot.size
        window = browser.new_page(viewport={"width": width, "height": height})
        window.set_default_timeout(PATIENCE)
        if not shot.first_visit:
            window.add_init_script("localStorage.setItem('robot_ik.intro.seen', '1')")
        window.goto(page.url)
        window.wait_for_function(DRAWN, timeout=PATIENCE)
        for command in shot.commands:
            session.send(command)
        if shot.camera:
            window.get_by_role("button", name="Camera", exact=True).click()
        if shot.ar:
            page.switch_ar(True)
        if shot.tab:
            window.get_by_role("tab", name=shot.tab, exact=True).click()
        for name in shot.press:
            window.get_by_role("button", name=name, exact=True).click()
        for name in shot.switches:
            window.get_by_role("switch", name=name, exact=True).click(force=True)
        wait(lambda: not session.busy and shot.until(page._view))
        if shot.scroll:
            window.get_by_text(shot.scroll).scroll_into_view_if_needed()
        if shot.text:
            window.get_by_text(shot.text).first.wait_for()
        for client in page.server.get_clients().values():
            client.scene.configure_default_lights(cast_shadow=True)  # as a browser with a GPU
        window.wait_for_timeout(6000)  # figures are renewed once a second, and lights load late
        stop.set()
        window.wait_for_timeout(2000)  # a browser without a GPU draws late
        raw = window.screenshot(timeout=PATIENCE)
        window.close()
    picture: Image.Image = Image.open(BytesIO(raw)).convert("RGB")
    palette = Image.Quantize.MAXCOVERAGE
    picture = picture.quantize(COLOURS, palette, kmeans=2, dither=Image.Dither.NONE)
    file = IMAGES / f"{shot.name}.png"
    picture.save(file, optimize=True)
    print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB", flush=True)


def main() -> None:
    """Take all pictures, or those that are named."""
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
