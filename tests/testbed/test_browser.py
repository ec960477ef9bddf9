"""The page in a real browser: what is drawn, what is dragged, what the session gets of it."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from robot_ik.jobs.testbed import arm_link
from robot_ik.testbed.commands import (
    Act,
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
from robot_ik.testbed.session import Session, run
from tests.doc_pages import script
from tests.testbed.conftest import Bed
from tests.waiting import LONG

pytest.importorskip("viser", reason="needs the extra web")
from robot_ik.testbed.frontends.browser import Page
from robot_ik.testbed.frontends.page_server import PageServer

measure_page = script("measure_page")

HARMLESS = (
    "THREE.Clock: This module has been deprecated",
    "GL Driver Message",  # software rendering is slow, says the driver
    "Unable to preventDefault inside passive event listener invocation.",  # viser's own
    "GL_INVALID_OPERATION: glDrawElementsInstanced",  # viser's outline of what the mouse is over, in software
)
NOTICE = ".mantine-Notification-root"
BALL = (-0.45, -0.3, 0.9)
# As the hand is turned at home: what was before must not decide whether `dls` arrives.
TURNED = (0.258819, 0.0, -0.965926, 0.0)
"""Where the ball rests: while nothing moves, a browser without a GPU has nothing to do."""
# Whether the gizmo is drawn at a place; batched meshes follow it a frame later.
AT = """async place => {
    const node = window.__viserMutable.nodeRefFromName["/goal"];
    const seen = node.getWorldPosition(node.position.clone());
    const world = window.__viserMutable.nodeRefFromName["/robot"];
    const wanted = world.localToWorld(node.position.clone().set(...place));
    if (seen.distanceTo(wanted) > 1e-3) return false;
    for (let k = 0; k < 3; k++) await new Promise(requestAnimationFrame);
    return true;
}"""
# What the mouse is over, as the browser shows it: "pointer" over what can be dragged, else "auto".
CURSOR = """shown => document.querySelector("canvas[data-engine]").style.cursor === shown"""
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

    def pixel(self, position: Any) -> tuple[float, float]:
        x, y = self.page.evaluate(PIXEL, [float(value) for value in position])
        return x, y

    def leave_fields(self) -> None:
        """To the scene: while somebody types in a field, letters are no keys of the page."""
        self.page.evaluate("document.activeElement && document.activeElement.blur()")
        self.page.locator("canvas[data-engine]").hover()

    def drag(
        self, position: Callable[[], Any], way: tuple[float, float], came: Callable[[], bool], what: str
    ) -> None:
        """Drags what the browser draws at ``position``, a point of the world, by ``way`` pixels.

        Where frames are late, one may miss the press.
        """
        end = time.monotonic() + LONG
        self.again(lambda: self._drag_once(position, way, end), came, what)

    def press(self, key: str, came: Callable[[], bool], what: str, on: Any = None) -> None:
        """Presses a key, with the focus ``on`` a widget or where it is."""

        def once() -> None:
            if on is not None:
                on.focus()
            self.page.keyboard.press(key)

        self.again(once, came, what)

    def again(self, act: Callable[[], None], came: Callable[[], bool], what: str) -> None:
        """Acts until it ``came`` to the session: a busy browser may just have lost its connection."""
        end = time.monotonic() + LONG
        while not came():
            assert time.monotonic() < end, what
            act()
            for _ in range(100):
                if not came():
                    self.page.wait_for_timeout(100)

    def _drag_once(self, position: Callable[[], Any], way: tuple[float, float], end: float) -> None:
        """A press needs a hover ray first, and what is drawn may be behind the session.

        The mouse goes there until the browser shows that it is over something that can be dragged.
        """
        mouse = self.page.mouse
        mouse.move(10, self.page.viewport_size["height"] - 10)
        self.page.wait_for_function(CURSOR, arg="auto")
        while True:
            begin = self.pixel(position())
            mouse.move(*begin)
            self.page.wait_for_timeout(300)
            if self.page.evaluate(CURSOR, "pointer"):
                break
            assert time.monotonic() < end, f"nothing to drag is drawn at {begin}"
            mouse.move(begin[0] + 1, begin[1])
        mouse.down()
        for k in range(1, 5):
            mouse.move(begin[0] + way[0] * k / 4, begin[1] + way[1] * k / 4)
            self.page.wait_for_timeout(60)
        mouse.up()


@pytest.fixture(scope="module")
def chromium(require: Callable[..., str]) -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright (the extra dev)")
    path = require("browser", "opens the page")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(measure_page.CHROMIUM))
        yield browser
        browser.close()


def open_window(chromium: Any, url: str, *, scene: bool, width: int = 1000, height: int = 560) -> Window:
    """Opens the page; its scene is waited for if somebody will look at it, or only its panels."""
    page = chromium.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(1e3 * LONG)
    window = Window(page)
    page.on("console", lambda message: window.said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: window.said.append(f"error: {error}"))
    page.on("request", lambda request: window.requests.append(request.url))
    page.goto(url)
    page.get_by_role("button", name="STOP").wait_for()
    if scene:
        page.wait_for_function(measure_page.DRAWN)
        # viser's remark on software rendering comes seconds later, over the scene and in the mouse's way.
        page.add_style_tag(content=f"{NOTICE} {{ display: none !important; }}")
    return window


@pytest.fixture(scope="module")
def window(chromium: Any, bed: Bed) -> Iterator[Window]:
    """The driving browser; what all tests did to it is judged by the last one."""
    bed.until(lambda view: view.tick > 0, "kernels were never ready")
    window = open_window(chromium, bed.page.url, scene=True)
    yield window
    window.page.close()


@pytest.fixture(autouse=True)
def afresh(bed: Bed) -> None:
    """One arm that has reached a ball at rest."""
    if bed.view.robot != "puma560":
        bed.session.send(SetRobot("puma560"))
    for command in (SetCount(1), SetMethod(0, "dls")):
        bed.session.send(command)
    bed.until(
        lambda view: (
            (view.robot, view.count, view.busy, view.instances[0].method) == ("puma560", 1, "", "dls")
        )
    )
    bed.session.send(Reset())
    bed.session.send(MoveGoal(BALL, TURNED))
    bed.until(lambda view: view.motion == "hand" and view.running and view.instances[0].status == "converged")
    bed.sent.clear()


def test_one_request_and_none_to_outside(window: Window, bed: Bed) -> None:
    asked = [url for url in window.requests if not url.startswith(("blob:", "data:"))]
    assert asked == [bed.page.url]


def test_the_hint_and_the_statistics_are_read(window: Window, bed: Bed) -> None:
    window.page.get_by_text("Drag the orange ball, or any part of the robot.").wait_for()
    window.page.get_by_role("cell", name="dls").wait_for()


def test_a_slider_changes_the_solvers_option(window: Window, bed: Bed) -> None:
    slider = window.page.get_by_role("slider").nth(1)  # the first is the ball's speed
    before = dict(bed.view.instances[0].options)
    window.press("ArrowRight", lambda: bed.count(SetOption) > 0, "the slider sends nothing", on=slider)
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
    for key, command, holds in (
        ("i", SetMotion, lambda view: view.motion == "curve"),
        ("y", Nudge, lambda view: view.motion == "hand"),
        ("Space", SetRunning, lambda view: not view.running),
        ("r", Reset, lambda view: view.running and view.motion == "curve"),
    ):
        window.press(key, lambda command=command: bed.count(command) > 0, f"{key} sends nothing")
        bed.until(holds, f"{key} does something else")


def test_a_nudge_lifts_the_ball(window: Window, bed: Bed) -> None:
    window.leave_fields()
    window.press("y", lambda: bed.view.ball.position[2] > BALL[2] + 0.01, "the key did not lift it")


def test_dragging_the_ball_moves_ball_and_arm(window: Window, bed: Bed) -> None:
    window.page.wait_for_function(AT, arg=list(BALL))
    before = bed.view
    window.drag(
        lambda: bed.view.ball.position + np.array((0.0, -0.03, -0.02)), (50.0, -40.0),
        lambda: bed.count(MoveGoal) > 0, "no drag of the ball came",
    )  # fmt: skip
    moved = bed.until(lambda view: np.linalg.norm(view.ball.position - before.ball.position) > 0.03)
    assert moved.motion == "hand"
    bed.until(lambda view: np.abs(view.instances[0].q - before.instances[0].q).max() > 0.02)


def test_dragging_a_link_takes_the_arm_along(window: Window, bed: Bed) -> None:
    window.page.wait_for_function(AT, arg=list(BALL))
    before, body = bed.view, bed.session.robot.model.body("link4").id
    window.drag(
        lambda: bed.view.instances[0].xpos[body], (-60.0, 30.0),
        lambda: bed.count(DragLink) > 0 and bed.count(Release) > 0, "no drag of a part came",
    )  # fmt: skip
    bed.until(lambda view: np.abs(view.instances[0].q - before.instances[0].q).max() > 0.02)


def test_compare_four_shows_four_rows(window: Window, bed: Bed) -> None:
    window.leave_fields()
    window.press("4", lambda: bed.view.count == 4, "there are not four")
    for name in ("lm", "pseudoinverse", "ccd"):
        window.page.get_by_role("cell", name=re.compile(f"^{name}\\b")).wait_for()


def test_the_figure_tab_says_what_it_decides_and_why(window: Window, bed: Bed) -> None:
    bed.session.send(SetRobot("humanoid"))
    bed.session.send(SetRunning(False))  # a figure that moves keeps a browser without a GPU busy
    bed.until(lambda view: view.robot == "humanoid" and not view.busy and not view.running)
    window.page.get_by_role("tab", name="Figure", exact=True).click()
    window.page.get_by_role("combobox", name="Moved by").click()
    window.page.get_by_role("option", name="itself, on demand").click()
    bed.until(lambda view: view.figure and view.figure.mode == "passive", "nobody decides")
    bed.session.send(MoveGoal((0.5, -0.3, 1.3)))
    window.page.get_by_text("drag the ball, then press Act now").wait_for()
    window.page.evaluate("document.activeElement && document.activeElement.blur()")
    window.press("y", lambda: bed.count(Nudge) > 0, "the key does not arrive")
    bed.until(lambda view: view.ball.position[2] > 1.31, "the ball stays")
    bed.session.send(SetRunning(True))
    button = window.page.get_by_role("button", name="Act now")
    window.press("Enter", lambda: bed.count(Act) > 0, "the button does not arrive", on=button)
    seen = bed.until(lambda view: view.figure and not view.figure.waiting, "it does not act")
    bed.session.send(SetRunning(False))
    assert seen.figure is not None and seen.figure.decision.action in ("reach", "bend", "walk", "nothing")
    window.page.get_by_text(seen.figure.decision.reason).first.wait_for()
    window.page.get_by_role("cell", name="itself").wait_for()  # and not a method's numbers of before


def test_a_second_browser_watches_and_its_stop_works(chromium: Any, window: Window, bed: Bed) -> None:

    window.press("l", lambda: bed.page.gate.driver is not None, "the first browser does not drive")
    watcher = open_window(chromium, bed.page.url, scene=False, width=420, height=760)
    notice, page = watcher.page.get_by_text("Another browser drives"), watcher.page
    watcher.press("ArrowRight", lambda: notice.count() > 0, "no notice", on=page.get_by_role("slider").first)
    assert bed.sent == [] and bed.view.speed == 1.0
    stop = page.get_by_role("button", name="STOP")
    watcher.press("Enter", lambda: not bed.view.running, "a watcher's STOP does nothing", on=stop)
    page.close()
    assert wrong(watcher) == []


def wrong(window: Window) -> list[str]:
    return [
        line
        for line in window.said
        if line.startswith(("error", "warning")) and not any(text in line for text in HARMLESS)
    ]


def test_no_error_was_said_by_any_of_this(window: Window) -> None:
    assert wrong(window) == []


def test_the_page_opens_with_its_token(chromium: Any, guarded: Any) -> None:
    window = open_window(chromium, guarded.url, scene=False, width=420, height=400)
    assert window.page.url == guarded.url.split("?")[0]
    window.page.close()


@pytest.fixture
def arm_bed(real_time: None) -> Iterator[Bed]:
    """A session with simulated servos, its page, and its loop on a thread."""
    with (
        Session(Start("tabletop_puma"), arm=arm_link("tabletop_puma", None, "sim")) as session,
        Page(session, PageServer(port=8612, shadows=False)) as page,
        looped(session, page),
    ):
        bed = Bed(session, page)
        bed.until(lambda view: view.tick > 0, "kernels were never ready")
        yield bed


@contextlib.contextmanager
def looped(session: Session, page: Page) -> Iterator[None]:
    """The loop of a session, on a thread as long as the block runs."""
    stop = threading.Event()
    loop = threading.Thread(target=run, args=(session, page.draw, stop), kwargs={"every": 4})
    loop.start()
    try:
        yield
    finally:
        stop.set()
        loop.join()


def test_stop_stays_where_it_is_on_the_screen(chromium: Any, arm_bed: Bed) -> None:
    window = open_window(chromium, arm_bed.page.url, scene=False)
    button = window.page.get_by_role("button", name="STOP")
    before = button.bounding_box()
    arm_bed.session.report("a message of many lines " * 20)
    window.page.get_by_text("a message of many lines").wait_for()
    assert button.bounding_box() == before
    window.page.get_by_text("Keys", exact=True).scroll_into_view_if_needed()
    after = button.bounding_box()
    assert before is not None and after is not None and abs(after["y"] - before["y"]) < 1.0
    window.page.close()


def test_hold_after_torque_off_says_that_the_arm_is_limp(chromium: Any, arm_bed: Bed) -> None:
    window = open_window(chromium, arm_bed.page.url, scene=False)
    window.page.get_by_role("tab", name="Arm", exact=True).click()
    for button, holds in (
        ("Follow", lambda view: view.arm.state == "enabled"),
        ("Torque off", lambda view: view.arm.mode == "release" and view.arm.limp),
        ("Hold", lambda view: view.arm.mode == "hold"),
    ):
        window.page.get_by_role("button", name=button, exact=True).click()
        arm_bed.until(holds, f"{button} does nothing")
    window.page.get_by_text("The arm is limp").wait_for()
    assert window.page.get_by_text("asked: hold").count() == 0
    window.page.close()


def test_a_page_without_its_program_says_that_stop_does_not_work(chromium: Any, real_time: None) -> None:
    with (
        Session(Start("tabletop_puma"), arm=arm_link("tabletop_puma", None, "sim")) as session,
        Page(session, PageServer(port=8612, shadows=False)) as page,
        looped(session, page),
    ):
        window = open_window(chromium, page.url, scene=False)
        veil = window.page.locator("#connection-lost")
        window.page.locator("[data-beat]").wait_for(state="attached")
        veil.wait_for(state="hidden")
    veil.wait_for()
    assert "STOP does not work" in veil.inner_text() and "robot-ik stop" in veil.inner_text()
    assert veil.bounding_box() == {"x": 0, "y": 0, **window.page.viewport_size}
    window.page.close()


def test_a_loop_that_hangs_is_a_lost_connection(chromium: Any, arm_bed: Bed) -> None:
    window = open_window(chromium, arm_bed.page.url, scene=False)
    veil = window.page.locator("#connection-lost")
    hangs, go_on = threading.Event(), threading.Event()

    def hang(*_: object) -> None:
        hangs.set()
        go_on.wait()

    arm_bed.page._draw_scene = hang  # type: ignore[method-assign]
    try:
        hangs.wait()
        veil.wait_for()
    finally:
        go_on.set()
    veil.wait_for(state="hidden")
    window.page.close()
