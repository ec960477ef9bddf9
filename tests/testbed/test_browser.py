"""The page in a real browser: what is drawn, what is dragged, what the session gets of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from robot_ik.testbed.commands import (
    DragLink,
    MoveGoal,
    Nudge,
    Release,
    Reset,
    SetCount,
    SetMethod,
    SetMotion,
    SetOption,
    SetRobot,
    SetRunning,
    Start,
)
from tests.testbed.conftest import PATIENCE, Bed, serve

pytest.importorskip("viser", reason="needs the extra web")

ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
]  # fmt: skip
HARMLESS = (
    "THREE.Clock: This module has been deprecated",
    "GL Driver Message",  # software rendering is slow, says the driver
    "Unable to preventDefault inside passive event listener invocation.",  # viser's own
    "GL_INVALID_OPERATION: glDrawElementsInstanced",  # viser's outline of what the mouse is over, in software
)
READY = """() => {
    const seen = window.__viserMutable, points = window.__viserTestpoints;
    return seen && points && seen.nodeRefFromName["/goal"] && points.rendererInfo.render.triangles > 3000;
}"""
COLD = 200.0
"""Seconds in which kernels are compiled on a machine that has none yet."""
pytestmark = pytest.mark.timeout(300)
NOTICE = ".mantine-Notification-closeButton"  # of viser's remark on software rendering
# Where a point of the world is on the screen.
PIXEL = """([x, y, z]) => {
    const { camera, nodeRefFromName } = window.__viserMutable;
    const world = nodeRefFromName["/robot"];
    const point = world.localToWorld(camera.position.clone().set(x, y, z)).project(camera);
    const box = document.querySelector("canvas[data-engine]").getBoundingClientRect();
    return [box.left + (point.x + 1) / 2 * box.width, box.top + (1 - point.y) / 2 * box.height];
}"""


@dataclass
class Window:
    """A browser window that looks at the page, and all that it said and asked for."""

    page: Any
    said: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def pixel(self, place: Any) -> tuple[float, float]:
        x, y = self.page.evaluate(PIXEL, [float(value) for value in place])
        return x, y

    def leave_fields(self) -> None:
        """To the scene: while somebody types in a field, letters are no keys of the page."""
        self.page.evaluate("document.activeElement && document.activeElement.blur()")
        self.page.locator("canvas[data-engine]").hover()

    def drag(self, begin: tuple[float, float], way: tuple[float, float]) -> None:
        mouse = self.page.mouse
        mouse.move(begin[0] - 60, begin[1] - 60)
        mouse.move(*begin)
        self.page.wait_for_timeout(400)  # a press needs a hover ray first
        mouse.down()
        for k in range(1, 7):
            mouse.move(begin[0] + way[0] * k / 6, begin[1] + way[1] * k / 6)
            self.page.wait_for_timeout(80)
        mouse.up()


@pytest.fixture(scope="module")
def chromium(require: Callable[..., str]) -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright (the extra dev)")
    path = require("browser", "opens the page")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


def look(chromium: Any, bed: Bed, width: int = 1000, height: int = 560) -> Window:
    page = chromium.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(2e3 * PATIENCE)
    window = Window(page)
    page.on("console", lambda message: window.said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: window.said.append(f"error: {error}"))
    page.on("request", lambda request: window.requests.append(request.url))
    page.goto(bed.page.url)
    page.wait_for_function(READY, timeout=1e3 * PATIENCE)
    page.get_by_role("button", name="STOP").wait_for(timeout=1e3 * PATIENCE)
    notice = page.locator(NOTICE)  # over the scene, and so in the mouse's way
    notice.first.wait_for(timeout=1e3 * PATIENCE)
    page.evaluate("found => document.querySelectorAll(found).forEach(one => one.click())", NOTICE)
    notice.first.wait_for(state="detached", timeout=1e3 * PATIENCE)
    return window


@pytest.fixture(scope="module")
def window(chromium: Any, bed: Bed) -> Iterator[Window]:
    """The driving browser; what all tests did to it is judged by the last one."""
    bed.until(lambda view: view.tick > 0, "kernels were never ready", limit=COLD)
    window = look(chromium, bed)
    yield window
    window.page.close()


@pytest.fixture(autouse=True)
def afresh(bed: Bed) -> None:
    if bed.view.robot != "puma560":
        bed.session.send(SetRobot("puma560"))
    for command in (SetCount(1), SetMethod(0, "dls"), Reset()):
        bed.session.send(command)
    bed.until(
        lambda view: (
            view.robot == "puma560"
            and view.count == 1
            and not view.busy
            and view.motion == "curve"
            and view.running
        )
    )
    bed.sent.clear()


def test_one_request_and_none_to_outside(window: Window, bed: Bed) -> None:
    asked = [url for url in window.requests if not url.startswith(("blob:", "data:"))]
    assert asked == [bed.page.url]


def test_the_hint_and_the_statistics_are_read(window: Window, bed: Bed) -> None:
    window.page.get_by_text("Drag the orange ball, or any part of the robot.").wait_for()
    window.page.get_by_role("cell", name="dls").wait_for()


def test_a_slider_changes_the_solvers_option(window: Window, bed: Bed) -> None:
    slider = window.page.get_by_role("slider").nth(1)  # the first is the ball's speed
    slider.focus()
    before = dict(bed.view.instances[0].options)
    window.page.keyboard.press("ArrowRight")
    bed.until(lambda view: bed.count(SetOption) > 0)
    name = next(command for command in bed.sent if isinstance(command, SetOption)).name
    bed.until(lambda view: dict(view.instances[0].options)[name] != before[name])


def test_a_menu_changes_the_method(window: Window, bed: Bed) -> None:
    menus = window.page.get_by_role("combobox").all()
    next(menu for menu in menus if menu.input_value() == "dls").click()
    window.page.get_by_role("option", name="ccd", exact=True).click()
    bed.until(lambda view: view.instances[0].method == "ccd", "the method stayed")
    window.page.get_by_role("cell", name="ccd").wait_for()


def test_keys_work(window: Window, bed: Bed) -> None:
    window.leave_fields()
    window.page.keyboard.press("i")
    bed.until(lambda view: bed.count(SetMotion) == 1)
    height = bed.view.ball.position[2]
    window.page.keyboard.press("y")
    bed.until(lambda view: bed.count(Nudge) > 0 and view.motion == "hand")
    assert bed.view.ball.position[2] != height
    window.page.keyboard.press("Space")
    bed.until(lambda view: not view.running)
    window.page.keyboard.press("r")
    bed.until(lambda view: view.running and view.motion == "curve")


def test_dragging_the_ball_moves_ball_and_arm(window: Window, bed: Bed) -> None:
    bed.session.send(MoveGoal((-0.45, -0.3, 0.9)))
    bed.until(lambda view: view.motion == "hand")
    time.sleep(1.5)  # until the slow browser has drawn it
    before = bed.view
    window.drag(window.pixel(before.ball.position + np.array((0.0, -0.03, -0.02))), (50.0, -40.0))
    bed.until(lambda view: bed.count(MoveGoal) > 1, "no drag of the ball came")
    moved = bed.until(lambda view: np.linalg.norm(view.ball.position - before.ball.position) > 0.03)
    assert moved.motion == "hand"
    bed.until(lambda view: np.abs(view.instances[0].q - before.instances[0].q).max() > 0.02)


def test_dragging_a_link_takes_the_arm_along(window: Window, bed: Bed) -> None:
    bed.session.send(MoveGoal((-0.45, -0.3, 0.9)))
    time.sleep(1.5)
    before, body = bed.view, bed.session.robot.model.body("link4").id
    window.drag(window.pixel(before.instances[0].xpos[body]), (-60.0, 30.0))
    bed.until(lambda view: bed.count(DragLink) > 0 and bed.count(Release) > 0, "no drag of a part came")
    bed.until(lambda view: np.abs(view.instances[0].q - before.instances[0].q).max() > 0.02)


def test_compare_four_shows_four_rows(window: Window, bed: Bed) -> None:
    window.leave_fields()
    window.page.keyboard.press("4")
    bed.until(lambda view: view.count == 4)
    for name in ("lm", "pseudoinverse", "ccd"):
        window.page.get_by_role("cell", name=name, exact=True).wait_for()


def test_the_figure_tab_says_what_it_decides_and_why(window: Window, bed: Bed) -> None:
    bed.session.send(SetRobot("humanoid"))
    bed.session.send(SetRunning(False))  # a figure that moves keeps a browser without a GPU busy
    bed.until(lambda view: view.robot == "humanoid" and not view.busy and not view.running)
    window.page.get_by_role("tab", name="Figure", exact=True).click()
    window.page.get_by_role(
        "combobox", name="Moved by"
    ).focus()  # a click waits for frames, and these are slow
    for key in ("Enter", "ArrowDown", "ArrowDown", "Enter"):
        window.page.keyboard.press(key)
        window.page.wait_for_timeout(300)
    bed.until(lambda view: view.figure and view.figure.mode == "passive", "nobody decides")
    bed.session.send(MoveGoal((0.5, -0.3, 1.3)))
    window.page.get_by_text("drag the ball, then press Act now").wait_for(timeout=1e3 * PATIENCE)
    window.page.evaluate("document.activeElement && document.activeElement.blur()")
    window.page.keyboard.press("y")  # not by the mouse: its rays through a figure's meshes take a CPU minutes
    bed.until(lambda view: bed.count(Nudge) == 1 and view.ball.position[2] > 1.31, "the ball stays")
    bed.session.send(SetRunning(True))
    button = window.page.get_by_role("button", name="Act now")
    button.focus()
    window.page.keyboard.press("Enter")
    seen = bed.until(lambda view: view.figure and not view.figure.waiting, "it was not asked to act")
    assert seen.figure is not None and seen.figure.decision in ("reach", "bend", "walk", "nothing")
    window.page.get_by_text(seen.figure.reason).first.wait_for(timeout=1e3 * PATIENCE)


def test_a_second_browser_watches_and_its_stop_works(chromium: Any, window: Window, bed: Bed) -> None:
    window.page.keyboard.press("l")  # the first one drives
    watcher = look(chromium, bed, 420, 760)
    watcher.page.get_by_role("slider").first.focus()
    watcher.page.keyboard.press("ArrowRight")
    watcher.page.get_by_text("Another browser drives").first.wait_for(timeout=1e3 * PATIENCE)
    assert bed.sent == [] and bed.view.speed == 1.0
    watcher.page.get_by_role("button", name="STOP").click()
    bed.until(lambda view: not view.running, "a watcher's STOP does nothing")
    watcher.page.close()
    assert wrong(watcher) == []


def wrong(window: Window) -> list[str]:
    return [
        line
        for line in window.said
        if line.startswith(("error", "warning")) and not any(text in line for text in HARMLESS)
    ]


def test_no_error_was_said_by_any_of_this(window: Window) -> None:
    assert wrong(window) == []


def test_the_page_opens_with_its_token(chromium: Any) -> None:
    for bed in serve(Start(), token=True):
        window = look(chromium, bed, 420, 400)
        assert window.page.url == bed.page.url.split("?")[0]
        window.page.close()
